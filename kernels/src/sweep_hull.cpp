// Radial sweep (Sinclair, "S-hull", 2016) with the flips of a new point done at once: the triangles that have it inside
// their circles are carved out of the mesh (Bowyer, The Computer Journal 24 (1981)) and the hole is filled around it.
#include "sweep_hull.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <vector>

namespace tensor_stereo {
namespace {

constexpr std::size_t kRemovalsPerPoint = 16;  // uniform points need three

// Here half-edge 4 t + k is side k of triangle t.
inline Index next_side(Index h) noexcept { return (h & ~3) | (0b001001 >> 2 * (h & 3) & 3); }
inline Index previous_side(Index h) noexcept { return (h & ~3) | (0b010010 >> 2 * (h & 3) & 3); }

// Grows with the angle around the origin, from 0 to 1.
inline double pseudo_angle(double dx, double dy) noexcept {
    const double p = dx / std::max(std::fabs(dx) + std::fabs(dy), std::numeric_limits<double>::min());
    return (dy > 0 ? 3 - p : 1 + p) / 4;
}

class SweepHull {
   public:
    SweepHull(Triangulation& mesh, Workspace& workspace)
        : mesh_(mesh),
          space_(workspace),
          points_(mesh.points.data()),
          bounds_(mesh.bounds),
          count_(static_cast<Index>(mesh.points.size())) {}

    // False if the sweep must be given up.
    bool run() {
        space_.triangles.resize(2 * count_);
        space_.hull.resize(count_);
        space_.stack.resize(2 * count_);
        space_.free.resize(2 * count_);
        triangles_ = space_.triangles.data();
        hull_ = space_.hull.data();
        budget_ = kRemovalsPerPoint * static_cast<std::size_t>(count_) + 64;
        hash_size_ = std::max<Index>(4, static_cast<Index>(std::ceil(std::sqrt(static_cast<double>(count_)))));
        space_.hull_hash.assign(hash_size_, kNone);
        lift();
        Index first = seed();
        if (first == kNone) return true;  // collinear
        for (; first < count_; ++first) {
            if (!insert(first)) return false;
        }
        store();
        return true;
    }

   private:
    // Coordinates that keep the in-circle determinants free of rounding on a grid, and their errors small elsewhere.
    void lift() {
        const bool is_exact = bounds_.plane == 0;
        const Point origin = is_exact ? mesh_.box.corner : mesh_.box.centre, centre = mesh_.box.centre;
        space_.lifted.resize(count_);
        lifted_ = space_.lifted.data();
        for (Index v = 0; v < count_; ++v) {
            const double x = points_[v].x - origin.x, y = points_[v].y - origin.y;
            lifted_[v] = {x, y, x * x + y * y, pseudo_angle(points_[v].x - centre.x, points_[v].y - centre.y)};
        }
    }

    // The shortest prefix that is not collinear becomes a fan around its last point; the next point, or kNone.
    Index seed() {
        Index apex = 2;
        while (apex < count_ && orientation(points_[0], points_[1], points_[apex], bounds_) == 0) ++apex;
        std::vector<Index> line(std::min(apex, count_));
        std::iota(line.begin(), line.end(), 0);
        std::sort(line.begin(), line.end(), [this](Index i, Index j) {
            return points_[i].x < points_[j].x || (points_[i].x == points_[j].x && points_[i].y < points_[j].y);
        });
        if (apex >= count_) {
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
            const Index t = size_++;
            Triangle& triangle = triangles_[t];
            triangle.origin = {line[k], line[k + 1], apex};
            set_plane(triangle, from(apex, line[k + 1]), from(apex, line[k]), lifted_[apex]);
            join(4 * t, kNone);
            join(4 * t + 1, kNone);
            join(4 * t + 2, shared);
            shared = 4 * t + 1;
            join_hull(line[k], line[k + 1]);
        }
        join_hull(line.back(), apex);
        join_hull(apex, line.front());
        for (const Index v : line) space_.hull_hash[bucket(v)] = v;
        space_.hull_hash[bucket(apex)] = apex;
        start_ = apex;
        hull_size_ = apex + 1;
        return apex + 1;
    }

    bool insert(Index p) {
        const Point point = points_[p];
        const Lifted lifted = lifted_[p];
        const Index key = bucket(p);
        const Index begin = hull_[near_hull_vertex(key)].previous;
        Index first = begin;
        while (!sees(point, first, hull_[first].next)) {
            first = hull_[first].next;
            if (first == begin) return false;  // rounding has put the point inside the hull or on it
        }
        Index last = hull_[first].next;
        while (sees(point, last, hull_[last].next)) last = hull_[last].next;
        if (first == begin) {
            while (sees(point, hull_[first].previous, first)) first = hull_[first].previous;
        }

        // Every triangle of the cavity hangs on one visible hull edge, so its rim from first to last comes in order,
        // and what was read can be overwritten.
        Hole* const stack = space_.stack.data();
        Index* const free = space_.free.data();
        Index num_free = 0, before = kNone;  // before: half-edge from p in the triangle filled last
        Lifted u = from(p, first);
        for (Index v = first; v != last;) {
            const Index stop = hull_[v].next;
            Index origin = v, beyond = hull_[v].edge, depth = 0;
            while (true) {
                if (beyond != kNone && is_inside(point, lifted, triangles_[beyond >> 2])) {
                    if (++removals_ > budget_) return false;
                    const Triangle& triangle = triangles_[beyond >> 2];
                    free[num_free++] = beyond >> 2;
                    const Index left = previous_side(beyond) & 3, right = next_side(beyond) & 3;
                    stack[depth++] = {triangle.origin[left], triangle.twin[right]};
                    beyond = triangle.twin[left];
                    continue;
                }
                const Index end = depth > 0 ? stack[depth - 1].origin : stop;
                const Index t = num_free > 0 ? free[--num_free] : size_++;
                const Lifted w = from(p, end);
                Triangle& triangle = triangles_[t];
                triangle.origin = {origin, p, end};
                set_plane(triangle, u, w, lifted);
                join(4 * t, before);
                join(4 * t + 2, beyond);
                before = 4 * t + 1;
                u = w;
                if (depth == 0) break;
                origin = stack[--depth].origin;
                beyond = stack[depth].beyond;
            }
            if (v != first) {
                hull_[v].next = v;  // no longer on the hull
                --hull_size_;
            }
            v = stop;
        }
        join(before, kNone);
        join_hull(first, p);
        join_hull(p, last);
        start_ = first;
        space_.hull_hash[key] = p;
        space_.hull_hash[bucket(first)] = first;
        if (++hull_size_ > 2 * hash_size_) rehash();
        return true;
    }

