// What the soft consistency of putative matches needs of both views.
#pragma once

#include <cstdint>

#include "tensor_stereo/buffer.hpp"
#include "tensor_stereo/critical_points.hpp"
#include "tensor_stereo/delaunay_graph.hpp"

namespace tensor_stereo {

// The critical points of links in one view, as rows of the points; -1: none, -2: blocked or out of reach.
struct LinkGeometry {
    Buffer<std::int64_t> critical;  // (num_links, 2): right and left of the way from the first vertex to the second
    Buffer<bool> is_edge;           // (num_links) in the graph of that view
};

struct SoftMatchGraphs {
    SparsePattern graph[2];
    Buffer<std::int64_t> links;  // (num_links, 2) rows i < j, ascending within each segment
    std::int64_t num_links = 0;
    Buffer<std::int64_t> link_ptr;  // (num_segments + 1)
    LinkGeometry view[2];
};

// The graphs of two point sets over the same segments, and all links whose soft adjacency counts: the edges of both
// exact graphs, for each edge with critical points on both sides the link between these if it crosses the edge, and the
// chords of co-circular polygons with at most 16 corners. Arguments as those of delaunay_graph. Same bits for any
// num_threads.
SoftMatchGraphs soft_match_graphs(const double* points0, const double* points1, std::int64_t num_points,
                                  const std::int64_t* index, const std::int64_t* ptr, std::int64_t num_segments,
                                  double tie_tolerance, Reach reach, int num_threads);

}  // namespace tensor_stereo
