#include "tensor_stereo/window_refine.hpp"

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

constexpr int kSteps = 4;
constexpr float kLongest = 0.5f;  // px, of a step
constexpr float kApart = 0.25f;   // px, of the samples that give the slope of the grey levels
constexpr float kDamping = 1;     // grey levels squared per px squared; flat windows stay
constexpr float kNumPixels = 40;  // that tell independently, of a window

struct Pixels {
    alignas(64) float value[kPaddedPixels];
};

struct Workspace {
    Strip strip;
    Anchor anchor;
    Pixels here, ahead, back;
};

struct Job {
    const RefinePair* pairs;
    std::int64_t num_pairs;
    const RefineMatches& matches;
    float max_shift;
    const Refined& result;

    template <int N>
    TENSOR_STEREO_INLINE void run(std::int64_t b, std::int64_t m, Workspace& work) const;
};

// One match, whose window of view 0 is prepared.
struct Match {
    const Look& other;
    Place partner;
    float shear_x, shear_y;
};

// Differences of the windows where the partner has moved, less their weighted mean.
template <int N>
TENSOR_STEREO_INLINE void differ(const Match& match, float along, float across, const Anchor& anchor, Strip& strip,
                                 Pixels& result) {
    match.other.slanted(match.other.place(match.partner, along, across), kWindowRadius, match.shear_x, match.shear_y,
                        strip);
    for (int y = 0; y < kSide; ++y) {
        for (int x = 0; x < kSide; ++x) {
            const int k = y * kSide + x;
            result.value[k] = (anchor.pixel[k] + anchor.level) - strip.row[y][x];
        }
    }
    for (int k = kPixels; k < kPaddedPixels; ++k) result.value[k] = 0;
    const float mean = sum_pixels<N>([&](int k) { return read<N>(anchor.tight + k) * read<N>(result.value + k); });
    for (int k = 0; k < kPaddedPixels; k += N) store(read<N>(result.value + k) - mean, result.value + k);
}

template <int N>
TENSOR_STEREO_INLINE float weighted_ssd(const Anchor& anchor, const Pixels& difference) {
    return sum_pixels<N>([&](int k) {
        const Lanes<N> value = read<N>(difference.value + k);
        return read<N>(anchor.tight + k) * (value * value);
    });
}

template <int N>
TENSOR_STEREO_INLINE void refine(const RefinePair& pair, const Job& job, std::int64_t m, Workspace& work) {
    const RefineMatches& matches = job.matches;
    const Place axis{matches.along[2 * m], matches.along[2 * m + 1]};
    const Look own(pair.view[0], pair.is_rectified, axis), other(pair.view[1], pair.is_rectified, axis);
    const float half_x = matches.slope[2 * m] / 2, half_y = matches.slope[2 * m + 1] / 2;
    own.slanted({matches.left[2 * m], matches.left[2 * m + 1]}, kWindowRadius, half_x, half_y, work.strip);
    prepare<N>(work.strip, work.anchor);
    const Anchor& anchor = work.anchor;
    const Match match{other, {matches.right[2 * m], matches.right[2 * m + 1]}, -half_x, -half_y};
    const float off_line = matches.off_line[m];
    const float across = std::abs(off_line) <= job.max_shift ? -off_line : 0;
    const float limit = std::sqrt(std::max(job.max_shift * job.max_shift - across * across, 0.0f));
    float along = 0, bend = 0;
    for (int step = 0; step < kSteps; ++step) {
        differ<N>(match, along + kApart, across, anchor, work.strip, work.ahead);
        differ<N>(match, along - kApart, across, anchor, work.strip, work.back);
        differ<N>(match, along, across, anchor, work.strip, work.here);
        const auto slope = [&](int k) {
            return (read<N>(work.back.value + k) - read<N>(work.ahead.value + k)) / (2 * kApart);
        };
        bend = sum_pixels<N>([&](int k) {
            const Lanes<N> steep = slope(k);
            return read<N>(anchor.tight + k) * (steep * steep);
        });
        const float pull =
            sum_pixels<N>([&](int k) { return read<N>(anchor.tight + k) * slope(k) * read<N>(work.here.value + k); });
        along = along + std::clamp(pull / (bend + kDamping), -kLongest, kLongest);
        along = std::clamp(along, -limit, limit);
    }
    differ<N>(match, 0, 0, anchor, work.strip, work.back);
    differ<N>(match, along, across, anchor, work.strip, work.here);
    const float before = weighted_ssd<N>(anchor, work.back), after = weighted_ssd<N>(anchor, work.here);
    const bool is_better = after <= before;
    job.result.along[m] = is_better ? along : 0;
    job.result.across[m] = is_better ? across : 0;
    job.result.variance[m] = (after + kNoiseVariance) / (bend + 1e-3f) / kNumPixels;
}

template <int N>
TENSOR_STEREO_INLINE void Job::run(std::int64_t b, std::int64_t m, Workspace& work) const {
    refine<N>(pairs[b], *this, m, work);
}

}  // namespace

void window_refine(const RefinePair* pairs, std::int64_t num_pairs, const RefineMatches& matches, float max_shift,
                   int num_threads, const Refined& result, Vectors vectors) {
    const Job job{pairs, num_pairs, matches, max_shift, result};
    run_items(matches.ptr, num_pairs, num_threads, vectors, job, [] { return std::make_unique<Workspace>(); });
}

}  // namespace tensor_stereo
