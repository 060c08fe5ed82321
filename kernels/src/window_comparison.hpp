// The windows of a match against windows of the other view: zero-mean sums of squared differences and correlations.
#pragma once

#include <cmath>
#include <cstdint>

#include "lanes.hpp"
#include "window_sampling.hpp"

namespace tensor_stereo {

enum Window { kSmall, kMiddle, kLike, kTight, kLeft, kRight, kUpper, kLower, kNumWindows };
constexpr int kPixels = kSide * kSide, kPaddedPixels = (kPixels + kMaxLanes - 1) / kMaxLanes * kMaxLanes;
constexpr int kMiddleRadius = 5, kSmallRadius = 2, kOverlap = 1;  // of half windows across the middle
constexpr float kNoiseVariance = 2.0f;                            // grey levels squared

// A window of one view, what it weighs, and what that says of it alone.
struct Anchor {
    alignas(64) float pixel[kPaddedPixels];  // less the one in the middle
    alignas(64) float like[kPaddedPixels];   // weights, whose sum is 1
    alignas(64) float tight[kPaddedPixels];
    float level;
    float mean[kNumWindows], variance[kNumWindows];
};

// What windows cost at some places.
struct Comparison {
    alignas(64) float cost[kNumWindows][kMaxPlaces];  // log SSD
    alignas(64) float likeness[kWholeWindows][kMaxPlaces];
    alignas(64) float ssd[kNumWindows][kMaxPlaces];
};

// Sums of values, of their squares and of squared differences, over the pixels of a window.
template <class V>
struct Moments {
    V value, square, difference;
};

constexpr int num_pixels(Window window) {
    constexpr int middle = 2 * kMiddleRadius + 1, small = 2 * kSmallRadius + 1;
    if (window == kSmall) return small * small;
    return window == kMiddle ? middle * middle : middle * (kMiddleRadius + kOverlap + 1);
}

constexpr bool is_in(Window window, int x, int y) {
    const int away_x = x < 0 ? -x : x, away_y = y < 0 ? -y : y;
    if (window == kSmall) return away_x <= kSmallRadius && away_y <= kSmallRadius;
    if (away_x > kMiddleRadius || away_y > kMiddleRadius) return false;
    if (window == kLeft) return x <= kOverlap;
    if (window == kRight) return x >= -kOverlap;
    if (window == kUpper) return y <= kOverlap;
    if (window == kLower) return y >= -kOverlap;
    return true;
}

// What boxes and halves weigh, and the squared distances from the middle.
struct Pattern {
    alignas(64) float weight[kNumWindows][kPaddedPixels] = {};
    alignas(64) float distance[kPaddedPixels] = {};

