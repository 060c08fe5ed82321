// How far a match is from the plane through the disparities of its trusted neighbours.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "dense_layers.hpp"
#include "lanes.hpp"
#include "learned_links.hpp"

namespace tensor_stereo::learned {

constexpr float kRidge = 0.3f;  // squared mean distances to neighbours; flattens planes that too few neighbours hold
constexpr float kMaxGapPx = 64;
constexpr float kSoftness = 0.15f;  // of a tolerance, over which a miss passes from within to beyond
constexpr float kTolerancesPx[kTolerances] = {0.5f, 1, 2, 3, 5};

// Sums over the neighbours of a match, for its plane: 1, x x, x y, y y, x, y, gap x, gap y, gap.
constexpr int kSums = 9;

// How far each match is from the plane through its trusted neighbours; `columns` has room for kRefinedPlanes each.
template <int N>
TENSOR_STEREO_INLINE void measure_planes(const Workspace& work, std::int64_t count, bool is_refined,
                                         std::vector<float>& columns) {
    using V = Lanes<N>;
    constexpr int kStep = padded(kRefinedPlanes);
    const std::vector<float>& other = is_refined ? work.refined : work.disparity;
    const std::int64_t room = (count + kMaxLanes - 1) / kMaxLanes * kMaxLanes;
    std::vector<float> sums(room * kSums);  // sum by sum
    for (const Link& link : work.links) {
        const std::int64_t ends[2] = {link.i, link.j};
        for (int e = 0; e < 2; ++e) {
            const std::int64_t near = ends[e], far = ends[1 - e];
            const float sign = e == 0 ? 1.0f : -1.0f, trust = work.belief[far];
            const float x = link.step_x, y = link.step_y;
            const float gap = std::clamp(other[far] - work.disparity[near], -kMaxGapPx, kMaxGapPx);
            const float terms[kSums] = {1,        x * x,          x * y,          y * y, sign * x,
                                        sign * y, sign * gap * x, sign * gap * y, gap};
            for (int k = 0; k < kSums; ++k) sums[k * room + near] += terms[k] * trust;
        }
    }
    columns.resize(room * kStep);
    for (std::int64_t first = 0; first < count; first += N) {
        V s[kSums];
        for (int k = 0; k < kSums; ++k) load(sums.data() + k * room + first, s[k]);
        const V total = s[0], safe = total + 0.01f;
        const V mean_x = s[4] / safe, mean_y = s[5] / safe, mean_gap = s[8] / safe;
        const V xx = s[1] - total * mean_x * mean_x + kRidge, yy = s[3] - total * mean_y * mean_y + kRidge;
        const V xy = s[2] - total * mean_x * mean_y;
        const V gx = s[6] - total * mean_gap * mean_x, gy = s[7] - total * mean_gap * mean_y;
        const V determinant = limited(xx * yy - xy * xy, 1e-3f, 3e38f);
        const V slope_x = (gx * yy - gy * xy) / determinant, slope_y = (gy * xx - gx * xy) / determinant;
        const V residual[2] = {magnitude(mean_gap - slope_x * mean_x - slope_y * mean_y), magnitude(mean_gap)};
        V found[kRefinedPlanes];
        int k = 0;
        if (is_refined) {
            for (const float t : kTolerancesPx) found[k++] = sigmoid((1.0f - residual[0] / t) * (1 / kSoftness));
        }
        for (const V& miss : residual) {
            for (const float scale : {0.7f, 2.0f, 6.0f}) found[k++] = exp_of(-(miss / scale));
            found[k++] = log_of(1.0f + miss);
        }
        found[k++] = log_of(1.0f + total);
        const std::int64_t some = std::min<std::int64_t>(N, count - first);
        for (int c = 0; c < k; ++c) {
            alignas(64) float column[N];
            store(found[c], column);
            for (std::int64_t l = 0; l < some; ++l) columns[(first + l) * kStep + c] = column[l];
        }
    }
}

}  // namespace tensor_stereo::learned
