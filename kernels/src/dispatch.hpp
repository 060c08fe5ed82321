// Runs a body that was compiled for the vector instructions at hand.
#pragma once

#include <algorithm>
#include <cstdint>
#include <type_traits>

#include "lanes.hpp"
#include "tensor_stereo/parallel.hpp"
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

// Items begin to end of pairs whose offsets are `ptr`: item.run<N>(b, m, work) for item m of pair b.
template <class Item, class Workspace>
struct ItemsOfPairs {
    const Item& item;
    const std::int64_t* ptr;
    std::int64_t num_pairs, begin, end;
    Workspace& work;

    template <int N>
    TENSOR_STEREO_INLINE void run() const {
        std::int64_t b = std::upper_bound(ptr, ptr + num_pairs + 1, begin) - ptr - 1;
        for (std::int64_t m = begin; m < end; ++m) {
            while (m >= ptr[b + 1]) ++b;
            item.template run<N>(b, m, work);
        }
    }
};

// All items of some pairs on a few threads, each with what make_workspace() gives it, a pointer.
template <class Item, class MakeWorkspace>
void run_items(const std::int64_t* ptr, std::int64_t num_pairs, int num_threads, Vectors vectors, const Item& item,
               const MakeWorkspace& make_workspace) {
    constexpr std::int64_t kItemsAtOnce = 16;
    parallel_for(ptr[num_pairs], kItemsAtOnce, num_threads, [&] {
        return [&, work = make_workspace()](std::int64_t begin, std::int64_t end) mutable {
            using Workspace = std::remove_reference_t<decltype(*work)>;
            run_with(vectors, ItemsOfPairs<Item, Workspace>{item, ptr, num_pairs, begin, end, *work});
        };
    });
}

}  // namespace tensor_stereo
