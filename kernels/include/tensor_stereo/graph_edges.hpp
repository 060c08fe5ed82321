// Which edges of a triangulation belong to the Delaunay graph.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <utility>
#include <vector>

#include "tensor_stereo/triangulation.hpp"

namespace tensor_stereo {

// Decides for one triangulation after the other, and keeps its memory.
class GraphEdges {
   public:
    enum State : std::uint8_t { kShort, kLong, kTie };

    explicit GraphEdges(double tie_tolerance)
        : tolerance_(tie_tolerance),
          bound_(1 / tie_tolerance),
          // Below this sine of an angle, roughly, rounding could make a dual length of zero pass for one of e.
          condition_(16 * kEpsilon * (bound_ + 1) / tie_tolerance) {}

    // Decides which edges of the mesh belong to the graph.
    void decide(const Triangulation& mesh) {
        const auto half_edges = static_cast<Index>(mesh.origin.size());
        const Index* const twin = mesh.twin.data();
        state_.assign(half_edges, kLong);
        if (tolerance_ == 0) {
            for (Index h = 0; h < half_edges; ++h) {
                if (twin[h] < h && twin[h] != kNone && side(mesh, h) >= 0) state_[h] = state_[twin[h]] = kTie;
            }
        } else {
            measure(mesh);
            bool any_tie = false;
            for (Index h = 0; h < half_edges; ++h) {
                const bool is_long = ends_[h] + (twin[h] == kNone ? bound_ : ends_[twin[h]]) > tolerance_;
                if (is_long && !any_needle_) continue;
                if (twin[h] == kNone) {
                    state_[h] = is_long ? kLong : kShort;
                    continue;
                }
                // A short dual edge may be a tie; a long one with a needle beside it must prove that it is none.
                const bool is_tie = (!is_long || is_needle_[h / 3] || is_needle_[twin[h] / 3]) && side(mesh, h) == 0;
                state_[h] = is_tie ? kTie : is_long ? kLong : kShort;
                any_tie |= is_tie;
            }
            if (any_tie) settle_ties(mesh);
        }
    }

    // kLong: an edge of the graph; kShort: of the exact graph alone; kTie: of neither, its triangles are co-circular.
    State state(Index h) const noexcept { return state_[h]; }

    // Calls visit(i, j) for both directions of each of them, vertices in the mesh's own order.
    template <class Visit>
    void each(const Triangulation& mesh, const Visit& visit) const {
        const auto half_edges = static_cast<Index>(mesh.origin.size());
        for (Index t = 0; t < half_edges; t += 3) {
            const Index* const v = mesh.origin.data() + t;
            const std::pair<Index, Index> sides[] = {{v[0], v[1]}, {v[1], v[2]}, {v[2], v[0]}};
            for (Index k = 0; k < 3; ++k) {
                if (state_[t + k] != kLong) continue;
                visit(sides[k].first, sides[k].second);
                if (mesh.twin[t + k] == kNone) visit(sides[k].second, sides[k].first);
            }
        }
    }

   private:
    // In-circle sign of the vertex opposite to the twin, -1 on the hull.
    static int side(const Triangulation& mesh, Index h) noexcept {
        const Index t = mesh.twin[h];
        if (t == kNone) return -1;
        const Point* p = mesh.points.data();
        const Index* o = mesh.origin.data();
        const Point a = p[o[h]], b = p[o[next_in_triangle(h)]], c = p[o[previous_in_triangle(h)]];
        const Point d = p[o[previous_in_triangle(t)]];
        return incircle(a, b, c, d, mesh.bounds);
    }

    // Signed distance of the circle's centre from the midpoint of {i, j} towards k, in edge lengths: half the cotangent
    // of the angle at k.
    double end_of_dual(double dot, double cross) const noexcept {
        return std::min(std::max(0.5 * dot / std::fabs(cross), -bound_), bound_);
    }

    double end_of_dual(Point i, Point j, Point k) const noexcept {
        const double vx = i.x - k.x, vy = i.y - k.y, wx = j.x - k.x, wy = j.y - k.y;
        return end_of_dual(vx * wx + vy * wy, vx * wy - vy * wx);
    }

