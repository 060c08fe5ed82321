#include "tensor_stereo/point_search.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "tensor_stereo/critical_points.hpp"

namespace tensor_stereo {
namespace {

bool is_before(Point p, Point q) { return p.x < q.x || (p.x == q.x && p.y < q.y); }

bool is_between(Point p, Point a, Point b) {
    return a.x == b.x ? (a.y < p.y) != (b.y < p.y) && p.y != a.y && p.y != b.y
                      : (a.x < p.x) != (b.x < p.x) && p.x != a.x && p.x != b.x;
}

}  // namespace

// What is sought, the best so far, and a circle through the ends that holds all points of the left that are as good.
struct PointSearch::Query {
    Index i, j, best = kNone;
    Point a, b, centre{};
    double radius_squared = std::numeric_limits<double>::infinity(), scale, enough;

    // Larger where rounding may matter: circles through both ends grow to the left with the distance of their centre.
    // False: that is enough.
    bool take(Index v, Point k) {
        best = v;
        const double dx = b.x - a.x, dy = b.y - a.y, value = dual_end(a, b, k);
        const double offset = value + (value - least_dual_end(a, b, k));
        if (offset < enough) return false;
        if (!(std::fabs(offset) < 1e6)) {  // a half-plane, nearly
            radius_squared = std::numeric_limits<double>::infinity();
            return true;
        }
        centre = {a.x + 0.5 * dx - offset * dy, a.y + 0.5 * dy + offset * dx};
        radius_squared = (dx * dx + dy * dy) * (0.25 + offset * offset);
        return true;
    }

    double distance_squared(Point low, Point high) const {
        const double x = std::max({low.x - centre.x, centre.x - high.x, 0.0});
        const double y = std::max({low.y - centre.y, centre.y - high.y, 0.0});
        return x * x + y * y;
    }

    bool passes_over(const Box& box) const {
        // the corner that lies furthest to the left
        const double dx = b.x - a.x, dy = b.y - a.y;
        const double x = dy > 0 ? box.low.x : box.high.x, y = dx > 0 ? box.high.y : box.low.y;
        if (dx * (y - a.y) - dy * (x - a.x) < -1e-12 * scale * scale) return true;
        const double margin = 1e-12 * (radius_squared + scale * scale);
        return radius_squared < std::numeric_limits<double>::infinity() &&
               distance_squared(box.low, box.high) > radius_squared + margin;
    }
};

void PointSearch::build(const std::vector<Point>& points, const Bounds& bounds) {
    points_ = points.data();
    bounds_ = bounds;
    order_.resize(points.size());
    std::iota(order_.begin(), order_.end(), 0);
    nodes_.clear();
    build_node(0, static_cast<Index>(points.size()));
}

Index PointSearch::build_node(Index begin, Index end) {
    Box box{points_[order_[begin]], points_[order_[begin]], begin, end, kNone};
    for (Index k = begin; k < end; ++k) {
        const Point p = points_[order_[k]];
        box.low = {std::min(box.low.x, p.x), std::min(box.low.y, p.y)};
        box.high = {std::max(box.high.x, p.x), std::max(box.high.y, p.y)};
    }
    const auto node = static_cast<Index>(nodes_.size());
    nodes_.push_back(box);
    if (end - begin > kLeaf) {
        const Index middle = begin + (end - begin) / 2;
        const bool along_x = box.high.x - box.low.x > box.high.y - box.low.y;
        std::nth_element(order_.begin() + begin, order_.begin() + middle, order_.begin() + end, [&](Index v, Index w) {
            return along_x ? points_[v].x < points_[w].x : points_[v].y < points_[w].y;
        });
        build_node(begin, middle);
        nodes_[node].right = build_node(middle, end);
    }
    return node;
}

Index PointSearch::find_left(Index i, Index j, double enough) {
    const Box& all = nodes_[0];
    Query query{i, j, kNone, points_[i], points_[j], {}, std::numeric_limits<double>::infinity(), 0, enough};
    query.scale = std::max(std::fabs(all.low.x), std::fabs(all.high.x)) +
                  std::max(std::fabs(all.low.y), std::fabs(all.high.y));  // at least half the side of all
    query.centre = {0.5 * (query.a.x + query.b.x), 0.5 * (query.a.y + query.b.y)};
    return look(query, 0) ? query.best : kBlocked;
}

// False: blocked.
bool PointSearch::look(Query& query, Index node) const {
    const Box& box = nodes_[node];
    if (query.passes_over(box)) return true;
    if (box.right != kNone) {
        Index first = node + 1, second = box.right;
        const auto distance = [&](Index k) { return query.distance_squared(nodes_[k].low, nodes_[k].high); };
        if (distance(second) < distance(first)) std::swap(first, second);
        return look(query, first) && look(query, second);
    }
    for (Index k = box.begin; k < box.end; ++k) {
        const Index v = order_[k];
        if (v == query.i || v == query.j) continue;
        const Point p = points_[v];
        const int side = orientation(query.a, query.b, p, bounds_);
        if (side < 0) continue;
        if (side == 0) {
            if (is_between(p, query.a, query.b)) return false;
            continue;
        }
        const int inside = query.best == kNone ? 1 : incircle(query.a, query.b, points_[query.best], p, bounds_);
        if ((inside > 0 || (inside == 0 && is_before(p, points_[query.best]))) && !query.take(v, p)) return false;
    }
    return true;
}

}  // namespace tensor_stereo
