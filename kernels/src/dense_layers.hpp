// Linear layers of a few dozen numbers, and the functions between them.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "lanes.hpp"
#include "tensor_stereo/learned_network.hpp"

namespace tensor_stereo::learned {

constexpr int padded(int size) { return (size + kMaxLanes - 1) / kMaxLanes * kMaxLanes; }

// Weights with the outputs side by side, padded with zeros.
template <int kIn, int kOut>
struct Dense {
    alignas(64) float weight[kIn][padded(kOut)];
    alignas(64) float bias[padded(kOut)];

    // Vectors of N numbers that hold the outputs.
    template <int N>
    static constexpr int parts = (kOut + N - 1) / N;

    explicit Dense(const Linear& given) {
        for (int k = 0; k < kIn; ++k) {
            for (int o = 0; o < padded(kOut); ++o) weight[k][o] = o < kOut ? given.weight[o * kIn + k] : 0;
        }
        for (int o = 0; o < padded(kOut); ++o) bias[o] = o < kOut && given.bias != nullptr ? given.bias[o] : 0;
    }

    // Adds the product to what N outputs at a time hold.
    template <int N>
    TENSOR_STEREO_INLINE void add(const float* in, Lanes<N> (&total)[parts<N>]) const {
        constexpr int kParts = parts<N>;
        // Several sums at a time: each addition waits for the one before.
        constexpr int kChains = std::min(kIn, kParts >= 4 ? 1 : kParts >= 2 ? 3 : 5);
        Lanes<N> sum[kChains][kParts] = {};
        constexpr int kWhole = kIn / kChains * kChains;
        for (int k = 0; k < kWhole; k += kChains) {
            for (int c = 0; c < kChains; ++c) {
                for (int p = 0; p < kParts; ++p) {
                    Lanes<N> row;
                    load(weight[k + c] + p * N, row);
                    sum[c][p] += row * in[k + c];
                }
            }
        }
        for (int k = kWhole; k < kIn; ++k) {
            for (int p = 0; p < kParts; ++p) {
                Lanes<N> row;
                load(weight[k] + p * N, row);
                sum[0][p] += row * in[k];
            }
        }
        for (int c = 0; c < kChains; ++c) {
            for (int p = 0; p < kParts; ++p) total[p] += sum[c][p];
        }
    }

    template <int N>
    TENSOR_STEREO_INLINE void add(const float* in, float* out) const {
        Lanes<N> total[parts<N>];
        for (int p = 0; p < parts<N>; ++p) load(out + p * N, total[p]);
        add<N>(in, total);
        for (int p = 0; p < parts<N>; ++p) store(total[p], out + p * N);
    }

    template <int N>
    TENSOR_STEREO_INLINE void apply(const float* in, float* out) const {
        std::copy_n(bias, padded(kOut), out);
        add<N>(in, out);
    }
};

template <int kSize>
TENSOR_STEREO_INLINE void relu(float* values) {
    for (int k = 0; k < kSize; ++k) values[k] = std::max(values[k], 0.0f);
}

TENSOR_STEREO_INLINE float normalize(float value, const Scale& scale, int k) {
    return std::clamp(value * scale.scale[k] - scale.mean[k] * scale.scale[k], -4.0f, 4.0f);
}

// Functions of N numbers at a time; exp of what is not positive.
template <class V>
TENSOR_STEREO_INLINE V exp_of(V x) {
    exponential(x);
    return x;
}
template <class V>
TENSOR_STEREO_INLINE V log_of(V x) {
    logarithm(x);
    return x;
}
template <class V>
TENSOR_STEREO_INLINE V magnitude(V x) {
    return x < 0.0f ? -x : x;
}
template <class V>
TENSOR_STEREO_INLINE V sigmoid(V x) {
    const V e = exp_of(-magnitude(x));
    return (x < 0.0f ? e : V{} + 1.0f) / (1.0f + e);
}
template <class V>
TENSOR_STEREO_INLINE V tanh_of(V x) {
    const V e = exp_of(-2.0f * magnitude(x)), t = (1.0f - e) / (1.0f + e);
    return x < 0.0f ? -t : t;
}
template <class V>
TENSOR_STEREO_INLINE V root_of(V x) {
    alignas(64) float values[num_lanes<V>];
    store(x, values);
    for (float& value : values) value = std::sqrt(value);
    load(values, x);
    return x;
}
template <class V>
TENSOR_STEREO_INLINE V limited(V x, float low, float high) {
    x = x < low ? V{} + low : x;
    return x > high ? V{} + high : x;
}

TENSOR_STEREO_INLINE float softplus(float x) {
    Lanes<4> lanes = Lanes<4>{} + x;
    const Lanes<4> soft = (lanes < 0.0f ? Lanes<4>{} : lanes) + log_of(1.0f + exp_of(-magnitude(lanes)));
    return soft[0];
}

}  // namespace tensor_stereo::learned
