// Products of bytes by the instructions that multiply and add 64 of them at a time.
#pragma once

#include <cstdint>

namespace tensor_stereo {

constexpr int kByteRows = 6, kByteColumns = 32;

// Whether this machine has AVX-512 VNNI.
bool has_byte_products();

// sums[r][c] = sum over k of rows[r][k] * panel[k / 4][c][k % 4], exact, for 4 `quads` components.
void byte_products(const std::int8_t* const (&rows)[kByteRows], const std::uint8_t* panel, std::int64_t quads,
                   std::int32_t (&sums)[kByteRows][kByteColumns]);

}  // namespace tensor_stereo
