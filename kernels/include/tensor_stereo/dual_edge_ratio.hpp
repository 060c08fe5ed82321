// Signed lengths of dual Voronoi edges and their gradient.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "tensor_stereo/critical_points.hpp"
#include "tensor_stereo/parallel.hpp"

namespace tensor_stereo {

// Pairs of rows, and what bounds their dual edges in one view, as soft_match_graphs gives them.
struct DualEdges {
    const double* points;          // (num_points, 2)
    const std::int64_t* pairs;     // (num_pairs, 2)
    const std::int64_t* critical;  // (num_pairs, 2)
    double bound;                  // each end is clipped to so many lengths of the pair from its midpoint

    Point point(std::int64_t row) const noexcept { return {points[2 * row], points[2 * row + 1]}; }
    Point first(std::int64_t pair) const noexcept { return point(pairs[2 * pair]); }
    Point second(std::int64_t pair) const noexcept { return point(pairs[2 * pair + 1]); }

    // Signed length in lengths of the pair; -2 bound where it is blocked.
    double ratio(std::int64_t pair) const noexcept {
        const std::int64_t right = critical[2 * pair], left = critical[2 * pair + 1];
        if (left == kBlocked || right == kBlocked) return -2 * bound;
        return end(pair, right) + end(pair, left);
    }

    // Adds scale times the gradient of ratio to gradient (num_points, 2), through the ends that are not clipped.
    void add_ratio_gradient(std::int64_t pair, double scale, double* gradient) const noexcept {
        const Point i = first(pair), j = second(pair);
        const double dx = j.x - i.x, dy = j.y - i.y;
        if (critical[2 * pair] == kBlocked || critical[2 * pair + 1] == kBlocked) return;
        for (int side = 0; side < 2; ++side) {
            const std::int64_t row = critical[2 * pair + side];
            if (row < 0) continue;
            const double x = points[2 * row] - i.x, y = points[2 * row + 1] - i.y;
            const double cross = std::fabs(dx * y - dy * x), end = (x * (x - dx) + y * (y - dy)) / (2 * cross);
            if (!(std::fabs(end) < bound)) continue;
            const double part = scale / (2 * cross);
            const double turn = side == 0 ? -2 * end : 2 * end;  // the cross product is negative on the right
            const double of_k_x = part * (2 * x - dx + turn * dy), of_k_y = part * (2 * y - dy - turn * dx);
            const double of_j_x = -part * (x + turn * y), of_j_y = -part * (y - turn * x);
            add(gradient, row, of_k_x, of_k_y);
            add(gradient, pairs[2 * pair + 1], of_j_x, of_j_y);
            add(gradient, pairs[2 * pair], -(of_k_x + of_j_x), -(of_k_y + of_j_y));
        }
    }

    static void add(double* gradient, std::int64_t row, double x, double y) noexcept {
        gradient[2 * row] += x;
        gradient[2 * row + 1] += y;
    }

   private:
    // The end towards a critical point; rounding may put that on the line, even on a vertex.
    double end(std::int64_t pair, std::int64_t row) const noexcept {
        if (row == kNone) return bound;
        const double value = dual_end(first(pair), second(pair), point(row));
        return std::isnan(value) ? bound : std::min(std::max(value, -bound), bound);
    }
};

// Ranges of pairs that share no point with each other.
struct PairRanges {
    const std::int64_t* ptr;  // (count + 1)
    std::int64_t count;

    // Calls visit(range, pair) for all pairs, those of one range in order and in one thread.
    template <class Visit>
    void each(int num_threads, const Visit& visit) const {
        parallel_for(count, 1, num_threads, [&] {
            return [&](std::int64_t begin, std::int64_t end) {
                for (std::int64_t range = begin; range < end; ++range) {
                    for (std::int64_t pair = ptr[range]; pair < ptr[range + 1]; ++pair) visit(range, pair);
                }
            };
        });
    }
};

}  // namespace tensor_stereo
