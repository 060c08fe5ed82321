// Guibas & Stolfi, "Primitives for the Manipulation of General Subdivisions and the Computation of Voronoi Diagrams",
// ACM Transactions on Graphics 4 (1985), section 9.
#include "divide_and_conquer.hpp"

#include <algorithm>
#include <numeric>
#include <utility>
#include <vector>

namespace tensor_stereo {
namespace {

// Half-edges 2k and 2k + 1 of edge k, each in the counter-clockwise ring of edges around its origin.
class Rings {
   public:
    explicit Rings(const Triangulation& mesh) : points_(mesh.points.data()), bounds_(mesh.bounds) {
        const std::size_t half_edges = 8 * mesh.points.size();
        for (auto* const values : {&origin, &after, &before}) values->reserve(half_edges);
    }

    std::vector<Index> origin, after, before;

    Index left_next(Index edge) const noexcept { return before[edge ^ 1]; }

    // Hull edges out of the leftmost and the rightmost point of points[start, stop).
    std::pair<Index, Index> build(Index start, Index stop) {
        if (stop - start == 2) {
            const Index edge = add(start, start + 1);
            return {edge, edge ^ 1};
        }
        if (stop - start == 3) {
            const Index a = add(start, start + 1), b = add(start + 1, start + 2);
            splice(a ^ 1, b);
            const int turn = orientation(points_[start], points_[start + 1], points_[start + 2], bounds_);
            if (turn == 0) return {a, b ^ 1};
            const Index c = connect(b, a);
            return turn > 0 ? std::pair{a, b ^ 1} : std::pair{c ^ 1, c};
        }
        const Index middle = start + (stop - start) / 2;
        const auto [left_outer, left_inner] = build(start, middle);
        const auto [right_inner, right_outer] = build(middle, stop);
        return merge(left_outer, left_inner, right_inner, right_outer);
    }

   private:
    Index end(Index edge) const noexcept { return origin[edge ^ 1]; }

    bool is_left(Index vertex, Index edge) const noexcept {
        return orientation(points_[vertex], points_[origin[edge]], points_[end(edge)], bounds_) > 0;
    }

    bool is_right(Index vertex, Index edge) const noexcept {
        return orientation(points_[vertex], points_[end(edge)], points_[origin[edge]], bounds_) > 0;
    }

    bool is_inside(Index a, Index b, Index c, Index d) const noexcept {
        return incircle(points_[a], points_[b], points_[c], points_[d], bounds_) > 0;
    }

    Index add(Index from, Index to) {
        Index edge;
        if (free_.empty()) {
            edge = static_cast<Index>(origin.size());
            for (auto* const values : {&origin, &after, &before}) values->resize(edge + 2);
        } else {
            edge = free_.back();
            free_.pop_back();
        }
        origin[edge] = from;
        origin[edge ^ 1] = to;
        after[edge] = before[edge] = edge;
        after[edge ^ 1] = before[edge ^ 1] = edge ^ 1;
        return edge;
    }

    void splice(Index a, Index b) noexcept {
        std::swap(after[a], after[b]);
        before[after[a]] = a;
        before[after[b]] = b;
    }

    // New edge from the end of a to the origin of b, with the same face on the left of all three.
    Index connect(Index a, Index b) {
        const Index edge = add(end(a), origin[b]);
        splice(edge, left_next(a));
        splice(edge ^ 1, b);
        return edge;
    }

    void remove(Index edge) {
        splice(edge, before[edge]);
        splice(edge ^ 1, before[edge ^ 1]);
        origin[edge] = origin[edge ^ 1] = kNone;
        free_.push_back(edge & ~1);
    }

    std::pair<Index, Index> merge(Index left_outer, Index left_inner, Index right_inner, Index right_outer) {
        while (true) {  // lower common tangent
            if (is_left(origin[right_inner], left_inner)) {
                left_inner = left_next(left_inner);
            } else if (is_right(origin[left_inner], right_inner)) {
                right_inner = after[right_inner ^ 1];
            } else {
                break;
            }
        }
        Index base = connect(right_inner ^ 1, left_inner);
        if (origin[left_inner] == origin[left_outer]) left_outer = base ^ 1;
        if (origin[right_inner] == origin[right_outer]) right_outer = base;
        while (true) {  // stitch upwards
            Index left = after[base ^ 1], right = before[base];
            const bool left_above = is_right(end(left), base), right_above = is_right(end(right), base);
            if (!left_above && !right_above) return {left_outer, right_outer};
            if (left_above) {
                while (is_right(end(after[left]), base) &&
                       is_inside(end(base), origin[base], end(left), end(after[left]))) {
                    const Index following = after[left];
                    remove(left);
                    left = following;
                }
            }
            if (right_above) {
                while (is_right(end(before[right]), base) &&
                       is_inside(end(base), origin[base], end(right), end(before[right]))) {
                    const Index following = before[right];
                    remove(right);
                    right = following;
                }
            }
            if (!left_above || (right_above && is_inside(end(left), origin[left], origin[right], end(right)))) {
                base = connect(right, base ^ 1);
            } else {
                base = connect(base ^ 1, left ^ 1);
            }
        }
    }

    const Point* points_;
    const Bounds bounds_;
    std::vector<Index> free_;
};

}  // namespace

void divide_and_conquer(Triangulation& result) {
    const auto count = static_cast<Index>(result.points.size());
    std::vector<Index> order(count);
    std::iota(order.begin(), order.end(), 0);
    std::sort(order.begin(), order.end(), [&](Index i, Index j) {
        const Point a = result.points[i], b = result.points[j];
        return a.x < b.x || (a.x == b.x && a.y < b.y);
    });
    std::vector<Point> points(count);
    std::vector<Index> vertex(count);
    for (Index k = 0; k < count; ++k) {
        points[k] = result.points[order[k]];
        vertex[k] = result.vertex[order[k]];
    }
    result.points.swap(points);
    result.vertex.swap(vertex);

    Rings rings(result);
    rings.build(0, count);
    const auto half_edges = static_cast<Index>(rings.origin.size());
    std::vector<Index> corner(half_edges, kNone);  // the half-edge of the result that one of the rings becomes
    result.origin.clear();
    for (Index e = 0; e < half_edges; ++e) {
        if (rings.origin[e] == kNone || corner[e] != kNone) continue;
        const Index f = rings.left_next(e), g = rings.left_next(f);
        if (rings.left_next(g) != e) continue;
        const Index a = rings.origin[e], b = rings.origin[f], c = rings.origin[g];
        const int turn = orientation(result.points[a], result.points[b], result.points[c], result.bounds);
        if (turn <= 0) continue;  // the outer face
        for (const Index h : {e, f, g}) {
            corner[h] = static_cast<Index>(result.origin.size());
            result.origin.push_back(rings.origin[h]);
        }
    }
    result.twin.resize(result.origin.size());
    for (Index e = 0; e < half_edges; ++e) {
        if (corner[e] != kNone) result.twin[corner[e]] = corner[e ^ 1];
    }
    result.is_collinear = result.origin.empty();
}

}  // namespace tensor_stereo
