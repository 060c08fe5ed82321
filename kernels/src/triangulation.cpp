#include "tensor_stereo/triangulation.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>

namespace tensor_stereo {
namespace {

constexpr std::size_t kFlipsPerPoint = 16;  // uniform points need three

// Positive floats order as their bits do.
inline std::uint32_t order_bits(double value) noexcept { return std::bit_cast<std::uint32_t>(static_cast<float>(value)); }

// Sorts by the squared distance from the centre of the bounding box: each point lies outside the hull of those before
// it, but for rounding. Radix passes order by the distance as a float, insertion repairs what that rounds together.
void sort_radially(const double* points, const std::int64_t* index, std::size_t count, Triangulation& result,
                   Workspace& workspace, Point& centre) {
    double min_x = std::numeric_limits<double>::infinity(), min_y = min_x, max_x = -min_x, max_y = -min_x;
    for (std::size_t k = 0; k < count; ++k) {
        const double x = points[2 * index[k]], y = points[2 * index[k] + 1];
        min_x = std::min(min_x, x), max_x = std::max(max_x, x);
        min_y = std::min(min_y, y), max_y = std::max(max_y, y);
    }
    centre = {min_x + (max_x - min_x) / 2, min_y + (max_y - min_y) / 2};
    const double dx0 = max_x - centre.x, dy0 = max_y - centre.y;
    const double largest = std::max(dx0 * dx0 + dy0 * dy0, std::numeric_limits<double>::min());
    const double scale = 1 / largest;

    workspace.keys.resize(count);
    workspace.keys_buffer.resize(count);
    constexpr int kBits = 8;
    std::array<std::array<std::uint32_t, 1 << kBits>, 4> histogram{};
    for (std::size_t k = 0; k < count; ++k) {
        const double dx = points[2 * index[k]] - centre.x, dy = points[2 * index[k] + 1] - centre.y;
        const std::uint32_t bits = order_bits((dx * dx + dy * dy) * scale);
        workspace.keys[k] = static_cast<std::uint64_t>(bits) << 32 | k;
        for (int pass = 0; pass < 4; ++pass) ++histogram[pass][(bits >> (kBits * pass)) & 255];
    }
    for (int pass = 0; pass < 4; ++pass) {
        auto& bucket = histogram[pass];
        const int shift = 32 + kBits * pass;
        if (bucket[(workspace.keys[0] >> shift) & 255] == count) continue;  // all alike in these bits
        std::uint32_t sum = 0;
        for (auto& size : bucket) sum += std::exchange(size, sum);
        for (const std::uint64_t key : workspace.keys) workspace.keys_buffer[bucket[(key >> shift) & 255]++] = key;
        workspace.keys.swap(workspace.keys_buffer);
    }
    auto& order = workspace.order;
    order.resize(count);
    std::size_t shifts = 0;
    for (std::size_t k = 0; k < count; ++k) {
        const auto row = static_cast<Index>(workspace.keys[k] & 0xffffffff);
        const double dx = points[2 * index[row]] - centre.x, dy = points[2 * index[row] + 1] - centre.y;
        const Radial item{dx * dx + dy * dy, row};
        std::size_t hole = k;
        if (shifts <= 8 * count) {
            for (; hole > 0 && order[hole - 1].distance > item.distance; --hole, ++shifts) order[hole] = order[hole - 1];
        }
        order[hole] = item;
    }
    if (shifts > 8 * count) {  // points on a circle are all alike as floats
        std::sort(order.begin(), order.end(), [](const Radial& a, const Radial& b) {
            return a.distance < b.distance || (a.distance == b.distance && a.row < b.row);
        });
    }
    result.points.resize(count);
    result.vertex.resize(count);
    for (std::size_t k = 0; k < count; ++k) {
        const Index row = order[k].row;
        result.points[k] = {points[2 * index[row]], points[2 * index[row] + 1]};
        result.vertex[k] = row;
    }
}

// Grows with the angle around the origin, from 0 to 1.
inline double pseudo_angle(double dx, double dy) noexcept {
    const double length = std::fabs(dx) + std::fabs(dy);
    if (length == 0) return 0;
    const double p = dx / length;
    return (dy > 0 ? 3 - p : 1 + p) / 4;
}

class SweepHull {
   public:
    SweepHull(Triangulation& mesh, Workspace& workspace, Point centre)
        : mesh_(mesh), space_(workspace), points_(mesh.points.data()), bounds_(mesh.bounds), centre_(centre) {}

