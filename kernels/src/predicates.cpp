#include "tensor_stereo/predicates.hpp"

#include <array>
#include <cstddef>

namespace tensor_stereo {
namespace {

// Error-free transformations: high + low is the exact result.
struct Double2 {
    double high, low;
};

inline Double2 two_sum(double a, double b) noexcept {
    const double sum = a + b;
    const double part = sum - a;
    return {sum, (a - (sum - part)) + (b - part)};
}

inline Double2 split(double a) noexcept {
    const double scaled = 134217729.0 * a;  // 2^27 + 1
    const double high = scaled - (scaled - a);
    return {high, a - high};
}

inline Double2 two_product(double a, double b) noexcept {
    const double product = a * b;
    const Double2 p = split(a), q = split(b);
    return {product, p.low * q.low - (((product - p.high * q.high) - p.low * q.high) - p.high * q.low)};
}

inline Double2 two_difference(double a, double b) noexcept { return two_sum(a, -b); }

// Double-double arithmetic; each operation is off by less than 2^-102 of the magnitudes that it adds or multiplies.
inline Double2 operator*(Double2 a, Double2 b) noexcept {
    const Double2 p = two_product(a.high, b.high);
    return two_sum(p.high, p.low + (a.high * b.low + a.low * b.high));
}

inline Double2 operator+(Double2 a, Double2 b) noexcept {
    const Double2 s = two_sum(a.high, b.high);
    const Double2 t = two_sum(a.low, b.low);
    const Double2 u = two_sum(s.high, s.low + t.high);
    return two_sum(u.high, u.low + t.low);
}

inline Double2 operator-(Double2 a, Double2 b) noexcept { return a + Double2{-b.high, -b.low}; }

inline double magnitude(Double2 a) noexcept { return std::fabs(a.high); }

// A sum of doubles that do not overlap, by increasing magnitude and without zeros: the exact value of a determinant.
template <std::size_t kCapacity>
struct Expansion {
    std::array<double, kCapacity> terms;
    std::size_t size = 0;

    // Adds one double; Shewchuk's GROW-EXPANSION with zero elimination.
    void grow(double value) noexcept {
        std::size_t kept = 0;
        for (std::size_t k = 0; k < size; ++k) {
            const Double2 sum = two_sum(value, terms[k]);
            value = sum.high;
            if (sum.low != 0) terms[kept++] = sum.low;
        }
        if (value != 0) terms[kept++] = value;
        size = kept;
    }

    template <std::size_t kA, std::size_t kB>
    void add_product(const Expansion<kA>& a, const Expansion<kB>& b) noexcept {
        for (std::size_t i = 0; i < a.size; ++i) {
            for (std::size_t j = 0; j < b.size; ++j) {
                const Double2 product = two_product(a.terms[i], b.terms[j]);
                grow(product.low);
                grow(product.high);
            }
        }
    }

    int sign() const noexcept { return size == 0 ? 0 : tensor_stereo::sign(terms[size - 1]); }
};

inline Expansion<2> difference(double a, double b) noexcept {
    Expansion<2> result;
    const Double2 d = two_difference(a, b);
    result.grow(d.low);
    result.grow(d.high);
    return result;
}

inline Expansion<2> negated(Expansion<2> a) noexcept {
    for (std::size_t k = 0; k < a.size; ++k) a.terms[k] = -a.terms[k];
    return a;
}

// a * d - b * c
inline Expansion<16> minor(const Expansion<2>& a, const Expansion<2>& b, const Expansion<2>& c,
                           const Expansion<2>& d) noexcept {
    Expansion<16> result;
    result.add_product(a, d);
    result.add_product(negated(b), c);
    return result;
}

inline Expansion<16> lift(const Expansion<2>& x, const Expansion<2>& y) noexcept {
    Expansion<16> result;
    result.add_product(x, x);
    result.add_product(y, y);
    return result;
}

}  // namespace

int exact_orientation(Point a, Point b, Point c) noexcept {
    const double left = (a.x - c.x) * (b.y - c.y), right = (a.y - c.y) * (b.x - c.x);
    const double determinant = left - right;
    if (std::fabs(determinant) > kOrientationBound * (std::fabs(left) + std::fabs(right))) return sign(determinant);
    return minor(difference(a.x, c.x), difference(a.y, c.y), difference(b.x, c.x), difference(b.y, c.y)).sign();
}

int exact_incircle(Point a, Point b, Point c, Point d) noexcept {
    {
        const double ux = a.x - d.x, uy = a.y - d.y, vx = b.x - d.x, vy = b.y - d.y, wx = c.x - d.x, wy = c.y - d.y;
        const double lift_u = ux * ux + uy * uy, lift_v = vx * vx + vy * vy, lift_w = wx * wx + wy * wy;
        const double vw = vx * wy, wv = wx * vy, wu = wx * uy, uw = ux * wy, uv = ux * vy, vu = vx * uy;
        const double determinant = lift_u * (vw - wv) + lift_v * (wu - uw) + lift_w * (uv - vu);
        const double permanent = (std::fabs(vw) + std::fabs(wv)) * lift_u + (std::fabs(wu) + std::fabs(uw)) * lift_v +
                                 (std::fabs(uv) + std::fabs(vu)) * lift_w;
        if (std::fabs(determinant) > kIncircleBound * permanent) return sign(determinant);
    }
    {
        const Double2 ux = two_difference(a.x, d.x), uy = two_difference(a.y, d.y);
        const Double2 vx = two_difference(b.x, d.x), vy = two_difference(b.y, d.y);
        const Double2 wx = two_difference(c.x, d.x), wy = two_difference(c.y, d.y);
        const Double2 lift_u = ux * ux + uy * uy, lift_v = vx * vx + vy * vy, lift_w = wx * wx + wy * wy;
        const Double2 vw = vx * wy, wv = wx * vy, wu = wx * uy, uw = ux * wy, uv = ux * vy, vu = vx * uy;
        const double determinant = (lift_u * (vw - wv) + lift_v * (wu - uw) + lift_w * (uv - vu)).high;
        const double permanent = (magnitude(vw) + magnitude(wv)) * magnitude(lift_u) +
                                 (magnitude(wu) + magnitude(uw)) * magnitude(lift_v) +
                                 (magnitude(uv) + magnitude(vu)) * magnitude(lift_w);
        // Depth 7, each step off by less than 2^-102 of what it handles.
        if (std::fabs(determinant) > 0x1p-97 * permanent) return sign(determinant);
    }
    const Expansion<2> ux = difference(a.x, d.x), uy = difference(a.y, d.y);
    const Expansion<2> vx = difference(b.x, d.x), vy = difference(b.y, d.y);
    const Expansion<2> wx = difference(c.x, d.x), wy = difference(c.y, d.y);
    Expansion<1536> determinant;
    determinant.add_product(lift(ux, uy), minor(vx, vy, wx, wy));
    determinant.add_product(lift(vx, vy), minor(wx, wy, ux, uy));
    determinant.add_product(lift(wx, wy), minor(ux, uy, vx, vy));
    return determinant.sign();
}

}  // namespace tensor_stereo