    constexpr Pattern() {
        for (int k = 0; k < kPixels; ++k) {
            const int x = k % kSide - kWindowRadius, y = k / kSide - kWindowRadius;
            distance[k] = static_cast<float>(x * x + y * y);
            for (int w = 0; w < kNumWindows; ++w) {
                const auto window = static_cast<Window>(w);
                if (is_in(window, x, y)) weight[w][k] = 1 / static_cast<float>(num_pixels(window));
            }
        }
    }
};
inline constexpr Pattern kPattern;

// The sum over a padded window of what `term(k)` gives for N pixels from k on. The order of the additions is the same
// for every N.
template <int N, class Term>
TENSOR_STEREO_INLINE float sum_pixels(const Term& term) {
    Lanes<N> part[kMaxLanes / N] = {};
    for (int k = 0; k < kPaddedPixels; k += kMaxLanes) {
        for (int l = 0; l < kMaxLanes / N; ++l) part[l] += term(k + l * N);
    }
    alignas(64) float lane[kMaxLanes];
    for (int l = 0; l < kMaxLanes / N; ++l) store(part[l], lane + l * N);
    for (int half = kMaxLanes / 2; half > 0; half /= 2) {
        for (int l = 0; l < half; ++l) lane[l] += lane[l + half];
    }
    return lane[0];
}

template <int N>
TENSOR_STEREO_INLINE Lanes<N> read(const float* values) {
    Lanes<N> lanes;
    load(values, lanes);
    return lanes;
}

// Pixels like the ones in the middle (Yoon & Kweon 2006), the less the farther they are; of 11 x 11 if it is tight.
template <int N>
TENSOR_STEREO_INLINE void weigh(const Anchor& anchor, float center, float levels, float reach, float least,
                                bool is_tight, float* weights) {
    for (int k = 0; k < kPaddedPixels; k += N) {
        Lanes<N> unlike = read<N>(anchor.pixel + k) - center;
        unlike = unlike < 0.0f ? -unlike : unlike;
        Lanes<N> weight = -(unlike / levels) - read<N>(kPattern.distance + k) / reach;
        exponential(weight);
        weight += least;
        if (is_tight) {
            const Lanes<N> inside = read<N>(kPattern.weight[kMiddle] + k);
            weight = inside > 0.0f ? weight : Lanes<N>{};
        }
        store(weight, weights + k);
    }
    for (int k = kPixels; k < kPaddedPixels; ++k) weights[k] = 0;
    const float total = sum_pixels<N>([&](int k) { return read<N>(weights + k); });
    for (int k = 0; k < kPaddedPixels; k += N) store(read<N>(weights + k) / total, weights + k);
}

template <int N>
TENSOR_STEREO_INLINE void prepare(const Strip& window, Anchor& anchor) {
    anchor.level = window.row[kWindowRadius][kWindowRadius];
    for (int y = 0; y < kSide; ++y) {
        for (int x = 0; x < kSide; ++x) anchor.pixel[y * kSide + x] = window.row[y][x] - anchor.level;
    }
    for (int k = kPixels; k < kPaddedPixels; ++k) anchor.pixel[k] = 0;
    float center = 0;
    for (int y = -1; y <= 1; ++y) {
        for (int x = -1; x <= 1; ++x) center += anchor.pixel[(y + kWindowRadius) * kSide + x + kWindowRadius];
    }
    weigh<N>(anchor, center / 9, 12.0f, 40.0f, 1e-4f, false, anchor.like);
    weigh<N>(anchor, anchor.pixel[kPixels / 2], 10.0f, 8.0f, 1e-5f, true, anchor.tight);
    for (int w = 0; w < kNumWindows; ++w) {
        const float* const weights = w == kLike ? anchor.like : w == kTight ? anchor.tight : kPattern.weight[w];
        const float mean = sum_pixels<N>([&](int k) { return read<N>(weights + k) * read<N>(anchor.pixel + k); });
        anchor.mean[w] = mean;
        anchor.variance[w] = sum_pixels<N>([&](int k) {
            const Lanes<N> apart = read<N>(anchor.pixel + k) - mean;
            return read<N>(weights + k) * (apart * apart);
        });
    }
}

template <class V>
TENSOR_STEREO_INLINE void add(const V& value, const V& square, const V& difference, Moments<V>& sum) {
    sum.value += value;
    sum.square += square;
    sum.difference += difference;
}

template <class V>
TENSOR_STEREO_INLINE void add(float weight, const V& value, const V& square, const V& difference, Moments<V>& sum) {
    sum.value += weight * value;
    sum.square += weight * square;
    sum.difference += weight * difference;
}

template <class V>
TENSOR_STEREO_INLINE void scale(float factor, Moments<V>& sum) {
    sum.value *= factor;
    sum.square *= factor;
    sum.difference *= factor;
}

// Cost and likeness of some places from weighted moments. `offset` is by how much the pixel in the middle is brighter
// there, which the moments leave out: they are small where windows are alike, and so are their errors.
template <class V>
TENSOR_STEREO_INLINE void finish(const Anchor& anchor, Window window, const Moments<V>& mean, const V& offset,
                                 int first, Comparison& result) {
    const V gap = anchor.mean[window] - mean.value;
    V difference = mean.difference - gap * gap;
    at_least(0, difference);
    if (window < kWholeWindows) {
        V variance = mean.square - mean.value * mean.value;
        at_least(0, variance);
        const V covariance = 0.5f * ((variance + anchor.variance[window]) - difference);
        const V product = (variance + kNoiseVariance) * (anchor.variance[window] + kNoiseVariance);
        alignas(64) float roots[num_lanes<V>];
        store(product, roots);
        for (float& value : roots) value = std::sqrt(value);
        V root;
        load(roots, root);
        store(covariance / root, result.likeness[window] + first);
    }
    if (window == kTight) {  // that also counts how far the means differ
        const V apart = gap - offset;
        difference += apart * apart;
    }
    V cost = difference + kNoiseVariance;
    store(cost, result.ssd[window] + first);
    logarithm(cost);
    store(cost, result.cost[window] + first);
}

// Compares N places, each one column on in the strip.
template <int N, bool kHalves>
TENSOR_STEREO_INLINE void compare_lanes(const Anchor& anchor, const Strip& strip, int first, Comparison& result) {
    using V = Lanes<N>;
    constexpr int begin = kWindowRadius - kMiddleRadius, end = kWindowRadius + kMiddleRadius + 1;
    V level;
    load(strip.row[kWindowRadius] + first + kWindowRadius, level);
    Moments<V> like = {}, tight = {}, small = {}, ring = {};
    for (int y = 0; y < kSide; ++y) {
        const bool is_middle_row = y >= begin && y < end;
        const bool is_small_row = std::abs(y - kWindowRadius) <= kSmallRadius;
        for (int x = 0; x < kSide; ++x) {
            const int k = y * kSide + x;
            V value;
            load(strip.row[y] + first + x, value);
            value -= level;
            const V difference = anchor.pixel[k] - value;
            const V square = value * value, squared = difference * difference;
            add(anchor.like[k], value, square, squared, like);
            if (!is_middle_row || x < begin || x >= end) continue;
            add(anchor.tight[k], value, square, squared, tight);
            if (is_small_row && std::abs(x - kWindowRadius) <= kSmallRadius) {
                add(value, square, squared, small);
            } else {
                add(value, square, squared, ring);
            }
        }
    }
    const V offset = level - anchor.level;
    add(small.value, small.square, small.difference, ring);
    scale(1.0f / num_pixels(kSmall), small);
    scale(1.0f / num_pixels(kMiddle), ring);
    finish(anchor, kSmall, small, offset, first, result);
    finish(anchor, kMiddle, ring, offset, first, result);
    finish(anchor, kLike, like, offset, first, result);
    finish(anchor, kTight, tight, offset, first, result);
    if constexpr (kHalves) {
        for (const bool is_side : {true, false}) {
            Moments<V> low = {}, high = {};
            for (int y = begin; y < end; ++y) {
                for (int x = begin; x < end; ++x) {
                    V value;
                    load(strip.row[y] + first + x, value);
                    value -= level;
                    const V difference = anchor.pixel[y * kSide + x] - value;
                    const V square = value * value, squared = difference * difference;
                    const int place = (is_side ? x : y) - kWindowRadius;
                    if (place <= kOverlap) add(value, square, squared, low);
                    if (place >= -kOverlap) add(value, square, squared, high);
                }
            }
            scale(1.0f / num_pixels(kLeft), low);
            scale(1.0f / num_pixels(kLeft), high);
            finish(anchor, is_side ? kLeft : kUpper, low, offset, first, result);
            finish(anchor, is_side ? kRight : kLower, high, offset, first, result);
        }
    }
}

// Compares at `count` places; half windows too if asked.
template <int N, bool kHalves>
TENSOR_STEREO_INLINE void compare(const Anchor& anchor, const Strip& strip, int count, Comparison& result) {
    for (int first = 0; first < count; first += N) compare_lanes<N, kHalves>(anchor, strip, first, result);
}

}  // namespace tensor_stereo
