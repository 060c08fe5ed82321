// What the soft consistency of putative matches needs of both views.
#pragma once

#include <cstdint>
#include <vector>

#include "tensor_stereo/buffer.hpp"
#include "tensor_stereo/critical_points.hpp"
#include "tensor_stereo/delaunay_graph.hpp"

namespace tensor_stereo {

// Pairs of vertices with their critical points in one view, as rows of the points; -1: none, -2: blocked or out of reach.
struct CriticalPairs {
    Buffer<std::int64_t> critical;  // (num_pairs, 2): right and left of the way from the first vertex to the second
    Buffer<bool> is_edge;           // (num_pairs) in the graph of that view
};

// Critical points (num_pairs, 2) of given pairs of rows, as in CriticalPairs but without reach: pairs pair_ptr[s] to
// pair_ptr[s + 1] are vertices of segment s.
Buffer<std::int64_t> dual_critical_points(const double* points, const std::int64_t* index, const std::int64_t* ptr,
                                          std::int64_t num_segments, const std::int64_t* pairs,
                                          const std::int64_t* pair_ptr, int num_threads);

struct SoftMatchGraphs {
    SparsePattern graph[2];
    Buffer<std::int64_t> pairs;  // (num_pairs, 2) rows i < j, ascending within each segment
    std::int64_t num_pairs = 0;
    Buffer<std::int64_t> pair_ptr;  // (num_segments + 1)
    CriticalPairs view[2];
};

// The graphs of two point sets over the same segments, and all pairs whose soft adjacency counts: the edges of both exact
// graphs, for each edge with critical points on both sides that pair if it crosses the edge, and the chords of co-circular
// polygons with at most 16 corners. Arguments as those of delaunay_graph. Same bits for any num_threads.
SoftMatchGraphs soft_match_graphs(const double* points0, const double* points1, std::int64_t num_points,
                                  const std::int64_t* index, const std::int64_t* ptr, std::int64_t num_segments,
                                  double tie_tolerance, Reach reach, int num_threads);

}  // namespace tensor_stereo
