#include "tensor_stereo/consensus_belief.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <utility>

#include "tensor_stereo/buffer.hpp"
#include "tensor_stereo/parallel.hpp"
#include "vector2.hpp"

namespace tensor_stereo {
namespace {

constexpr std::int64_t kGrain = 2048;
constexpr double kMaxCost = 1e300, kCostFloor = 1e-2, kSpreadFloor = 0.1, kMaxEvidence = 8;  // as in the reference
constexpr double kVanished = 1492;  // exp(-x / 2) is zero beyond, and the library function slow to say so

// Where a match lies in both views, in tolerances.
struct Position {
    Vector2 view[2];
};

// The displacement (u, v) around a match, relative to its own, in tolerances, and its slopes.
struct Plane {
    Vector2 at, by_x, by_y;
};

// What a neighbour says about a match, in tolerances.
struct Vote {
    Vector2 offset;      // from the match to the voter, halfway between the views
    Vector2 difference;  // displacement of the voter minus that of the match
};

inline Vote vote_of(const Position& voter, const Position& match) noexcept {
    const Vector2 offset0 = voter.view[0] - match.view[0], offset1 = voter.view[1] - match.view[1];
    return {(offset0 + offset1) / 2.0, offset1 - offset0};
}

// Sums of weighted products around one match: the matrix and both right-hand sides of a least-squares plane.
struct Moments {
    double one = 0, xy = 0;
    Vector2 first{}, second{};     // of (x, y) and its squares
    Vector2 at{}, by_x{}, by_y{};  // of (u, v), x (u, v) and y (u, v)

    void add(const Vote& vote, double weight) noexcept {
        const Vector2 weighted = weight * vote.offset;
        one += weight;
        first += weighted;
        second += weighted * vote.offset;
        xy += weighted[0] * vote.offset[1];
        at += weight * vote.difference;
        by_x += weighted[0] * vote.difference;
        by_y += weighted[1] * vote.difference;
    }

    // By the cofactors of the matrix, which is positive definite by what is added to its diagonal.
    Plane solve(double ridge) const noexcept {
        const double x = first[0], y = first[1], m00 = one + 1, m11 = second[0] + ridge, m22 = second[1] + ridge;
        const double c00 = m11 * m22 - xy * xy, c01 = xy * y - x * m22, c02 = x * xy - m11 * y;
        const double c11 = m00 * m22 - y * y, c12 = x * y - m00 * xy, c22 = m00 * m11 - x * x;
        const double determinant = m00 * c00 + x * c01 + y * c02;
        return {(c00 * at + c01 * by_x + c02 * by_y) / determinant, (c01 * at + c11 * by_x + c12 * by_y) / determinant,
                (c02 * at + c12 * by_x + c22 * by_y) / determinant};
    }
};

// The length of the mean of exp(2 pi i x) over the rows of a pair: 1 for whole pixels, 0 anywhere.
template <class Value>
double grid_share(const Value& value, std::int64_t begin, std::int64_t end) noexcept {
    double real = 0, imaginary = 0;
    for (std::int64_t row = begin; row < end; ++row) {
        const double x = value(row), phase = 2 * std::numbers::pi * (x - std::nearbyint(x));
        real += std::cos(phase);
        imaginary += std::sin(phase);
    }
    const auto count = static_cast<double>(end - begin);
    return std::hypot(real / count, imaginary / count);
}

// The product over the x and y of both views; rows of view 1 as they are or without what their pair shares, if that is
// more.
double whole_pixels(const ConsensusMatches& matches, std::int64_t begin, std::int64_t end) noexcept {
    const auto share = [&](int view, int axis) {
        return grid_share([&](std::int64_t row) { return matches.found[view][2 * row + axis]; }, begin, end);
    };
    double last = share(1, 1);
    if (matches.row_offset != nullptr) {
        const auto moved = [&](std::int64_t row) { return matches.found[0][2 * row + 1] - matches.row_offset[row]; };
        last = std::max(last, grid_share(moved, begin, end));
    }
    return share(0, 0) * share(0, 1) * share(1, 0) * last;
}

class Consensus {
   public:
    Consensus(const ConsensusMatches& matches, const ConsensusSettings& settings)
        : matches_(matches),
          settings_(settings),
          positions_(allocate<Position>(num_matches())),
          odds_(allocate<double>(num_matches())),
          planes_(allocate<Plane>(num_matches())),
          weights_{allocate<double>(num_edges(0)), allocate<double>(num_edges(1))} {}

