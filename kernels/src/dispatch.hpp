// Runs a body that was compiled for the vector instructions at hand.
#pragma once

#include "lanes.hpp"
#include "tensor_stereo/vectors.hpp"

namespace tensor_stereo {

// `body.run<N>()` must be inlined: it is compiled once for each set of instructions, whose registers hold N floats.
template <class Body>
void run_baseline(const Body& body) {
    body.template run<4>();
}

#if defined(__x86_64__) && defined(__GNUC__)
template <class Body>
__attribute__((target("avx2,fma"))) void run_avx2(const Body& body) {
    body.template run<8>();
}

template <class Body>
__attribute__((target("avx2,avx512f,avx512vl,avx512dq,avx512bw,prefer-vector-width=512"))) void run_avx512(
    const Body& body) {
    body.template run<16>();
}
#endif

template <class Body>
void run_with(Vectors vectors, const Body& body) {
#if defined(__x86_64__) && defined(__GNUC__)
    const bool is_best = vectors == Vectors::kBest;
    if ((is_best || vectors == Vectors::kAvx512) && has_vectors(Vectors::kAvx512)) return run_avx512(body);
    if ((is_best || vectors == Vectors::kAvx2) && has_vectors(Vectors::kAvx2)) return run_avx2(body);
#endif
    run_baseline(body);
}

}  // namespace tensor_stereo
