// The points that bound the dual Voronoi edge of a link.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

#include "tensor_stereo/graph_edges.hpp"
#include "tensor_stereo/index.hpp"
#include "tensor_stereo/point_search.hpp"
#include "tensor_stereo/predicates.hpp"
#include "tensor_stereo/triangulation.hpp"

namespace tensor_stereo {

// How negative a signed dual length may get before the link counts as blocked: the sum of both parts.
struct Reach {
    double edge_lengths, px;
};

// Signed distance of the centre of the circle through i, j and k from the midpoint of {i, j}, towards k, in lengths of
// {i, j}. The one expression that every back end evaluates; rounding cannot change the side on which k lies.
inline double dual_end(Point i, Point j, Point k) noexcept {
    const double dx = j.x - i.x, dy = j.y - i.y, x = k.x - i.x, y = k.y - i.y;
    return (x * (x - dx) + y * (y - dy)) / (2 * std::fabs(dx * y - dy * x));
}

// Such an end less what rounding may have added to it; this too every back end evaluates alike.
inline double least_dual_end(Point i, Point j, Point k) noexcept {
    const double dx = j.x - i.x, dy = j.y - i.y, x = k.x - i.x, y = k.y - i.y;
    const double scale = 0.5 / std::fabs(dx * y - dy * x), value = (x * (x - dx) + y * (y - dy)) * scale;
    const double size = std::fabs(x) + std::fabs(y), span = std::fabs(dx) + std::fabs(dy);
    return value - 2e-15 * (size * (size + (1 + 2 * std::fabs(value)) * span)) * scale;
}

// Of all points on one side of the line from i to j, the one that sees the segment under the largest angle: the circle
// through i, j and it has no other point of its side strictly inside. Of several the lexicographically first.
struct Critical {
    Index right, left;  // kNone: no point on that side; both kBlocked: a point lies between i and j, or out of reach
    bool is_edge;       // of the graph

    Critical reversed() const noexcept { return {left, right, is_edge}; }
};

inline constexpr Critical kBlockedLink{kBlocked, kBlocked, false};

// Finds them for links between points of one segment. If {i, j} is an edge of the mesh they are its opposite vertices;
// otherwise they are among the vertices of the triangles that the segment from i to j crosses, since the constrained
// Delaunay triangulation with that segment only changes these (Anglada, Computers & Graphics 21 (1997), section 3).
// After so many triangles all points are searched instead, by boxes.
class CriticalPoints {
   public:
    static constexpr Index kMaxSteps = 48;

    explicit CriticalPoints(Reach reach, Index max_steps = kMaxSteps)
        : reach_(reach), max_steps_(std::min(max_steps, kMaxSteps)) {}

    // Both must live on and stay as they are.
    void prepare(const Triangulation& mesh, const GraphEdges& edges);

    // Vertices are numbered as in the input of the triangulation, i != j.
    Critical find(Index i, Index j);

    // Those of an edge of the mesh, right and left of half-edge h, as far as they may be.
    Critical of_half_edge(Index h) const { return to_input(between(h)); }

    // The same, blocked if out of reach; rounding can do that to an edge between needles.
    Critical in_reach(Index h, Critical found) const noexcept;

    // Whether the critical points of an edge of the exact graph, right and left of its half-edge h, see each other
    // across it: the link between them takes its place when it vanishes.
    bool cross(Index h, const Critical& found) const noexcept;

    // The critical points of that link, seen from right to left, if it is plain that they are the ends of the edge.
    bool across(Index h, Critical& found) const noexcept;

   private:
    // An end of a dual edge, and a bound on its rounding.
    struct End {
        double value, error;

        double above() const noexcept { return value + error; }
    };

    // The vertices on one side of a way through the mesh.
    struct Chain {
        struct Corner {
            Index vertex, beyond;  // and the half-edge outside the chain's edge that leads to it
        };

        void start(Index vertex, Index beyond, const End& end) {
            size = 0;
            best = 0;
            best_end = end;
            any_tie = false;
            push(vertex, beyond);
        }

        void push(Index vertex, Index beyond) { corners[size++] = {vertex, beyond}; }

        Corner corners[kMaxSteps + 2];
        Index size;
        Index best;    // sees the segment under the largest angle
        End best_end;  // its dual end
        bool any_tie;  // others are as good
    };

    enum Side { kRight, kLeft };

    Critical to_input(Critical found) const noexcept;
    Critical find_in_mesh(Index i, Index j);
    Critical between(Index h) const;
    Critical walk(Index i, Index j, Index h);
    Critical search(Index i, Index j);
    int is_inside(int side, Index i, Index j, const Chain& chain, Index vertex) const noexcept;
    Index first_of_best(Index i, Index j, const Chain& chain) const;
    Index first_of_polygon(Index h, Index first) const;
    bool is_out_of_reach(Index i, Index j, Index right, Index left) const noexcept;
    bool is_before(Index v, Index w) const noexcept;

    int turn(Index a, Index b, Index c) const noexcept {
        return orientation(mesh_->points[a], mesh_->points[b], mesh_->points[c], mesh_->bounds);
    }

    double reach(Index i, Index j) const noexcept {
        if (reach_.px == 0) return reach_.edge_lengths;
        const double dx = mesh_->points[j].x - mesh_->points[i].x, dy = mesh_->points[j].y - mesh_->points[i].y;
        return reach_.edge_lengths + reach_.px / std::sqrt(dx * dx + dy * dy);
    }

    Reach reach_;
    Index max_steps_;
    PointSearch search_;
    bool has_search_ = false;  // search_ is that of these points
    const Triangulation* mesh_ = nullptr;
    const GraphEdges* edges_ = nullptr;
    std::vector<Index> fan_;  // of each vertex the half-edge from it that comes first counter-clockwise
    std::vector<Index> degree_;
    std::vector<Index> rank_;  // number in the mesh of each vertex of the input
    Chain chains_[2];
};

}  // namespace tensor_stereo
