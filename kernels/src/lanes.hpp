// Several floats at a time, and functions of them whose bits do not depend on the instruction set.
//
// (The learned network alone contracts products and sums.) Everything here is inlined into functions that are compiled
// for several instruction sets. No product and sum are contracted, and no function of the C library takes part, whose
// last bits may depend on the machine.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#define TENSOR_STEREO_INLINE inline __attribute__((always_inline))

namespace tensor_stereo {

// N floats, and N integers, as many as a register of some instruction set holds: results do not depend on N.
template <int N>
struct Vector {
    typedef float Floats __attribute__((vector_size(4 * N)));
    typedef std::int32_t Integers __attribute__((vector_size(4 * N)));
};
constexpr int kMaxLanes = 16;

template <int N>
using Lanes = typename Vector<N>::Floats;

template <class V>
constexpr int num_lanes = sizeof(V) / sizeof(float);

template <class V>
TENSOR_STEREO_INLINE void load(const float* values, V& lanes) {
    std::memcpy(&lanes, values, sizeof(V));
}
template <class V>
TENSOR_STEREO_INLINE void store(const V& lanes, float* values) {
    std::memcpy(values, &lanes, sizeof(V));
}

template <class V>
TENSOR_STEREO_INLINE void at_least(float least, V& x) {
    x = x > least ? x : V{} + least;
}

// Natural logarithm of positive normal numbers, to 1e-7 of the larger of itself and 1 (after Moshier's Cephes, logf).
template <class V>
TENSOR_STEREO_INLINE void logarithm(V& x) {
    using Integers = typename Vector<num_lanes<V>>::Integers;
    Integers bits;
    std::memcpy(&bits, &x, sizeof bits);
    Integers exponent = (bits >> 23) - 126;
    bits = (bits & 0x007fffff) | 0x3f000000;  // in [.5, 1)
    V m;
    std::memcpy(&m, &bits, sizeof m);
    const Integers small = m < 0.707106781186547524f;
    exponent += small;  // -1 where true
    m = small ? m + m - 1.0f : m - 1.0f;
    const V e = __builtin_convertvector(exponent, V);
    const V z = m * m;
    V y = m * 7.0376836292e-2f - 1.1514610310e-1f;
    y = y * m + 1.1676998740e-1f;
    y = y * m - 1.2420140846e-1f;
    y = y * m + 1.4249322787e-1f;
    y = y * m - 1.6668057665e-1f;
    y = y * m + 2.0000714765e-1f;
    y = y * m - 2.4999993993e-1f;
    y = y * m + 3.3333331174e-1f;
    y = y * m * z + e * -2.12194440e-4f - z * 0.5f;
    x = m + y + e * 0.693359375f;
}

TENSOR_STEREO_INLINE float scalar_logarithm(float x) {
    Lanes<4> lanes = Lanes<4>{} + x;
    logarithm(lanes);
    return lanes[0];
}

// Exponential of numbers from -80 to 0, to 1e-7 of itself (after Moshier's Cephes, expf); less is taken for -80.
template <class V>
TENSOR_STEREO_INLINE void exponential(V& x) {
    using Integers = typename Vector<num_lanes<V>>::Integers;
    at_least(-80.0f, x);
    const V magic = V{} + 12582912.0f;  // 1.5 * 2**23: rounds to whole numbers
    const V n = (x * 1.44269504088896341f + magic) - magic;
    const V r = (x - n * 0.693359375f) - n * -2.12194440e-4f;
    V y = r * 1.9875691500e-4f + 1.3981999507e-3f;
    y = y * r + 8.3334519073e-3f;
    y = y * r + 4.1665795894e-2f;
    y = y * r + 1.6666665459e-1f;
    y = y * r + 5.0000001201e-1f;
    y = y * (r * r) + r + 1.0f;
    const Integers power = (__builtin_convertvector(n, Integers) + 127) << 23;
    V scale;
    std::memcpy(&scale, &power, sizeof scale);
    x = y * scale;
}

}  // namespace tensor_stereo
