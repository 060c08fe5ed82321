// Delaunay triangulation of distinct points, exact.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "tensor_stereo/index.hpp"
#include "tensor_stereo/predicates.hpp"

namespace tensor_stereo {

struct Workspace;  // memory of the sweep, in src/sweep_hull.hpp

// The bounding box of points.
struct Box {
    Point corner, centre;
    double side;  // the longer one
};

// Half-edge h of triangle h / 3 runs from vertex origin[h] to the origin of the next half-edge of that triangle, with
// the triangle on its left; twin[h] is the same edge in the neighbouring triangle, kNone on the hull.
struct Triangulation {
    std::vector<Point> points;  // in an order of the builder's own
    std::vector<Index> vertex;  // index in the input of each of them
    std::vector<Index> origin;  // (3 T)
    std::vector<Index> twin;    // (3 T)
    Box box;
    Bounds bounds;              // on the rounding of determinants of these points
    bool is_collinear = false;  // no triangles; points lie in order along a line
};

inline Index next_in_triangle(Index h) noexcept { return h % 3 == 2 ? h - 2 : h + 1; }
inline Index previous_in_triangle(Index h) noexcept { return h % 3 == 0 ? h + 2 : h - 1; }

// Bounds for these points, no two coordinates more than side apart; 0 if all lie on a grid of spacing 2^k within 2^12
// steps, as integer pixels do.
Bounds determinant_bounds(const Point* points, std::size_t count, double side) noexcept;

// Triangulates points[index[0..count)], count >= 1, distinct. Radial sweep over a growing hull; where that would
// replace too many triangles, or rounding spoils its order, divide and conquer instead.
void triangulate(const double* points, const std::int64_t* index, std::size_t count, Triangulation& result,
                 Workspace& workspace);

}  // namespace tensor_stereo
