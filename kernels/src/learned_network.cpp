#include "tensor_stereo/learned_network.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <vector>

#include "dense_layers.hpp"
#include "dispatch.hpp"
#include "lanes.hpp"
#include "tensor_stereo/parallel.hpp"

namespace tensor_stereo {
namespace {

using namespace learned;

constexpr float kTinyPx2 = 1e-6f;  // added to squared lengths
constexpr float kRidge = 0.3f;     // squared mean distances to neighbours; flattens planes that too few neighbours hold
constexpr float kMaxGapPx = 64;
constexpr float kSoftness = 0.15f;  // of a tolerance, over which a miss passes from within to beyond
constexpr float kTolerancesPx[kTolerances] = {0.5f, 1, 2, 3, 5};
constexpr int kSpace = padded(kWidth);

// The weights as the layers want them.
struct Layers {
    struct MessageRound {
        Dense<kWidth, kMessage> hear, tell;
        Dense<kEdges, kMessage> edge;
        Dense<kOdd, kMessage> odd;
        Dense<kEdgeImages, kMessage> edge_image;
        Dense<kWidth, 1> belief;
        Dense<kWidth, kWidth> mix_state, whole, out;
        Dense<kMessage, kWidth> mix_heard;
        Dense<kPlanes, kWidth> mix_plane;
        Dense<kRefinedPlanes, kWidth> mix_refined;
        Scale norm;
    };

    explicit Layers(const Weights& given)
        : enter(given.enter),
          enter_image(given.enter_image),
          enter_image_out(given.enter_image_out),
          enter_out(given.enter_out),
          head(given.head),
          head_whole(given.head_whole),
          last(given.last),
          scales(given) {
        for (int r = 0; r < kRounds; ++r) rounds.push_back(make_round(given.rounds[r], r > 1));
    }

    static MessageRound make_round(const Round& given, bool has_plane) {
        const int columns = kWidth + kMessage + (has_plane ? kPlanes : 0);
        std::vector<float> parts[3];
        const int sizes[] = {kWidth, kMessage, kPlanes};
        int first = 0;
        for (int p = 0; p < 3; ++p) {
            parts[p].resize(kWidth * sizes[p]);
            for (int o = 0; o < kWidth && first < columns; ++o) {
                std::copy_n(given.mix.weight + o * columns + first, sizes[p], parts[p].data() + o * sizes[p]);
            }
            first += sizes[p];
        }
        const std::vector<float> none(kWidth * kRefinedPlanes);
        const Linear refined{has_plane ? given.mix_refined.weight : none.data(), nullptr};
        return {Dense<kWidth, kMessage>({given.ends.weight, given.ends.bias}),
                Dense<kWidth, kMessage>({given.ends.weight + kMessage * kWidth, given.ends.bias + kMessage}),
                Dense<kEdges, kMessage>(given.edge),
                Dense<kOdd, kMessage>(given.odd),
                Dense<kEdgeImages, kMessage>(given.edge_image),
                Dense<kWidth, 1>(given.belief),
                Dense<kWidth, kWidth>({parts[0].data(), given.mix.bias}),
                Dense<kWidth, kWidth>(given.whole),
                Dense<kWidth, kWidth>(given.out),
                Dense<kMessage, kWidth>({parts[1].data(), nullptr}),
                Dense<kPlanes, kWidth>({parts[2].data(), nullptr}),
                Dense<kRefinedPlanes, kWidth>(refined),
                given.norm};
    }

