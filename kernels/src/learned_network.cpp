#include "tensor_stereo/learned_network.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <vector>

#include "dense_layers.hpp"
#include "dispatch.hpp"
#include "lanes.hpp"
#include "learned_layers.hpp"
#include "learned_links.hpp"
#include "learned_planes.hpp"
#include "tensor_stereo/parallel.hpp"

namespace tensor_stereo {
namespace {

using namespace learned;

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