    // False if the sweep must be given up.
    bool run() {
        const auto count = static_cast<Index>(mesh_.points.size());
        budget_ = kFlipsPerPoint * static_cast<std::size_t>(count) + 64;
        const std::size_t half_edges = 3 * (2 * static_cast<std::size_t>(count));
        mesh_.origin.resize(half_edges);
        mesh_.twin.resize(half_edges);
        size_ = 0;
        space_.hull_next.resize(count);
        space_.hull_previous.resize(count);
        space_.hull_edge.resize(count);
        hash_size_ = std::max<Index>(4, static_cast<Index>(std::ceil(std::sqrt(static_cast<double>(count)))));
        space_.hull_hash.assign(hash_size_, kNone);
        hull_size_ = 0;

        Index first = seed();
        if (first == kNone) return true;  // collinear
        for (; first < count; ++first) {
            if (!insert(first)) return false;
        }
        mesh_.origin.resize(size_);
        mesh_.twin.resize(size_);
        return true;
    }

   private:
    // The shortest prefix that is not collinear becomes a fan around its last point; the next point, or kNone.
    Index seed() {
        const auto count = static_cast<Index>(mesh_.points.size());
        Index apex = 2;
        while (apex < count && orientation(points_[0], points_[1], points_[apex], bounds_) == 0) ++apex;
        std::vector<Index> line(std::min(apex, count));
        std::iota(line.begin(), line.end(), 0);
        std::sort(line.begin(), line.end(), [this](Index i, Index j) {
            return points_[i].x < points_[j].x || (points_[i].x == points_[j].x && points_[i].y < points_[j].y);
        });
        if (apex >= count) {
            std::vector<Point> points(line.size());
            std::vector<Index> vertex(line.size());
            for (std::size_t k = 0; k < line.size(); ++k) {
                points[k] = mesh_.points[line[k]];
                vertex[k] = mesh_.vertex[line[k]];
            }
            mesh_.points.swap(points);
            mesh_.vertex.swap(vertex);
            mesh_.origin.clear();
            mesh_.twin.clear();
            mesh_.is_collinear = true;
            return kNone;
        }
        if (orientation(points_[line[0]], points_[line[1]], points_[apex], bounds_) < 0) {
            std::reverse(line.begin(), line.end());
        }
        Index shared = kNone;  // half-edge from the apex to line[k]
        for (std::size_t k = 0; k + 1 < line.size(); ++k) {
            const Index t = add_triangle(line[k], line[k + 1], apex, kNone, kNone, shared);
            shared = t + 1;  // line[k + 1] -> apex
            link_hull(line[k], line[k + 1]);
        }
        link_hull(line.back(), apex);
        link_hull(apex, line.front());
        for (const Index v : line) space_.hull_hash[bucket(v)] = v;
        space_.hull_hash[bucket(apex)] = apex;
        start_ = apex;
        hull_size_ = apex + 1;
        return apex + 1;
    }

    bool insert(Index p) {
        auto& next = space_.hull_next;
        auto& previous = space_.hull_previous;
        const Point point = points_[p];
        Index begin = start_;
        const Index key = bucket(p);
        for (Index k = 0; k < hash_size_; ++k) {
            Index slot = key + k;
            if (slot >= hash_size_) slot -= hash_size_;
            const Index candidate = space_.hull_hash[slot];
            if (candidate != kNone && next[candidate] != candidate) {  // still on the hull
                begin = candidate;
                break;
            }
        }
        begin = previous[begin];
        Index e = begin;
        while (!sees(point, e, next[e])) {
            e = next[e];
            if (e == begin) return false;  // rounding has put the point inside the hull or on it
        }

        Index t = add_triangle(e, p, next[e], kNone, kNone, space_.hull_edge[e]);
        if (!legalize(t + 2)) return false;
        Index n = next[e];
        while (sees(point, n, next[n])) {
            const Index q = next[n];
            t = add_triangle(n, p, q, space_.hull_edge[p], kNone, space_.hull_edge[n]);
            if (!legalize(t + 2)) return false;
            next[n] = n;  // no longer on the hull
            --hull_size_;
            n = q;
        }
        if (e == begin) {
            while (sees(point, previous[e], e)) {
                const Index q = previous[e];
                t = add_triangle(q, p, e, kNone, space_.hull_edge[e], space_.hull_edge[q]);
                if (!legalize(t + 2)) return false;
                next[e] = e;
                --hull_size_;
                e = q;
            }
        }
        link_hull(e, p);
        link_hull(p, n);
        start_ = e;
        space_.hull_hash[key] = p;
        space_.hull_hash[bucket(e)] = e;
        if (++hull_size_ > 2 * hash_size_) rehash();
        return true;
    }

