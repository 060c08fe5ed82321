// The radial sweep and the memory that it keeps.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "tensor_stereo/index.hpp"
#include "tensor_stereo/triangulation.hpp"

namespace tensor_stereo {

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

// Triangulates mesh.points, which are in radial order; false if the sweep must be given up.
bool sweep_hull(Triangulation& mesh, Workspace& workspace);

}  // namespace tensor_stereo