    // A hull vertex from the nearest bucket that has one, or nearly: a little ahead, else to both sides.
    Index near_hull_vertex(Index key) const noexcept {
        Index above = key;
        for (Index k = 0; k < 4; ++k) {
            const Index v = space_.hull_hash[above];
            if (is_on_hull(v)) return v;
            if (++above == hash_size_) above = 0;
        }
        Index below = key;
        for (Index k = 0; 2 * k <= hash_size_; ++k) {
            if (--below < 0) below = hash_size_ - 1;
            for (const Index slot : {above, below}) {
                const Index v = space_.hull_hash[slot];
                if (is_on_hull(v)) return v;
            }
            if (++above == hash_size_) above = 0;
        }
        return start_;
    }

    bool is_on_hull(Index v) const noexcept { return v != kNone && hull_[v].next != v; }

    // Long hulls, as of points on a circle, need more buckets.
    void rehash() {
        hash_size_ *= 4;
        space_.hull_hash.assign(hash_size_, kNone);
        Index v = start_;
        do {
            space_.hull_hash[bucket(v)] = v;
            v = hull_[v].next;
        } while (v != start_);
    }

    // Whether a point lies strictly on the outer side of the hull edge from e to q.
    bool sees(Point point, Index e, Index q) const noexcept {
        return orientation(points_[e], points_[q], point, bounds_) < 0;
    }

    void join_hull(Index v, Index w) noexcept {
        hull_[v].next = w;
        hull_[w].previous = v;
    }

    Index bucket(Index v) const noexcept {
        return std::min(static_cast<Index>(lifted_[v].angle * hash_size_), hash_size_ - 1);
    }

    Lifted from(Index v, Index w) const noexcept {
        const Lifted &a = lifted_[v], &b = lifted_[w];
        return {b.x - a.x, b.y - a.y, b.z - a.z, 0};
    }

    // The plane through a vertex and those at u and w from it, clockwise.
    static void set_plane(Triangle& triangle, const Lifted& u, const Lifted& w, const Lifted& base) noexcept {
        triangle.a = u.y * w.z - u.z * w.y;
        triangle.b = u.z * w.x - u.x * w.z;
        triangle.c = u.x * w.y - u.y * w.x;
        triangle.d = triangle.a * base.x + triangle.b * base.y + triangle.c * base.z;
    }

    // Whether a point lies strictly inside the circle of a triangle: on the paraboloid, below its plane.
    bool is_inside(Point point, const Lifted& p, const Triangle& triangle) const noexcept {
        const double height = (triangle.a * p.x + triangle.b * p.y) + (triangle.c * p.z - triangle.d);
        if (height > bounds_.plane) return true;
        if (-height > bounds_.plane || bounds_.plane == 0) return false;
        const auto& v = triangle.origin;
        return incircle(points_[v[0]], points_[v[1]], points_[v[2]], point, bounds_) > 0;
    }

    void join(Index h, Index twin) noexcept {
        triangles_[h >> 2].twin[h & 3] = twin;
        if (twin != kNone) {
            triangles_[twin >> 2].twin[twin & 3] = h;
        } else {
            hull_[triangles_[h >> 2].origin[h & 3]].edge = h;
        }
    }

    void store() {
        mesh_.origin.resize(3 * size_);
        mesh_.twin.resize(3 * size_);
        Index* origin = mesh_.origin.data();
        Index* twin = mesh_.twin.data();
        for (Index t = 0; t < size_; ++t) {
            for (Index k = 0; k < 3; ++k) {
                *origin++ = triangles_[t].origin[k];
                const Index h = triangles_[t].twin[k];
                *twin++ = h - (h >> 2) - (h < 0 ? 1 : 0);  // 4 t + k -> 3 t + k
            }
        }
    }

    Triangulation& mesh_;
    Workspace& space_;
    const Point* points_;
    const Bounds bounds_;
    Lifted* lifted_ = nullptr;
    Triangle* triangles_ = nullptr;
    HullVertex* hull_ = nullptr;
    Index count_, size_ = 0, hash_size_ = 0, hull_size_ = 0, start_ = 0;
    std::size_t removals_ = 0, budget_ = 0;
};

}  // namespace

bool sweep_hull(Triangulation& mesh, Workspace& workspace) { return SweepHull(mesh, workspace).run(); }

}  // namespace tensor_stereo