    // The ends of the dual edges of all half-edges, and the triangles in which rounding is felt.
    void measure(const Triangulation& mesh) {
        const std::size_t num_triangles = mesh.origin.size() / 3;
        ends_.resize(3 * num_triangles);
        is_needle_.resize(num_triangles);
        any_needle_ = false;
        for (std::size_t t = 0; t < num_triangles; ++t) {
            const Point a = mesh.points[mesh.origin[3 * t]], b = mesh.points[mesh.origin[3 * t + 1]],
                        c = mesh.points[mesh.origin[3 * t + 2]];
            // Negation does not round, so three differences serve the three corners.
            const double px = a.x - c.x, py = a.y - c.y, qx = b.x - c.x, qy = b.y - c.y, rx = a.x - b.x, ry = a.y - b.y;
            const double pq0 = px * qy, pq1 = py * qx, pr0 = px * ry, pr1 = py * rx, qr0 = qx * ry, qr1 = qy * rx;
            const double cross_c = std::fabs(pq0 - pq1), cross_a = std::fabs(pr0 - pr1), cross_b = std::fabs(qr0 - qr1);
            ends_[3 * t] = end_of_dual(px * qx + py * qy, cross_c);
            ends_[3 * t + 1] = end_of_dual(px * rx + py * ry, cross_a);
            ends_[3 * t + 2] = end_of_dual(-(qx * rx + qy * ry), cross_b);
            is_needle_[t] = !(cross_c > condition_ * (std::fabs(pq0) + std::fabs(pq1)) &&
                              cross_a > condition_ * (std::fabs(pr0) + std::fabs(pr1)) &&
                              cross_b > condition_ * (std::fabs(qr0) + std::fabs(qr1)));
            any_needle_ |= is_needle_[t] != 0;
        }
    }

    // A co-circular polygon may be cut in many ways, and its vertices give the same circle but for rounding. So that
    // the result depends on the points alone, its edges are measured from its lexicographically first vertex not on
    // them.
    void settle_ties(const Triangulation& mesh) {
        const auto half_edges = static_cast<Index>(mesh.origin.size());
        polygon_.resize(half_edges / 3);
        std::iota(polygon_.begin(), polygon_.end(), 0);
        is_tied_.assign(half_edges / 3, false);
        tied_.clear();
        for (Index h = 0; h < half_edges; ++h) {
            if (mesh.twin[h] == kNone || mesh.twin[h] > h || state_[h] != kTie) continue;
            for (const Index t : {h / 3, mesh.twin[h] / 3}) {
                if (!is_tied_[t]) tied_.push_back(t);
                is_tied_[t] = true;
            }
            polygon_[root(h / 3)] = root(mesh.twin[h] / 3);
        }
        const Point* points = mesh.points.data();
        first_.resize(half_edges / 3);
        for (const Index t : tied_) first_[t].fill(kNone);
        for (const Index t : tied_) {
            auto& first = first_[root(t)];
            for (Index h = 3 * t; h < 3 * t + 3; ++h) {  // insert into the three first
                Index v = mesh.origin[h];
                for (Index& slot : first) {
                    if (slot == v) break;
                    if (slot == kNone || is_before(points[v], points[slot])) std::swap(slot, v);
                    if (v == kNone) break;
                }
            }
        }
        for (const Index t : tied_) {
            const auto& first = first_[root(t)];
            for (Index h = 3 * t; h < 3 * t + 3; ++h) {
                const Index i = mesh.origin[h], j = mesh.origin[next_in_triangle(h)];
                const Index* chosen = first.data();
                while (*chosen == i || *chosen == j) ++chosen;
                ends_[h] = end_of_dual(points[i], points[j], points[*chosen]);
            }
        }
        for (const Index t : tied_) {
            for (Index h = 3 * t; h < 3 * t + 3; ++h) {
                const Index twin = mesh.twin[h];
                if (state_[h] == kTie) continue;
                const bool is_long = ends_[h] + (twin == kNone ? bound_ : ends_[twin]) > tolerance_;
                state_[h] = is_long ? kLong : kShort;
                if (twin != kNone) state_[twin] = state_[h];
            }
        }
    }

    Index root(Index t) noexcept {
        while (polygon_[t] != t) t = polygon_[t] = polygon_[polygon_[t]];
        return t;
    }

    static bool is_before(Point p, Point q) noexcept { return p.x < q.x || (p.x == q.x && p.y < q.y); }

    double tolerance_, bound_, condition_;
    std::vector<double> ends_;
    std::vector<std::uint8_t> is_needle_;
    bool any_needle_ = false;
    std::vector<State> state_;
    std::vector<Index> polygon_, tied_;
    std::vector<bool> is_tied_;
    std::vector<std::array<Index, 3>> first_;
};

}  // namespace tensor_stereo
