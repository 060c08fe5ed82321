// Signed lengths of dual Voronoi edges and their gradient.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "tensor_stereo/critical_points.hpp"
#include "tensor_stereo/index.hpp"
#include "tensor_stereo/parallel.hpp"
#include "tensor_stereo/predicates.hpp"

namespace tensor_stereo {

// Links, which are two rows each, and what bounds their dual edges in one view, as soft_match_graphs gives them.
struct DualEdges {
    const double* points;          // (num_points, 2)
    const std::int64_t* links;     // (num_links, 2)
    const std::int64_t* critical;  // (num_links, 2)
    double bound;                  // each end is clipped to so many lengths of the link from its midpoint

    Point point(std::int64_t row) const noexcept { return {points[2 * row], points[2 * row + 1]}; }
    Point first(std::int64_t link) const noexcept { return point(links[2 * link]); }
    Point second(std::int64_t link) const noexcept { return point(links[2 * link + 1]); }

    // Signed length in lengths of the link; -2 bound where it is blocked.
    double ratio(std::int64_t link) const noexcept {
        const std::int64_t right = critical[2 * link], left = critical[2 * link + 1];
        if (left == kBlocked || right == kBlocked) return -2 * bound;
        return end(link, right) + end(link, left);
    }

    // Adds scale times the gradient of ratio to gradient (num_points, 2), through the ends that are not clipped.
    void add_ratio_gradient(std::int64_t link, double scale, double* gradient) const noexcept {
        const Point i = first(link), j = second(link);
        const double dx = j.x - i.x, dy = j.y - i.y;
        if (critical[2 * link] == kBlocked || critical[2 * link + 1] == kBlocked) return;
        for (int side = 0; side < 2; ++side) {
            const std::int64_t row = critical[2 * link + side];
            if (row < 0) continue;
            const double x = points[2 * row] - i.x, y = points[2 * row + 1] - i.y;
            const double cross = std::fabs(dx * y - dy * x), end = (x * (x - dx) + y * (y - dy)) / (2 * cross);
            if (!(std::fabs(end) < bound)) continue;
            const double part = scale / (2 * cross);
            const double turn = side == 0 ? -2 * end : 2 * end;  // the cross product is negative on the right
            const double of_k_x = part * (2 * x - dx + turn * dy), of_k_y = part * (2 * y - dy - turn * dx);
            const double of_j_x = -part * (x + turn * y), of_j_y = -part * (y - turn * x);
            add(gradient, row, of_k_x, of_k_y);
            add(gradient, links[2 * link + 1], of_j_x, of_j_y);
            add(gradient, links[2 * link], -(of_k_x + of_j_x), -(of_k_y + of_j_y));
        }
    }

    static void add(double* gradient, std::int64_t row, double x, double y) noexcept {
        gradient[2 * row] += x;
        gradient[2 * row + 1] += y;
    }

   private:
    // The end towards a critical point; rounding may put that on the line, even on a vertex.
    double end(std::int64_t link, std::int64_t row) const noexcept {
        if (row == kNone) return bound;
        const double value = dual_end(first(link), second(link), point(row));
        return std::isnan(value) ? bound : std::min(std::max(value, -bound), bound);
    }
};

// Ranges of links that share no point with each other.
struct LinkRanges {
    const std::int64_t* ptr;  // (count + 1)
    std::int64_t count;

    // Calls visit(range, link) for all links, those of one range in order and in one thread.
    template <class Visit>
    void each(int num_threads, const Visit& visit) const {
        parallel_for(count, 1, num_threads, [&] {
            return [&](std::int64_t begin, std::int64_t end) {
                for (std::int64_t range = begin; range < end; ++range) {
                    for (std::int64_t link = ptr[range]; link < ptr[range + 1]; ++link) visit(range, link);
                }
            };
        });
    }
};

}  // namespace tensor_stereo