    Dense<kNodes + kCosts + 2, kWidth> enter;
    Dense<kImages, kWidth> enter_image;
    Dense<kWidth, kWidth> enter_image_out, enter_out, head, head_whole;
    Dense<kWidth, kTolerances> last;
    std::vector<MessageRound> rounds;
    const Weights& scales;
};

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

// (count, 2) rank within the pair and log cost over its mean, normalised; false if some cost is not finite.
TENSOR_STEREO_INLINE bool rank_costs(const Pair& pair, Workspace& work) {
    work.cost.assign(kCosts * pair.count, 0);
    if (pair.job.inputs.cost == nullptr) return false;
    const double* const cost = pair.job.inputs.cost + pair.start;
    double least = 0;
    for (std::int64_t m = 0; m < pair.count; ++m) {
        if (!std::isfinite(cost[m])) return false;
        least = std::min(least, cost[m]);
    }
    work.order.resize(pair.count);
    for (std::int64_t m = 0; m < pair.count; ++m) work.order[m] = m;
    std::sort(work.order.begin(), work.order.end(),
              [cost](std::int64_t a, std::int64_t b) { return cost[a] < cost[b]; });
    double mean = 0;
    std::vector<double> logs(pair.count);
    for (std::int64_t m = 0; m < pair.count; ++m) mean += logs[m] = std::log(cost[m] - least + 1e-3);
    mean /= static_cast<double>(pair.count);
    const Scale& scale = pair.job.layers.scales.cost;
    for (std::int64_t begin = 0; begin < pair.count;) {
        std::int64_t end = begin + 1;
        while (end < pair.count && cost[work.order[end]] == cost[work.order[begin]]) ++end;
        const double middle = 0.5 * static_cast<double>(begin + end - 1);
        for (; begin < end; ++begin) {
            const std::int64_t m = work.order[begin];
            const double rank = (middle + 0.5) / static_cast<double>(pair.count);
            work.cost[kCosts * m] = normalize(static_cast<float>(rank), scale, 0);
            work.cost[kCosts * m + 1] = normalize(static_cast<float>(std::clamp(logs[m] - mean, -5.0, 5.0)), scale, 1);
        }
    }
    return true;
}

// The state of every match before it hears from others.
template <int N>
TENSOR_STEREO_INLINE void enter(const Pair& pair, Workspace& work) {
    const Job& job = pair.job;
    const LearnedInputs& given = job.inputs;
    const Layers& layers = job.layers;
    const bool has_cost = rank_costs(pair, work);
    std::vector<float>& overlap = work.belief;  // not in use yet
    overlap.assign(pair.count, 0);
    for (const Link& link : work.links) {
        const float shared = link.in0 * link.in1;
        overlap[link.i] += shared;
        overlap[link.j] += shared;
    }
    for (std::int64_t m = 0; m < pair.count; ++m) {
        const std::int64_t row = pair.start + m;
        const auto degree0 = static_cast<float>(given.crow[0][row + 1] - given.crow[0][row]);
        const auto degree1 = static_cast<float>(given.crow[1][row + 1] - given.crow[1][row]);
        const auto off = static_cast<float>(std::abs(given.points[0][2 * row + 1] - given.points[1][2 * row + 1]));
        const float rows = given.has_rows[pair.b] ? 1 : 0;
        Lanes<4> falls = {-2 * off, -off / 2, 0, 0};
        exponential(falls);
        Lanes<4> logs = {1 + degree0, 1 + degree1, 1 + off, 1 + overlap[m]};
        logarithm(logs);
        alignas(64) float in[padded(kNodes + kCosts + 2)] = {overlap[m] / work.degree[m],
                                                             overlap[m] / std::max(std::min(degree0, degree1), 1.0f),
                                                             logs[0],
                                                             logs[1],
                                                             falls[0] * rows,
                                                             falls[1] * rows,
                                                             logs[2] * rows,
                                                             logs[3]};
        for (int k = 0; k < kNodes; ++k) in[k] = normalize(in[k], layers.scales.nodes, k);
        for (int k = 0; k < kCosts; ++k) in[kNodes + k] = has_cost ? work.cost[kCosts * m + k] : 0;
        in[kNodes + kCosts] = has_cost;
        in[kNodes + kCosts + 1] = work.has_image[m];
        alignas(64) float entered[kSpace], hidden[kSpace], seen[kSpace];
        layers.enter.apply<N>(in, entered);
        if (pair.has_images && work.has_image[m] > 0) {
            alignas(64) float image[kImages];
            for (int k = 0; k < kImages; ++k)
                image[k] = normalize(given.image[row * kImages + k], layers.scales.image, k);
            layers.enter_image.apply<N>(image, hidden);
            relu<kSpace>(hidden);
            layers.enter_image_out.apply<N>(hidden, seen);
            for (int k = 0; k < kSpace; ++k) entered[k] += seen[k];
        }
        relu<kSpace>(entered);
        layers.enter_out.apply<N>(entered, work.state.data() + m * kSpace);
    }
}

// The sum of the state of a match, whose padding is zero.
template <int N>
TENSOR_STEREO_INLINE float sum_of(const float* values) {
    Lanes<N> sum = {};
    for (int k = 0; k < kSpace; k += N) {
        Lanes<N> part;
        load(values + k, part);
        sum += part;
    }
    alignas(64) float lane[N];
    store(sum, lane);
    for (int half = N / 2; half > 0; half /= 2) {
        for (int l = 0; l < half; ++l) lane[l] += lane[l + half];
    }
    return lane[0];
}

template <int N>
TENSOR_STEREO_INLINE void mean_state(const Workspace& work, std::int64_t count, float* mean) {
    constexpr int kParts = kSpace / N;
    Lanes<N> sum[kParts] = {};
    for (std::int64_t m = 0; m < count; ++m) {
        for (int p = 0; p < kParts; ++p) {
            Lanes<N> part;
            load(work.state.data() + m * kSpace + p * N, part);
            sum[p] += part;
        }
    }
    for (int p = 0; p < kParts; ++p) store(sum[p] / static_cast<float>(count), mean + p * N);
}

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

template <int N>
TENSOR_STEREO_INLINE void pass_messages(const Layers::MessageRound& round, bool has_plane, const Pair& pair,
                                        Workspace& work) {
    constexpr int kMessageSpace = padded(kMessage), kStep = padded(kRefinedPlanes);
    const std::int64_t count = pair.count;
    alignas(64) float mean[kSpace], whole[kSpace];
    mean_state<N>(work, count, mean);
    round.whole.apply<N>(mean, whole);
    work.hear.resize(count * kMessageSpace);
    work.tell.resize(count * kMessageSpace);
    work.heard.assign(count * kMessageSpace, 0);
    for (std::int64_t m = 0; m < count; ++m) {
        round.hear.apply<N>(work.state.data() + m * kSpace, work.hear.data() + m * kMessageSpace);
        round.tell.apply<N>(work.state.data() + m * kSpace, work.tell.data() + m * kMessageSpace);
    }
    for (const Link& link : work.links) {
        constexpr int kParts = Dense<kEdges, kMessage>::parts<N>;
        Lanes<N> between[kParts] = {}, odd[kParts] = {};
        round.edge.template add<N>(link.edge, between);
        round.odd.template add<N>(link.odd, odd);
        const std::int64_t ends[2] = {link.i, link.j};
        for (int e = 0; e < 2; ++e) {
            const float* const hear = work.hear.data() + ends[e] * kMessageSpace;
            const float* const tell = work.tell.data() + ends[1 - e] * kMessageSpace;
            Lanes<N> to[kParts];
            for (int p = 0; p < kParts; ++p) {
                Lanes<N> mine, other;
                load(hear + p * N, mine);
                load(tell + p * N, other);
                to[p] = between[p] + mine + other + (e == 0 ? odd[p] : -odd[p]);
            }
            if (pair.has_images) round.edge_image.template add<N>(e == 0 ? link.image_i : link.image_j, to);
            float* const heard = work.heard.data() + ends[e] * kMessageSpace;
            for (int p = 0; p < kParts; ++p) {
                Lanes<N> sum;
                load(heard + p * N, sum);
                store(sum + (to[p] > 0.0f ? to[p] : Lanes<N>{}), heard + p * N);
            }
        }
    }
    if (has_plane) {
        work.belief.resize((count + kMaxLanes - 1) / kMaxLanes * kMaxLanes);
        for (std::int64_t m = 0; m < count; ++m) {
            alignas(64) float belief[padded(1)];
            round.belief.apply<N>(work.state.data() + m * kSpace, belief);
            work.belief[m] = belief[0];
        }
        for (std::int64_t m = 0; m < count; m += N) {
            Lanes<N> logit;
            load(work.belief.data() + m, logit);
            store(sigmoid(logit), work.belief.data() + m);
        }
        measure_planes<N>(work, count, false, work.plane);
        if (pair.has_images) measure_planes<N>(work, count, true, work.refined_plane);
    }
    for (std::int64_t m = 0; m < count; ++m) {
        float* const state = work.state.data() + m * kSpace;
        float* const heard = work.heard.data() + m * kMessageSpace;
        for (int k = 0; k < kMessageSpace; ++k) heard[k] /= work.degree[m];
        alignas(64) float mixed[kSpace], out[kSpace];
        round.mix_state.apply<N>(state, mixed);
        round.mix_heard.add<N>(heard, mixed);
        for (int k = 0; k < kSpace; ++k) mixed[k] += whole[k];
        if (has_plane) {
            round.mix_plane.add<N>(work.plane.data() + m * kStep, mixed);
            if (pair.has_images && work.has_image[m] > 0) {
                round.mix_refined.add<N>(work.refined_plane.data() + m * kStep, mixed);
            }
        }
        relu<kSpace>(mixed);
        round.out.apply<N>(mixed, out);
        for (int k = 0; k < kSpace; ++k) state[k] += out[k];
        const float middle = sum_of<N>(state) / kWidth;
        for (int k = 0; k < kWidth; ++k) state[k] -= middle;
        for (int k = 0; k < kSpace; ++k) out[k] = state[k] * state[k];
        const float spread = 1 / std::sqrt(sum_of<N>(out) / kWidth + 1e-5f);
        for (int k = 0; k < kWidth; ++k) state[k] = state[k] * spread * round.norm.mean[k] + round.norm.scale[k];
    }
}

template <int N>
TENSOR_STEREO_INLINE void score_pair(const Job& job, std::int64_t b, Workspace& work) {
    const LearnedInputs& given = job.inputs;
    const std::int64_t start = given.ptr[b], count = given.ptr[b + 1] - start;
    if (count == 0) return;
    const Pair pair{job, start, count, b, given.image != nullptr};
    work.has_image.assign(count, 0);
    for (std::int64_t m = 0; m < count && pair.has_images; ++m) work.has_image[m] = given.num_columns[start + m] > 0;
    work.state.assign(count * kSpace, 0);
    center(pair, work);
    find_links(pair, work);
    measure_links<N>(pair, work);
    look_at_links(pair, work);
    scale_steps(work, count);
    enter<N>(pair, work);
    for (int r = 0; r < kRounds; ++r) pass_messages<N>(job.layers.rounds[r], r > 1, pair, work);
    alignas(64) float mean[kSpace], whole[kSpace], hidden[kSpace], out[padded(kTolerances)];
    mean_state<N>(work, count, mean);
    job.layers.head_whole.apply<N>(mean, whole);
    for (std::int64_t m = 0; m < count; ++m) {
        job.layers.head.apply<N>(work.state.data() + m * kSpace, hidden);
        for (int k = 0; k < kSpace; ++k) hidden[k] += whole[k];
        relu<kSpace>(hidden);
        job.layers.last.apply<N>(hidden, out);
        float* const logit = job.logits + (start + m) * kTolerances;
        logit[0] = out[1] - softplus(out[0]);
        logit[1] = out[1];
        for (int k = 2; k < kTolerances; ++k) logit[k] = logit[k - 1] + softplus(out[k]);
    }
}

struct Pairs {
    const Job& job;
    std::int64_t begin, end;
    Workspace& work;

    template <int N>
    TENSOR_STEREO_INLINE void run() const {
        for (std::int64_t b = begin; b < end; ++b) score_pair<N>(job, b, work);
    }
};

}  // namespace

void learned_network(const learned::Weights& weights, const LearnedInputs& inputs, std::int64_t num_pairs,
                     int num_threads, float* logits, Vectors vectors) {
    const auto layers = std::make_unique<Layers>(weights);
    const Job job{*layers, inputs, num_pairs, logits};
    parallel_for(num_pairs, 1, num_threads, [&] {
        return [&, work = std::make_unique<Workspace>()](std::int64_t begin, std::int64_t end) mutable {
            run_with(vectors, Pairs{job, begin, end, *work});
        };
    });
}

}  // namespace tensor_stereo