    std::int64_t num_matches() const noexcept { return matches_.ptr[matches_.num_pairs]; }
    std::int64_t num_edges(int view) const noexcept { return matches_.crow[view][num_matches()]; }

    // Scales the positions of one pair, and finds the odds of its matches and the first beliefs.
    void begin(std::int64_t pair, double* belief) noexcept {
        const std::int64_t begin = matches_.ptr[pair], end = matches_.ptr[pair + 1];
        if (begin == end) return;
        const double whole = whole_pixels(matches_, begin, end);
        const double tolerance = settings_.tolerance + (settings_.whole_tolerance - settings_.tolerance) * whole;
        for (std::int64_t row = begin; row < end; ++row) {
            for (int view = 0; view < 2; ++view) {
                const double* const point = matches_.keypoints[view] + 2 * row;
                positions_[row].view[view] = Vector2{point[0], point[1]} / tolerance;
            }
        }
        std::fill(odds_.get() + begin, odds_.get() + end, 0.0);  // evidence, until its exponential is taken
        if (matches_.row_offset != nullptr) add_row_offsets(begin, end, whole);
        if (matches_.cost != nullptr) add_costs(begin, end, belief);
        for (std::int64_t row = begin; row < end; ++row) {
            odds_[row] = std::exp(std::min(std::max(odds_[row], -kMaxEvidence), kMaxEvidence));
            belief[row] = odds_[row] / (1 + odds_[row]);
        }
    }

    // Weighs the votes by distance, half at `reach` times the typical one.
    void weigh(std::int64_t row) noexcept {
        double sum = 0;
        std::int64_t degree = 0;
        for (int view = 0; view < 2; ++view) {
            const std::int64_t begin = matches_.crow[view][row], end = matches_.crow[view][row + 1];
            for (std::int64_t k = begin; k < end; ++k) {
                const Vector2 way = positions_[matches_.cols[view][k]].view[view] - positions_[row].view[view];
                const double squared = way[0] * way[0] + way[1] * way[1];
                weights_[view][k] = squared;
                sum += squared;
            }
            degree += end - begin;
        }
        const double typical = sum / static_cast<double>(std::max<std::int64_t>(degree, 1));
        const double half = settings_.reach * settings_.reach * typical;
        for (int view = 0; view < 2; ++view) {
            for (std::int64_t k = matches_.crow[view][row]; k < matches_.crow[view][row + 1]; ++k) {
                weights_[view][k] = 1 / (1 + weights_[view][k] / half);
            }
        }
    }

    void fit(const double* belief, std::int64_t row) noexcept {
        Moments moments;
        each_vote(belief, row, [&moments](std::int64_t, const Vote& vote, double trust) {
            const Vector2 squared = vote.difference * vote.difference;
            moments.add(vote, trust * (1 / (1 + squared[0] + squared[1])));
        });
        planes_[row] = moments.solve(1 / (settings_.slope * settings_.slope));
    }

    // The belief of the next round: what the planes of the neighbours predict, and what the match says itself.
    double update(const double* belief, std::int64_t row) const noexcept {
        double agreed = 0, total = 0;
        each_vote(belief, row, [&](std::int64_t voter, const Vote& vote, double trust) {
            const Plane& plane = planes_[voter];
            const Vector2 miss = vote.difference + plane.at - plane.by_x * vote.offset[0] - plane.by_y * vote.offset[1];
            const double squared = miss[0] * miss[0] + miss[1] * miss[1];
            if (!(squared > kVanished)) agreed += trust * std::exp(squared / -2);
            total += trust;
        });
        const double support = agreed / (total + settings_.doubt), odds = odds_[row];
        return support * odds / (support * odds + 1 - support);
    }

