// The Delaunay graph of every segment of a ragged batch, as one sparse pattern.
#pragma once

#include <cstdint>

#include "tensor_stereo/buffer.hpp"

namespace tensor_stereo {

// Compressed rows of a symmetric boolean matrix, columns ascending within each row.
struct SparsePattern {
    Buffer<std::int64_t> crow;  // (num_rows + 1) offsets
    Buffer<std::int64_t> cols;  // (crow[num_rows])
    std::int64_t num_rows = 0;
};

// points: (num_points, 2), 0 or 1e-60..1e60 in magnitude. index: rows of points, segment after segment, ascending
// within each, with distinct points. ptr: (num_segments + 1) offsets into index. tie_tolerance: e in [0, 1), in edge
// lengths: an edge counts only if its dual Voronoi edge, clipped to 1 / e edge lengths around the midpoint, is longer
// than e edge lengths; 0 gives every edge of the exact graph. Same bits for any num_threads. Throws std::bad_alloc.
SparsePattern delaunay_graph(const double* points, std::int64_t num_points, const std::int64_t* index,
                             const std::int64_t* ptr, std::int64_t num_segments, double tie_tolerance, int num_threads);

}  // namespace tensor_stereo
