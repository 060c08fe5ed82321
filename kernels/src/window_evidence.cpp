#include "tensor_stereo/window_evidence.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>

#include "dispatch.hpp"
#include "lanes.hpp"
#include "window_comparison.hpp"
#include "window_sampling.hpp"

namespace tensor_stereo {
namespace {

constexpr int kNear = kNearPlaces / 2;  // px on either side of the match that are looked at one by one
constexpr float kSame = 2;              // px; a rival is farther from the match than that
constexpr int kDisc = 4;                // px, radius of what is searched where no rows are known
constexpr float kNowhere = 20;          // log SSD of a place outside of the image
constexpr float kTie = 1e-3f;           // log SSDs that near are alike; rounding must not choose between them
constexpr float kMaxLog = 6;            // log ratios of SSDs are cut there
constexpr float kGood = 0.3f,
                kGoodWidth = 0.05f;  // by how much a rival may be worse and counts, and a half of the ramp
constexpr float kLeastBend = 0.03f;  // of the parabola through three SSDs, of the least one; less is noise
constexpr float kAlone = 100;        // px, of a rival that there is not
constexpr float kFarPlace = 1e4f;    // from the first disparity; what lies beyond is told by 5 at most
constexpr Window kCurves[kEvidenceCurves] = {kLike, kTight}, kSlanted[kSlantedWindows] = {kMiddle, kLike};

static_assert(kMaxSearched == kMaxPlaces);

// What a thread works with.
struct Workspace {
    Strip windows[2], strip;
    Anchor anchor[2];
    Comparison near, slanted, far;
    bool outside[kMaxPlaces];
};

// What is looked for around one window.
struct Search {
    const Look& other;
    Place point;    // of the window
    Place partner;  // in the other view
    float across;   // px, where the line of the window lies in the other view
    float shear_x, shear_y;
    float start;  // px, the first disparity
    float own;    // place of the match from there
    int count;
    bool reverse;  // disparity grows against the columns of the other view
    bool has_rows;
};

// From the middle place to the lowest of some, by the parabola around it; of alike ones the nearest to the middle.
TENSOR_STEREO_INLINE float lowest_place(const float* ssd) {
    float least = ssd[0];
    for (int k = 1; k < kNearPlaces; ++k) least = std::min(least, ssd[k]);
    const float most = least * (1 + kTie);
    int best = 0;
    float distance = kAlone;
    for (int k = 0; k < kNearPlaces; ++k) {
        const auto away = static_cast<float>(std::abs(k - kNear));
        if (ssd[k] <= most && away < distance) {
            distance = away;
            best = k;
        }
    }
    best = std::clamp(best, 1, kNearPlaces - 2);
    const float bend = std::max((ssd[best - 1] - 2 * ssd[best]) + ssd[best + 1], kLeastBend * ssd[best]);
    const float step = (ssd[best - 1] - ssd[best + 1]) / (2 * bend);
    return static_cast<float>(best - kNear) + std::clamp(step, -1.0f, 1.0f);
}

// The costs of rivals, one strip after the other.
struct Rivals {
    float least[kWholeWindows], likeness[kWholeWindows], share[kWholeWindows], nearest[kWholeWindows];
    bool alone = true;
    int num_places = 0;
};

template <int N>
TENSOR_STEREO_INLINE void search(const Search& query, const Anchor& anchor, const Comparison& near, Workspace& work,
                                 Rivals& rivals, float* curve, std::int64_t width) {
    const int count = query.count, last = count - 1;
    const int low = query.has_rows ? 0 : -kDisc, high = query.has_rows ? 0 : kDisc;
    for (int w = 0; w < kWholeWindows; ++w) {
        rivals.least[w] = kNowhere;
        rivals.likeness[w] = -1;
        rivals.share[w] = 0;
        rivals.nearest[w] = kAlone;
    }
    // Of the places of all strips: their costs, and how far they are from the match, for the nearest of the least.
    float costs[kWholeWindows][2 * kDisc + 1][2 * kDisc + 1], apart[2 * kDisc + 1][2 * kDisc + 1];
    for (int row = low; row <= high; ++row) {
        const float across = query.across + static_cast<float>(row);
        const float along = query.reverse ? -(query.start + static_cast<float>(last)) : query.start;
        const Place begin = query.other.place(query.point, along, across);
        query.other.strip(query.other.place(begin, -kWindowRadius, 0), count + 2 * kWindowRadius, work.strip);
        query.other.outside(begin, count, work.outside);
        compare<N, false>(anchor, work.strip, count, work.far);
        Comparison& far = work.far;
        for (int k = 0; k < count; ++k) {
            const int disparity = query.reverse ? last - k : k;
            const float dx = static_cast<float>(disparity) - query.own, dy = static_cast<float>(row);
            const float away = row == 0 ? std::abs(dx) : std::sqrt(dx * dx + dy * dy);
            const bool is_outside = work.outside[k] || (!query.has_rows && away > static_cast<float>(kDisc));
            const bool is_same = away <= kSame;
            if (is_outside) {
                for (int w = 0; w < kWholeWindows; ++w) {
                    far.cost[w][k] = kNowhere;
                    far.likeness[w][k] = -1;
                }
            }
            rivals.alone = rivals.alone && (is_same || is_outside);
            if (!query.has_rows) {
                apart[row + kDisc][k] = away;
                for (int w = 0; w < kWholeWindows; ++w) costs[w][row + kDisc][k] = is_same ? kNowhere : far.cost[w][k];
            }
        }
        if (row == 0) {
            for (int c = 0; c < kEvidenceCurves; ++c) {
                const float here = near.cost[kCurves[c]][kNear];
                for (int k = 0; k < count; ++k) {
                    const float cost = far.cost[kCurves[c]][query.reverse ? last - k : k];
                    curve[c * width + k] = std::clamp(cost - here, -kMaxLog, kMaxLog);
                }
                for (std::int64_t k = count; k < width; ++k) curve[c * width + k] = 0;
            }
        }
        const int own = static_cast<int>(query.own);
        for (int w = 0; w < kWholeWindows; ++w) {
            const float here = near.cost[w][kNear];
            float share = 0;
            for (int k = 0; k < count; ++k) {
                const int dx = std::abs((query.reverse ? last - k : k) - own);
                if (dx * dx + row * row <= static_cast<int>(kSame * kSame)) continue;
                const float cost = far.cost[w][k];
                rivals.least[w] = std::min(rivals.least[w], cost);
                rivals.likeness[w] = std::max(rivals.likeness[w], far.likeness[w][k]);
                share += std::clamp(((here + kGood) - cost) / (2 * kGoodWidth) + 0.5f, 0.0f, 1.0f);
            }
            rivals.share[w] += share;
        }
        rivals.num_places += count;
    }
    for (int w = 0; w < kWholeWindows; ++w) {
        const float most = rivals.least[w] + kTie;
        float nearest = kAlone;
        if (query.has_rows) {
            for (int k = 0; k < count; ++k) {
                const float away = std::abs(static_cast<float>(query.reverse ? last - k : k) - query.own);
                const float cost = away <= kSame ? kNowhere : work.far.cost[w][k];
                if (cost <= most) nearest = std::min(nearest, away);
            }
        } else {
            for (int row = 0; row <= 2 * kDisc; ++row) {
                for (int k = 0; k < count; ++k) {
                    if (costs[w][row][k] <= most) nearest = std::min(nearest, apart[row][k]);
                }
            }
        }
        rivals.nearest[w] = nearest;
        rivals.share[w] /= static_cast<float>(rivals.num_places);
    }
}

// The columns of one view; returns the disparity that its windows favour, from that of the match.
template <int N>
TENSOR_STEREO_INLINE float measure_view(const Search& query, const Anchor& anchor, const Strip& window, Workspace& work,
                                        float* values, float* curve, std::int64_t width) {
    Comparison &near = work.near, &slanted = work.slanted;
    query.other.window(query.partner, kWindowRadius + kNear, work.strip);
    compare<N, true>(anchor, work.strip, kNearPlaces, near);
    query.other.slanted(query.partner, kWindowRadius + kNear, query.shear_x, query.shear_y, work.strip);
    compare<N, false>(anchor, work.strip, kNearPlaces, slanted);
    if (query.reverse) {
        for (int w = 0; w < kNumWindows; ++w) std::reverse(near.cost[w], near.cost[w] + kNearPlaces);
        for (const int w : kSlanted) {
            std::reverse(slanted.cost[w], slanted.cost[w] + kNearPlaces);
            std::reverse(slanted.ssd[w], slanted.ssd[w] + kNearPlaces);
        }
    }
    Rivals rivals;
    search<N>(query, anchor, near, work, rivals, curve, width);
    float lowest[kNumWindows];
    for (int w = 0; w < kNumWindows; ++w) lowest[w] = *std::min_element(near.cost[w], near.cost[w] + kNearPlaces);
    float* out = values;
    for (int k = 0; k < kNearPlaces; ++k) {
        for (int w = 0; w < kWholeWindows; ++w) *out++ = near.cost[w][k] - lowest[w];
    }
    float margin[kWholeWindows];
    for (int w = 0; w < kWholeWindows; ++w) {
        margin[w] = rivals.alone ? 0 : std::clamp(rivals.least[w] - near.cost[w][kNear], -kMaxLog, kMaxLog);
    }
    for (int w = 0; w < kWholeWindows; ++w) *out++ = near.cost[w][kNear];
    for (int w = 0; w < kWholeWindows; ++w) *out++ = near.likeness[w][kNear];
    for (int w = 0; w < kWholeWindows; ++w) *out++ = margin[w];
    for (int w = 0; w < kWholeWindows; ++w) *out++ = rivals.alone ? 0 : near.likeness[w][kNear] - rivals.likeness[w];
    for (int w = 0; w < kWholeWindows; ++w) *out++ = rivals.share[w];
    for (int w = 0; w < kWholeWindows; ++w) *out++ = margin[w] >= -kTie ? 0 : scalar_logarithm(1 + rivals.nearest[w]);
    for (int w = kWholeWindows; w < kNumWindows; ++w) *out++ = near.cost[w][kNear];
    for (int w = kWholeWindows; w < kNumWindows; ++w) *out++ = near.cost[w][kNear] - lowest[w];
    for (int w = 0; w < kWholeWindows; ++w) *out++ = scalar_logarithm(1 + anchor.variance[w]);
    float gradient = 0;
    constexpr int margin_px = 3, steps = kSide - 1 - 2 * margin_px, rows = kSide - 2 * margin_px;
    for (int y = margin_px; y < margin_px + rows; ++y) {
        for (int x = margin_px; x < margin_px + steps; ++x) {
            const float step = window.row[y][x + 1] - window.row[y][x];
            gradient += step * step;
        }
    }
    *out++ = scalar_logarithm(1 + gradient / (steps * rows));
    float least[kSlantedWindows];
    for (int s = 0; s < kSlantedWindows; ++s) {
        least[s] = *std::min_element(slanted.cost[kSlanted[s]], slanted.cost[kSlanted[s]] + kNearPlaces);
    }
    for (int k = 0; k < kNearPlaces; ++k) {
        for (int s = 0; s < kSlantedWindows; ++s) *out++ = slanted.cost[kSlanted[s]][k] - least[s];
    }
    for (const Window w : kSlanted) *out++ = slanted.cost[w][kNear] - near.cost[w][kNear];
    for (const Window w : kSlanted) *out++ = slanted.likeness[w][kNear];
    float offset = 0;
    for (const Window w : kSlanted) {
        const float place = lowest_place(slanted.ssd[w]) * (1 + query.shear_x);  // whose places are that far apart
        *out++ = place;
        offset += place;
    }
    return offset / kSlantedWindows;
}

TENSOR_STEREO_INLINE float middle_level(const Strip& window) {
    float sum = 0;
    for (int y = 4; y < kSide - 4; ++y) {
        for (int x = 4; x < kSide - 4; ++x) sum += window.row[y][x];
    }
    return sum / ((kSide - 8) * (kSide - 8));
}

template <int N>
TENSOR_STEREO_INLINE void measure(const EvidencePair& pair, const EvidenceMatches& matches, std::int64_t m,
                                  Workspace& work, const Evidence& result) {
    const Place along{matches.along[2 * m], matches.along[2 * m + 1]};
    const Place points[2] = {{matches.left[2 * m], matches.left[2 * m + 1]},
                             {matches.right[2 * m], matches.right[2 * m + 1]}};
    const Look looks[2] = {{pair.view[0], pair.is_rectified, along}, {pair.view[1], pair.is_rectified, along}};
    const float disparity = bounded(matches.disparity[m]), slope_x = matches.slope[2 * m],
                slope_y = matches.slope[2 * m + 1];
    const auto count = static_cast<int>(pair.count);
    const float start = pair.has_rows ? static_cast<float>(pair.first) : std::nearbyint(disparity) - kDisc;
    const float own = std::clamp(std::nearbyint(disparity - start), -kFarPlace, kFarPlace);
    for (int v = 0; v < 2; ++v) {
        looks[v].window(points[v], kWindowRadius, work.windows[v]);
        prepare<N>(work.windows[v], work.anchor[v]);
    }
    float* const values = result.values + m * kEvidenceValues;
    float offset = 0;
    for (int v = 0; v < 2; ++v) {
        const float stretch = v == 0 ? -(1 + slope_x / 2) : 1 - slope_x / 2;
        const float across = v == 0 ? matches.across[m] : -matches.across[m];
        const Search query{looks[1 - v], points[v], points[1 - v], across, slope_x / stretch, slope_y / stretch,
                           start,        own,       count,         v == 0, pair.has_rows};
        offset += measure_view<N>(query, work.anchor[v], work.windows[v], work, values + v * kEvidenceOfView,
                                  result.curve[v] + m * kEvidenceCurves * result.width, result.width);
    }
    const float brighter = std::abs(middle_level(work.windows[0]) - middle_level(work.windows[1])) / 16;
    const float beyond = std::max(-own, 0.0f) + std::max((own - static_cast<float>(count)) + 1, 0.0f);
    values[2 * kEvidenceOfView] = brighter;
    values[2 * kEvidenceOfView + 1] = std::min(scalar_logarithm(1 + beyond), 5.0f);
    result.start[m] = start;
    result.offset[m] = offset / 2;
}

struct Job {
    const EvidencePair* pairs;
    std::int64_t num_pairs;
    const EvidenceMatches& matches;
    const Evidence& result;

    template <int N>
    TENSOR_STEREO_INLINE void run(std::int64_t b, std::int64_t m, Workspace& work) const;
};

template <int N>
TENSOR_STEREO_INLINE void Job::run(std::int64_t b, std::int64_t m, Workspace& work) const {
    measure<N>(pairs[b], matches, m, work, result);
}

}  // namespace

void window_evidence(const EvidencePair* pairs, std::int64_t num_pairs, const EvidenceMatches& matches, int num_threads,
                     const Evidence& result, Vectors vectors) {
    const Job job{pairs, num_pairs, matches, result};
    run_items(matches.ptr, num_pairs, num_threads, vectors, job, [] { return std::make_unique<Workspace>(); });
}

}  // namespace tensor_stereo
