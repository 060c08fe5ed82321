// The Delaunay graph of one segment.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "sweep_hull.hpp"
#include "tensor_stereo/buffer.hpp"
#include "tensor_stereo/delaunay_graph.hpp"
#include "tensor_stereo/graph_edges.hpp"
#include "tensor_stereo/index.hpp"
#include "tensor_stereo/triangulation.hpp"

namespace tensor_stereo {

// Builds one segment after the other and keeps its memory.
class SegmentGraph {
   public:
    SegmentGraph(const double* points, double tie_tolerance) : points_(points), edges_(tie_tolerance) {}

    // Writes the degrees of the vertices and, one row after the other, their ascending neighbours (at most 6 count).
    void build(const std::int64_t* index, std::size_t count, Index* degree, Index* neighbors) {
        std::fill_n(degree, count, 0);
        if (count == 0) return;
        triangulate(points_, index, count, mesh_, workspace_);
        if (!mesh_.is_collinear) edges_.decide(mesh_);
        each_edge([degree](Index i, Index) { ++degree[i]; });
        start_.resize(count + 1);
        start_[0] = 0;
        for (std::size_t v = 0; v < count; ++v) start_[v + 1] = start_[v] + degree[v];
        // The pattern is symmetric: filling the rows in any order and transposing sorts them without a comparison.
        unsorted_.resize(start_[count]);
        position_.assign(start_.begin(), start_.end() - 1);
        each_edge([this](Index i, Index j) { unsorted_[position_[i]++] = j; });
        position_.assign(start_.begin(), start_.end() - 1);
        for (std::size_t v = 0; v < count; ++v) {
            for (Index k = start_[v]; k < start_[v + 1]; ++k) {
                neighbors[position_[unsorted_[k]]++] = static_cast<Index>(v);
            }
        }
    }

    const Triangulation& mesh() const noexcept { return mesh_; }
    const GraphEdges& edges() const noexcept { return edges_; }

   private:
    // Both directions of every edge, vertices as in the input.
    template <class Visit>
    void each_edge(const Visit& visit) const {
        const Index* const vertex = mesh_.vertex.data();
        if (mesh_.is_collinear) {
            for (std::size_t k = 0; k + 1 < mesh_.vertex.size(); ++k) {
                visit(vertex[k], vertex[k + 1]);
                visit(vertex[k + 1], vertex[k]);
            }
        } else {
            edges_.each(mesh_, [&](Index i, Index j) { visit(vertex[i], vertex[j]); });
        }
    }

    const double* points_;
    GraphEdges edges_;
    Triangulation mesh_;
    Workspace workspace_;
    std::vector<Index> start_, position_, unsorted_;
};

// What the segments of a batch write side by side: 6 places for the neighbours of each vertex, because a planar graph
// has fewer; neighbours are numbered within the segment.
struct SegmentRows {
    explicit SegmentRows(std::int64_t num_vertices)
        : degree(allocate<Index>(num_vertices)), neighbors(allocate<Index>(6 * num_vertices)) {}

    Buffer<Index> degree, neighbors;
};

// The row of vertex v of a segment; codes below zero stay as they are.
inline std::int64_t to_row(const std::int64_t* members, Index v) noexcept { return v < 0 ? v : members[v]; }

// One pattern over all points from the rows of its segments.
SparsePattern assemble(const SegmentRows& rows, std::int64_t num_points, const std::int64_t* index,
                       const std::int64_t* ptr, std::int64_t num_segments, int num_threads);

}  // namespace tensor_stereo
