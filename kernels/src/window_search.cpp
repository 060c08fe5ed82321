#include "tensor_stereo/window_search.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <vector>

#include "dispatch.hpp"
#include "lanes.hpp"
#include "window_comparison.hpp"
#include "window_sampling.hpp"

namespace tensor_stereo {
namespace {

constexpr float kNowhere = 40;       // log SSD of a place that is not looked at
constexpr float kLeastBend = 0.03f;  // of the parabola through three SSDs, of the least one; less is noise

struct Workspace {
    Strip window, strip;
    Anchor anchor;
    Comparison found;
    std::vector<float> cost;  // by place from the first disparity, also of the neighbours of allowed ones
    std::unique_ptr<bool[]> allowed, wanted, outside;
    std::int64_t size = 0;

    void reserve(std::int64_t count) {
        if (count <= size) return;
        cost.resize(count);
        allowed = std::make_unique<bool[]>(count);
        wanted = std::make_unique<bool[]>(count);
        outside = std::make_unique<bool[]>(count);
        size = count;
    }
};

struct Job {
    const SearchPair* pairs;
    std::int64_t num_pairs;
    const SearchKeypoints& keypoints;
    float near_px;
    float* disparity;
    bool* found;

    template <int N>
    TENSOR_STEREO_INLINE void run(std::int64_t b, std::int64_t t, Workspace& work) const;
};

template <int N>
TENSOR_STEREO_INLINE void search_keypoint(const SearchPair& pair, const Job& job, std::int64_t t, Workspace& work) {
    const Place along{job.keypoints.along[2 * t], job.keypoints.along[2 * t + 1]};
    const Place point{job.keypoints.points[2 * t], job.keypoints.points[2 * t + 1]};
    const Look own(pair.view[0], pair.is_rectified, along), other(pair.view[1], pair.is_rectified, along);
    own.window(point, kWindowRadius, work.window);
    prepare<N>(work.window, work.anchor);
    const auto count = static_cast<int>(pair.count), last = count - 1;
    // Places go along the columns of view 1, against the disparities.
    const float greatest = static_cast<float>(pair.first) + static_cast<float>(last);
    const Place begin = other.place(point, -greatest, job.keypoints.across[t]);
    other.outside(begin, count, work.outside.get());
    std::fill_n(work.wanted.get(), count, false);
    bool is_any = false;
    for (int k = 0; k < count; ++k) {
        const float disparity = greatest - static_cast<float>(k);
        bool is_near = false;
        for (std::int64_t p = 0; p < job.keypoints.num_predictions; ++p) {
            const float away = disparity - job.keypoints.predicted[t * job.keypoints.num_predictions + p];
            is_near = is_near || std::abs(away) <= job.near_px;
        }
        work.allowed[k] = is_near && !work.outside[k];
        is_any = is_any || work.allowed[k];
        if (is_near)
            std::fill(work.wanted.get() + std::max(k - 1, 0), work.wanted.get() + std::min(k + 2, count), true);
    }
    job.found[t] = is_any;
    if (!is_any) {  // the middle of the first three, as of places that all cost the same
        job.disparity[t] = static_cast<float>(pair.first + 1);
        return;
    }
    // The parabola needs the neighbours of the best place, and the best place is never the first or the last.
    for (const int k : {0, 1, 2, last - 2, last - 1, last}) work.wanted[std::clamp(k, 0, last)] = true;
    for (int first = 0; first < count; first += kMaxPlaces) {
        const int some = std::min(count - first, kMaxPlaces);
        const Place start = other.place(begin, static_cast<float>(first - kWindowRadius), 0);
        other.strip(start, some + 2 * kWindowRadius, work.strip);
        for (int k = 0; k < some; k += N) {
            const int end = std::min(k + N, some);
            if (std::none_of(work.wanted.get() + first + k, work.wanted.get() + first + end,
                             [](bool is) { return is; })) {
                continue;
            }
            compare_lanes<N, false>(work.anchor, work.strip, k, work.found);
            for (int l = k; l < end; ++l) {
                work.cost[first + l] = (work.found.cost[kLike][l] + work.found.cost[kTight][l]) * 0.5f;
            }
        }
    }
    int best = last;
    float least = kNowhere;
    for (int k = last; k >= 0; --k) {
        const float cost = work.allowed[k] ? work.cost[k] : kNowhere;
        if (cost < least) {
            least = cost;
            best = k;
        }
    }
    best = std::clamp(best, 1, last - 1);
    // The SSDs relative to the best one; their logarithms differ by little more where it matters.
    const auto ssd = [&](int k) {
        Lanes<4> difference = Lanes<4>{} + std::min(work.cost[k] - work.cost[best], 40.0f);
        const bool is_more = difference[0] > 0;
        difference = is_more ? -difference : difference;
        exponential(difference);
        return is_more ? 1 / difference[0] : difference[0];
    };
    const float before = ssd(best + 1), after = ssd(best - 1);
    const float bend = std::max((before - 2) + after, kLeastBend);
    const float step = std::clamp((before - after) / (2 * bend), -0.5f, 0.5f);
    job.disparity[t] = (greatest - static_cast<float>(best)) + step;
}

template <int N>
TENSOR_STEREO_INLINE void Job::run(std::int64_t b, std::int64_t t, Workspace& work) const {
    search_keypoint<N>(pairs[b], *this, t, work);
}

}  // namespace

void window_search(const SearchPair* pairs, std::int64_t num_pairs, const SearchKeypoints& keypoints, float near_px,
                   int num_threads, float* disparity, bool* found, Vectors vectors) {
    std::int64_t most = 0;
    for (std::int64_t b = 0; b < num_pairs; ++b) most = std::max(most, pairs[b].count);
    const Job job{pairs, num_pairs, keypoints, near_px, disparity, found};
    run_items(keypoints.ptr, num_pairs, num_threads, vectors, job, [most] {
        auto work = std::make_unique<Workspace>();
        work->reserve(most);
        return work;
    });
}

}  // namespace tensor_stereo
