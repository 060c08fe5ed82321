// Two doubles that are added and multiplied at once.
#pragma once

namespace tensor_stereo {

#if (defined(__GNUC__) || defined(__clang__)) && !defined(TENSOR_STEREO_PLAIN_VECTORS)

// Both in one register, x and y or u and v: the compiler does not bring them together by itself.
using Vector2 = double __attribute__((vector_size(16)));

#else

// The same for compilers without vector types: every operation rounds alike, so the bits are the same.
struct Vector2 {
    double value[2];

    double operator[](int k) const noexcept { return value[k]; }
};

inline Vector2 operator+(Vector2 a, Vector2 b) noexcept { return {a[0] + b[0], a[1] + b[1]}; }
inline Vector2 operator-(Vector2 a, Vector2 b) noexcept { return {a[0] - b[0], a[1] - b[1]}; }
inline Vector2 operator*(Vector2 a, Vector2 b) noexcept { return {a[0] * b[0], a[1] * b[1]}; }
inline Vector2 operator*(double a, Vector2 b) noexcept { return {a * b[0], a * b[1]}; }
inline Vector2 operator*(Vector2 a, double b) noexcept { return b * a; }
inline Vector2 operator/(Vector2 a, double b) noexcept { return {a[0] / b, a[1] / b}; }
inline Vector2& operator+=(Vector2& a, Vector2 b) noexcept { return a = a + b; }

#endif

}  // namespace tensor_stereo
