// Uninitialised arrays for results and large intermediates.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <memory>
#include <new>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace tensor_stereo {

struct Free {
    void operator()(void* memory) const noexcept { std::free(memory); }
};

template <class T>
using Buffer = std::unique_ptr<T[], Free>;

// Large arrays ask for huge pages: they are new in every call, and touching them page by page would cost a fifth of it.
template <class T>
Buffer<T> allocate(std::size_t size) {
    constexpr std::size_t kHugePage = std::size_t{1} << 21;
    const std::size_t bytes = size * sizeof(T);
    void* memory = nullptr;
    if (bytes < kHugePage / 2) {
        memory = std::malloc(bytes > 0 ? bytes : 1);
    } else {
        const std::size_t rounded = (bytes + kHugePage - 1) / kHugePage * kHugePage;
        memory = std::aligned_alloc(kHugePage, rounded);
#if defined(__linux__)
        if (memory != nullptr) madvise(memory, rounded, MADV_HUGEPAGE);  // advice: failure changes nothing
#endif
    }
    if (memory == nullptr) throw std::bad_alloc();
    return Buffer<T>(static_cast<T*>(memory));
}

}  // namespace tensor_stereo
