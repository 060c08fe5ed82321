// Delaunay triangulation of distinct points, exact.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "tensor_stereo/predicates.hpp"

namespace tensor_stereo {

using Index = std::int32_t;
inline constexpr Index kNone = -1;

// The bounding box of points.
struct Box {
    Point corner, centre;
    double side;  // the longer one
};

// Half-edge h of triangle h / 3 runs from vertex origin[h] to the origin of the next half-edge of that triangle, with
// the triangle on its left; twin[h] is the same edge in the neighbouring triangle, kNone on the hull.
struct Triangulation {
    std::vector<Point> points;    // in an order of the builder's own
    std::vector<Index> vertex;    // index in the input of each of them
    std::vector<Index> origin;    // (3 T)
    std::vector<Index> twin;      // (3 T)
    Box box;
    Bounds bounds;                // on the rounding of determinants of these points
    bool is_collinear = false;        // no triangles; points lie in order along a line
};

inline Index next_in_triangle(Index h) noexcept { return h % 3 == 2 ? h - 2 : h + 1; }
inline Index previous_in_triangle(Index h) noexcept { return h % 3 == 0 ? h + 2 : h - 1; }

// A row of the input and its squared distance from the centre of the sweep.
struct Radial {
    double distance;
    Index row;
};

// A point on the paraboloid z = x^2 + y^2, and its angle around the centre of the sweep.
struct Lifted {
    double x, y, z, angle;
};

// A triangle of the sweep, one cache line: a x + b y + c z = d is the plane through its vertices on the paraboloid.
struct alignas(64) Triangle {
    std::array<Index, 3> origin, twin;
    double a, b, c, d;
};

struct HullVertex {
    Index next, previous, edge;
};

// What lies beyond an edge of the cavity: a half-edge, seen from its first vertex.
struct Hole {
    Index origin, beyond;
};

// Memory that is kept from one segment to the next.
struct Workspace {
    std::vector<std::uint64_t> keys, keys_buffer;
    std::vector<Radial> order;
    std::vector<Lifted> lifted;
    std::vector<Triangle> triangles;
    std::vector<HullVertex> hull;
    std::vector<Index> hull_hash, free;
    std::vector<Hole> stack;
};

// Bounds for these points, no two coordinates more than side apart; 0 if all lie on a grid of spacing 2^k within 2^12 steps, as integer pixels do.
Bounds determinant_bounds(const Point* points, std::size_t count, double side) noexcept;

// Triangulates points[index[0..count)], count >= 1, distinct. Radial sweep over a growing hull; where that would replace
// too many triangles, or rounding spoils its order, divide and conquer instead.
void triangulate(const double* points, const std::int64_t* index, std::size_t count, Triangulation& result,
                 Workspace& workspace);

// The radial sweep on mesh.points in radial order; false if it must be given up.
bool sweep_hull(Triangulation& mesh, Workspace& workspace);

// The same by divide and conquer alone, O(N log N) for every input.
void divide_and_conquer(Triangulation& result);

}  // namespace tensor_stereo