    // Long hulls, as of points on a circle, need more buckets.
    void rehash() {
        hash_size_ *= 4;
        space_.hull_hash.assign(hash_size_, kNone);
        Index v = start_;
        do {
            space_.hull_hash[bucket(v)] = v;
            v = space_.hull_next[v];
        } while (v != start_);
    }

    // Whether a point lies strictly on the outer side of the hull edge from e to q.
    bool sees(Point point, Index e, Index q) const noexcept {
        return orientation(points_[e], points_[q], point, bounds_) < 0;
    }

    void link_hull(Index v, Index w) noexcept {
        space_.hull_next[v] = w;
        space_.hull_previous[w] = v;
    }

    Index bucket(Index v) const noexcept {
        const double angle = pseudo_angle(points_[v].x - centre_.x, points_[v].y - centre_.y);
        return std::min(static_cast<Index>(angle * hash_size_), hash_size_ - 1);
    }

    Index add_triangle(Index i, Index j, Index k, Index twin_i, Index twin_j, Index twin_k) noexcept {
        const Index t = size_;
        size_ += 3;
        mesh_.origin[t] = i;
        mesh_.origin[t + 1] = j;
        mesh_.origin[t + 2] = k;
        link(t, twin_i);
        link(t + 1, twin_j);
        link(t + 2, twin_k);
        return t;
    }

    void link(Index h, Index twin) noexcept {
        mesh_.twin[h] = twin;
        if (twin != kNone) {
            mesh_.twin[twin] = h;
        } else {
            space_.hull_edge[mesh_.origin[h]] = h;
        }
    }

    // Flips until no edge opposite to the new point has a point strictly inside its circle; false past the budget.
    bool legalize(Index a) {
        auto& stack = space_.stack;
        stack.clear();
        while (true) {
            const Index b = mesh_.twin[a];
            if (b != kNone) {
                const Index al = next_in_triangle(a), ar = previous_in_triangle(a);
                const Index br = next_in_triangle(b), bl = previous_in_triangle(b);
                const Index p0 = mesh_.origin[ar], p1 = mesh_.origin[bl];
                if (incircle(points_[mesh_.origin[a]], points_[mesh_.origin[al]], points_[p0], points_[p1], bounds_) > 0) {
                    mesh_.origin[a] = p1;
                    mesh_.origin[b] = p0;
                    link(a, mesh_.twin[bl]);
                    link(b, mesh_.twin[ar]);
                    mesh_.twin[ar] = bl;
                    mesh_.twin[bl] = ar;
                    if (++flips_ > budget_) return false;
                    stack.push_back(br);
                    continue;
                }
            }
            if (stack.empty()) return true;
            a = stack.back();
            stack.pop_back();
        }
    }

    Triangulation& mesh_;
    Workspace& space_;
    const Point* points_;
    const Bounds bounds_;
    Point centre_;
    Index size_ = 0, hash_size_ = 0, hull_size_ = 0, start_ = 0;
    std::size_t flips_ = 0, budget_ = 0;
};

}  // namespace

Bounds determinant_bounds(const Point* points, std::size_t count) noexcept {
    double min_x = points[0].x, min_y = points[0].y, max_x = min_x, max_y = min_y;
    for (std::size_t k = 1; k < count; ++k) {
        min_x = std::min(min_x, points[k].x), max_x = std::max(max_x, points[k].x);
        min_y = std::min(min_y, points[k].y), max_y = std::max(max_y, points[k].y);
    }
    const double side = std::max(max_x - min_x, max_y - min_y);
    if (side == 0) return {};
    int exponent;
    std::frexp(side, &exponent);  // side <= 2^exponent
    // On a grid of spacing 2^k with at most 2^12 steps, degree-4 determinants have at most 4 * 12 + 4 bits.
    const double steps = std::ldexp(1.0, 12 - exponent);
    for (std::size_t k = 0; k < count; ++k) {
        const double x = points[k].x * steps, y = points[k].y * steps;  // exact
        if (x != std::nearbyint(x) || y != std::nearbyint(y)) return Bounds::of_square(side);
    }
    return {};
}

void triangulate(const double* points, const std::int64_t* index, std::size_t count, Triangulation& result,
                 Workspace& workspace) {
    Point centre;
    sort_radially(points, index, count, result, workspace, centre);
    result.is_collinear = count < 3;
    if (result.is_collinear) {
        result.origin.clear();
        result.twin.clear();
        return;
    }
    result.bounds = determinant_bounds(result.points.data(), count);
    if (!SweepHull(result, workspace, centre).run()) divide_and_conquer(result);
}

}  // namespace tensor_stereo
