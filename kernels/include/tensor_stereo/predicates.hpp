// Exact signs of the orientation and in-circle determinants on doubles that are 0 or 1e-60..1e60 in magnitude.
//
// A floating-point filter decides almost all calls, double-double arithmetic most of the rest, exact expansions what is
// left. Bounds and expansions: Shewchuk, Discrete & Computational Geometry 18 (1997), sections 2 and 4.
// Must be compiled without contraction of a * b + c.
#pragma once

#include <cmath>

namespace tensor_stereo {

struct Point {
    double x, y;
};

inline constexpr double kEpsilon = 0x1p-53;
inline constexpr double kOrientationBound = (3 + 16 * kEpsilon) * kEpsilon;
inline constexpr double kIncircleBound = (10 + 96 * kEpsilon) * kEpsilon;

// Slow paths, exact for every input in range.
int exact_orientation(Point a, Point b, Point c) noexcept;
int exact_incircle(Point a, Point b, Point c, Point d) noexcept;

inline int sign(double value) noexcept { return (value > 0) - (value < 0); }

// Bounds on the rounding of the determinants that hold for all points within a square of the given side; 0 where plain
// double arithmetic does not round at all. The plane is that of the in-circle test on the paraboloid, by coordinates
// from the centre of the square.
struct Bounds {
    double orientation = 0, incircle = 0, plane = 0;

    static Bounds of_square(double side) noexcept {
        // |left| + |right| <= 2 side^2; each of the three terms of the permanent is at most 2 side^2 * 2 side^2; the
        // terms of the plane are at most 96 (side / 2)^4 in all, and no product or sum goes through 16 roundings.
        const double square = side * side;
        return {2.01 * kOrientationBound * square, 12.01 * kIncircleBound * square * square,
                100 * kEpsilon * square * square};
    }
};

// 1 if the path a, b, c turns counter-clockwise (y upwards), -1 clockwise, 0 if it is straight. The bounds decide most
// calls at once; those of all points that a program compares, or infinity, always give the right answer.
inline int orientation(Point a, Point b, Point c, const Bounds& bounds) noexcept {
    const double determinant = (a.x - c.x) * (b.y - c.y) - (a.y - c.y) * (b.x - c.x);
    if (determinant > bounds.orientation) return 1;
    if (-determinant > bounds.orientation) return -1;
    return bounds.orientation == 0 ? 0 : exact_orientation(a, b, c);
}

// 1 if d lies strictly inside the circle through the counter-clockwise a, b, c, -1 strictly outside, 0 on it.
inline int incircle(Point a, Point b, Point c, Point d, const Bounds& bounds) noexcept {
    const double ux = a.x - d.x, uy = a.y - d.y;
    const double vx = b.x - d.x, vy = b.y - d.y;
    const double wx = c.x - d.x, wy = c.y - d.y;
    const double lift_u = ux * ux + uy * uy, lift_v = vx * vx + vy * vy, lift_w = wx * wx + wy * wy;
    const double determinant =
        lift_u * (vx * wy - wx * vy) + lift_v * (wx * uy - ux * wy) + lift_w * (ux * vy - vx * uy);
    if (determinant > bounds.incircle) return 1;
    if (-determinant > bounds.incircle) return -1;
    return bounds.incircle == 0 ? 0 : exact_incircle(a, b, c, d);
}

}  // namespace tensor_stereo
