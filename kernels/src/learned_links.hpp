// What the learned score's network sees of a pair: its matches and the links between neighbours.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "dense_layers.hpp"
#include "lanes.hpp"
#include "learned_layers.hpp"

namespace tensor_stereo::learned {

constexpr float kTinyPx2 = 1e-6f;  // added to squared lengths

// What lies between two neighbours.
struct Link {
    std::int64_t i, j;
    float in0, in1;
    float edge[kEdges];                                // normalised
    float odd[kOdd];                                   // from i to j
    float image_i[kEdgeImages], image_j[kEdgeImages];  // normalised
    float way_x, way_y, length;                        // px of view 0
    float step_x, step_y;                              // the same over the mean distance of both to their neighbours
};

struct Workspace {
    std::vector<Link> links;
    std::vector<float> points[2], disparity, refined, mean_length, degree, has_image, cost;
    std::vector<float> state, hear, tell, heard, belief, plane, refined_plane;
    std::vector<std::int64_t> order;
};

struct Job {
    const Layers& layers;
    const LearnedInputs& inputs;
    std::int64_t num_pairs;
    float* logits;
};

// One pair, whose matches are rows start to start + count of the whole.
struct Pair {
    const Job& job;
    std::int64_t start, count, b;
    bool has_images;
};

// Points and disparities less their means.
TENSOR_STEREO_INLINE void center(const Pair& pair, Workspace& work) {
    const LearnedInputs& given = pair.job.inputs;
    double mean[2][2] = {}, mean_disparity = 0;
    for (int v = 0; v < 2; ++v) {
        for (std::int64_t m = 0; m < pair.count; ++m) {
            for (int k = 0; k < 2; ++k) mean[v][k] += given.points[v][2 * (pair.start + m) + k];
        }
        for (double& value : mean[v]) value /= static_cast<double>(pair.count);
        work.points[v].resize(2 * pair.count);
        for (std::int64_t k = 0; k < 2 * pair.count; ++k) {
            work.points[v][k] = static_cast<float>(given.points[v][2 * pair.start + k] - mean[v][k % 2]);
        }
    }
    work.disparity.resize(pair.count);
    work.refined.resize(pair.count);
    for (std::int64_t m = 0; m < pair.count; ++m) {
        mean_disparity += given.points[0][2 * (pair.start + m)] - given.points[1][2 * (pair.start + m)];
    }
    mean_disparity /= static_cast<double>(pair.count);
    for (std::int64_t m = 0; m < pair.count; ++m) {
        const double own = given.points[0][2 * (pair.start + m)] - given.points[1][2 * (pair.start + m)];
        work.disparity[m] = static_cast<float>(own - mean_disparity);
        work.refined[m] = work.disparity[m] + (pair.has_images ? given.offset[pair.start + m] : 0);
    }
}

// Pairs i < j that are neighbours in either view.
TENSOR_STEREO_INLINE void find_links(const Pair& pair, Workspace& work) {
    const LearnedInputs& given = pair.job.inputs;
    work.links.clear();
    for (std::int64_t m = 0; m < pair.count; ++m) {
        const std::int64_t row = pair.start + m;
        std::int64_t at[2], end[2];
        for (int v = 0; v < 2; ++v) {
            at[v] = given.crow[v][row];
            end[v] = given.crow[v][row + 1];
            while (at[v] < end[v] && given.cols[v][at[v]] <= row) ++at[v];
        }
        while (at[0] < end[0] || at[1] < end[1]) {
            const bool is_in0 = at[0] < end[0] && (at[1] >= end[1] || given.cols[0][at[0]] <= given.cols[1][at[1]]);
            const bool is_in1 = at[1] < end[1] && (at[0] >= end[0] || given.cols[1][at[1]] <= given.cols[0][at[0]]);
            Link link;
            link.i = m;
            link.j = given.cols[is_in0 ? 0 : 1][at[is_in0 ? 0 : 1]] - pair.start;
            link.in0 = is_in0;
            link.in1 = is_in1;
            at[0] += is_in0;
            at[1] += is_in1;
            work.links.push_back(link);
        }
    }
}

// Quantities of N links at a time.
template <int N>
TENSOR_STEREO_INLINE void measure_links(const Pair& pair, Workspace& work) {
    using V = Lanes<N>;
    const Weights& scales = pair.job.layers.scales;
    const float *const left = work.points[0].data(), *const right = work.points[1].data();
    const auto size = static_cast<std::int64_t>(work.links.size());
    for (std::int64_t first = 0; first < size; first += N) {
        const int some = static_cast<int>(std::min<std::int64_t>(N, size - first));
        alignas(64) float x0[N] = {}, y0[N] = {}, x1[N] = {}, y1[N] = {}, in0[N] = {}, in1[N] = {};
        alignas(64) float fine[N] = {};
        for (int l = 0; l < some; ++l) {
            const Link& link = work.links[first + l];
            x0[l] = left[2 * link.j] - left[2 * link.i];
            y0[l] = left[2 * link.j + 1] - left[2 * link.i + 1];
            x1[l] = right[2 * link.j] - right[2 * link.i];
            y1[l] = right[2 * link.j + 1] - right[2 * link.i + 1];
            in0[l] = link.in0;
            in1[l] = link.in1;
            fine[l] = std::abs(work.refined[link.j] - work.refined[link.i]);
        }
        V a, b, c, d, first_view, other_view, apart;
        load(x0, a), load(y0, b), load(x1, c), load(y1, d);
        load(in0, first_view), load(in1, other_view), load(fine, apart);
        const V length0 = root_of(a * a + b * b + kTinyPx2), length1 = root_of(c * c + d * d + kTinyPx2);
        const V step = a - c, gap = magnitude(step), row_gap = magnitude(b - d);
        const V log_length = log_of(length0), relative = gap / length0, same = exp_of(gap * (1 / -0.7f));
        const V columns[kEdges] = {same,
                                   exp_of(gap * -0.5f),
                                   exp_of(gap * (-1 / 6.0f)),
                                   log_of(1.0f + gap),
                                   limited(relative, 0, 2),
                                   exp_of(-8.0f * relative),
                                   exp_of(-row_gap),
                                   log_of(1.0f + row_gap),
                                   first_view,
                                   other_view,
                                   log_length,
                                   log_of(length1) - log_length,
                                   same * first_view * other_view,
                                   magnitude(b) / length0,
                                   tanh_of(step * 0.25f) * a / length0};
        const V odd[kOdd] = {tanh_of(step * 0.5f), tanh_of(step * 0.125f)};
        const V long0 = limited(length0, 1, 3e38f);
        const V fine_columns[kRefined] = {exp_of(apart * (1 / -0.3f)), exp_of(-apart), log_of(1.0f + apart),
                                          exp_of(-27.0f * apart / long0)};
        alignas(64) float told[kEdges][N], odds[kOdd][N], refined[kRefined][N], lengths[N];
        for (int k = 0; k < kEdges; ++k) {
            const float mean = scales.edges.mean[k], scale = scales.edges.scale[k];
            store(limited(columns[k] * scale - mean * scale, -4, 4), told[k]);
        }
        for (int k = 0; k < kOdd; ++k) store(odd[k], odds[k]);
        for (int k = 0; k < kRefined; ++k) store(fine_columns[k], refined[k]);
        store(length0, lengths);
        for (int l = 0; l < some; ++l) {
            Link& link = work.links[first + l];
            for (int k = 0; k < kEdges; ++k) link.edge[k] = told[k][l];
            for (int k = 0; k < kOdd; ++k) link.odd[k] = odds[k][l];
            link.way_x = x0[l];
            link.way_y = y0[l];
            link.length = lengths[l];
            for (int k = 0; k < kRefined; ++k) {
                link.image_i[2 * kCurves + 1 + k] = link.image_j[2 * kCurves + 1 + k] = refined[k][l];
            }
        }
    }
}

// Would the disparity of `far` explain the windows of `near` better, in either view, and was it searched?
TENSOR_STEREO_INLINE void look_up(const Pair& pair, std::int64_t near, std::int64_t far, float* columns) {
    const LearnedInputs& given = pair.job.inputs;
    near += pair.start;
    far += pair.start;
    const double other = given.points[0][2 * far] - given.points[1][2 * far];
    const double own = given.points[0][2 * near] - given.points[1][2 * near];
    const double column = std::nearbyint(other - given.first[near]);
    const bool is_known = column >= 0 && column < static_cast<double>(given.num_columns[near]);
    const bool is_far = is_known && std::abs(other - own) >= 0.5;
    for (int v = 0; v < 2; ++v) {
        for (int c = 0; c < kCurves; ++c) {
            const std::int64_t place =
                (near * kCurves + c) * given.width + (is_far ? static_cast<std::int64_t>(column) : 0);
            columns[v * kCurves + c] = is_far ? given.curve[v][place] : 0;
        }
    }
    columns[2 * kCurves] = is_known;
}

TENSOR_STEREO_INLINE void look_at_links(const Pair& pair, Workspace& work) {
    const Weights& scales = pair.job.layers.scales;
    for (Link& link : work.links) {
        const std::int64_t ends[2] = {link.i, link.j};
        for (int e = 0; e < 2; ++e) {
            float* const columns = e == 0 ? link.image_i : link.image_j;
            if (!pair.has_images) {
                std::fill_n(columns, kEdgeImages, 0.0f);
                continue;
            }
            look_up(pair, ends[e], ends[1 - e], columns);
            // as in training, both ends count only where the first one has images
            const float here = work.has_image[link.i];
            for (int k = 0; k < kEdgeImages; ++k) columns[k] = normalize(columns[k], scales.edge_image, k) * here;
        }
    }
}

// Degrees, mean distances to neighbours, and the ways over these.
TENSOR_STEREO_INLINE void scale_steps(Workspace& work, std::int64_t count) {
    work.degree.assign(count, 0);
    work.mean_length.assign(count, 0);
    for (const Link& link : work.links) {
        for (const std::int64_t m : {link.i, link.j}) {
            work.degree[m] += 1;
            work.mean_length[m] += link.length;
        }
    }
    for (std::int64_t m = 0; m < count; ++m) {
        work.degree[m] = std::max(work.degree[m], 1.0f);
        work.mean_length[m] = std::max(work.mean_length[m] / work.degree[m], 1e-3f);
    }
    for (Link& link : work.links) {
        const float factor = work.mean_length[link.i] + work.mean_length[link.j];
        link.step_x = std::clamp(2 * link.way_x / factor, -4.0f, 4.0f);
        link.step_y = std::clamp(2 * link.way_y / factor, -4.0f, 4.0f);
    }
}

}  // namespace tensor_stereo::learned