   private:
    void add_row_offsets(std::int64_t begin, std::int64_t end, double whole) noexcept {
        const double narrow = settings_.row_tolerance;
        const double tolerance = narrow + (settings_.whole_row_tolerance - narrow) * whole;
        for (std::int64_t row = begin; row < end; ++row) {
            const double offset = matches_.row_offset[row] / tolerance;
            odds_[row] -= std::log1p(offset * offset);
        }
    }

    // By the logarithm of the cost, in standard deviations from the mean of the pair. level: (num_matches) scratch.
    void add_costs(std::int64_t begin, std::int64_t end, double* level) noexcept {
        const auto mean = [&](const auto& value) {
            double sum = 0;
            for (std::int64_t row = begin; row < end; ++row) sum += value(row);
            return sum / static_cast<double>(end - begin);
        };
        double lowest = 0;  // costs of a pair that has negative ones count from the least
        for (std::int64_t row = begin; row < end; ++row) {
            if (!(std::abs(matches_.cost[row]) <= kMaxCost)) return;  // they say nothing
            lowest = std::min(lowest, matches_.cost[row]);
        }
        const double typical = mean([&](std::int64_t row) { return matches_.cost[row] - lowest; });
        const double floor = typical > 0 ? kCostFloor * typical : 1;
        for (std::int64_t row = begin; row < end; ++row) {
            level[row] = std::log(matches_.cost[row] - lowest + floor + std::numeric_limits<double>::min());
        }
        const double middle = mean([&](std::int64_t row) { return level[row]; });
        for (std::int64_t row = begin; row < end; ++row) level[row] -= middle;
        const double variance = mean([&](std::int64_t row) { return level[row] * level[row]; });
        const double deviation = std::sqrt(variance + kSpreadFloor * kSpreadFloor);
        for (std::int64_t row = begin; row < end; ++row) odds_[row] -= settings_.cost_weight * (level[row] / deviation);
    }

    template <class Use>
    void each_vote(const double* belief, std::int64_t row, const Use& use) const noexcept {
        for (int view = 0; view < 2; ++view) {
            for (std::int64_t k = matches_.crow[view][row]; k < matches_.crow[view][row + 1]; ++k) {
                const std::int64_t voter = matches_.cols[view][k];
                use(voter, vote_of(positions_[voter], positions_[row]), belief[voter] * weights_[view][k]);
            }
        }
    }

    const ConsensusMatches matches_;
    const ConsensusSettings settings_;
    Buffer<Position> positions_;
    Buffer<double> odds_;  // of each match by itself
    Buffer<Plane> planes_;
    Buffer<double> weights_[2];
};

}  // namespace

void consensus_belief(const ConsensusMatches& matches, const ConsensusSettings& settings, int num_threads,
                      double* belief) {
    Consensus consensus(matches, settings);
    const auto spread = [&](std::int64_t count, std::int64_t grain, const auto& work) {
        parallel_for(count, grain, num_threads, [&] {
            return [&](std::int64_t begin, std::int64_t end) {
                for (std::int64_t k = begin; k < end; ++k) work(k);
            };
        });
    };
    const auto each_row = [&](const auto& work) { spread(consensus.num_matches(), kGrain, work); };
    const auto scratch = allocate<double>(consensus.num_matches());
    double* now = settings.num_rounds % 2 == 0 ? belief : scratch.get();  // so that the last round ends in belief
    double* next = settings.num_rounds % 2 == 0 ? scratch.get() : belief;
    spread(matches.num_pairs, 1, [&](std::int64_t pair) { consensus.begin(pair, now); });
    each_row([&](std::int64_t row) { consensus.weigh(row); });
    for (int round = 0; round < settings.num_rounds; ++round) {
        each_row([&](std::int64_t row) { consensus.fit(now, row); });
        each_row([&](std::int64_t row) { next[row] = consensus.update(now, row); });
        std::swap(now, next);
    }
}

}  // namespace tensor_stereo
