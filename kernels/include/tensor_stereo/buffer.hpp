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
inline void* allocate_bytes(std::size_t bytes) noexcept {
#if defined(__linux__)
    constexpr std::size_t kHugePage = std::size_t{1} << 21;
    if (bytes >= kHugePage / 2) {
        const std::size_t rounded = (bytes + kHugePage - 1) / kHugePage * kHugePage;
        void* const memory = std::aligned_alloc(kHugePage, rounded);
        if (memory != nullptr) madvise(memory, rounded, MADV_HUGEPAGE);  // advice: failure changes nothing
        return memory;
    }
#endif
    return std::malloc(bytes > 0 ? bytes : 1);
}

template <class T>
Buffer<T> allocate(std::size_t size) {
    void* const memory = allocate_bytes(size * sizeof(T));
    if (memory == nullptr) throw std::bad_alloc();
    return Buffer<T>(static_cast<T*>(memory));
}

}  // namespace tensor_stereo
