#include "byte_products.hpp"

#include <cstring>

#if defined(__x86_64__) && defined(__GNUC__)
#include <immintrin.h>
#endif

namespace tensor_stereo {

#if defined(__x86_64__) && defined(__GNUC__)

bool has_byte_products() {
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
           __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq") &&
           __builtin_cpu_supports("avx512vnni");
}

__attribute__((target("avx512f,avx512bw,avx512vnni"))) void byte_products(
    const std::int8_t* const (&rows)[kByteRows], const std::uint8_t* panel, std::int64_t quads,
    std::int32_t (&sums)[kByteRows][kByteColumns]) {
    __m512i left[kByteRows], right[kByteRows];
    for (int r = 0; r < kByteRows; ++r) left[r] = right[r] = _mm512_setzero_si512();
    for (std::int64_t q = 0; q < quads; ++q) {
        const __m512i a = _mm512_loadu_si512(panel + q * 128), b = _mm512_loadu_si512(panel + q * 128 + 64);
        for (int r = 0; r < kByteRows; ++r) {
            std::int32_t four;
            std::memcpy(&four, rows[r] + 4 * q, 4);
            const __m512i row = _mm512_set1_epi32(four);
            left[r] = _mm512_dpbusd_epi32(left[r], a, row);
            right[r] = _mm512_dpbusd_epi32(right[r], b, row);
        }
    }
    for (int r = 0; r < kByteRows; ++r) {
        _mm512_storeu_si512(sums[r], left[r]);
        _mm512_storeu_si512(sums[r] + 16, right[r]);
    }
}

#else

bool has_byte_products() { return false; }

void byte_products(const std::int8_t* const (&rows)[kByteRows], const std::uint8_t* panel, std::int64_t quads,
                   std::int32_t (&sums)[kByteRows][kByteColumns]) {
    for (int r = 0; r < kByteRows; ++r) {
        for (int c = 0; c < kByteColumns; ++c) {
            std::int32_t sum = 0;
            for (std::int64_t k = 0; k < 4 * quads; ++k) sum += rows[r][k] * panel[k / 4 * 128 + c * 4 + k % 4];
            sums[r][c] = sum;
        }
    }
}

#endif

}  // namespace tensor_stereo
