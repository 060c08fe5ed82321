#include "tensor_stereo/dual_edge_ratio.hpp"

#include <algorithm>
#include <cmath>

#include "tensor_stereo/critical_points.hpp"
#include "tensor_stereo/parallel.hpp"

namespace tensor_stereo {
namespace {

inline Point point(const double* points, std::int64_t row) noexcept { return {points[2 * row], points[2 * row + 1]}; }

// The end of a dual edge towards its critical point; rounding may put that on the line, even on a vertex.
inline double clipped_end(Point i, Point j, Point k, double bound) noexcept {
    const double end = dual_end(i, j, k);
    return std::isnan(end) ? bound : std::min(std::max(end, -bound), bound);
}

inline void add(double* gradient, std::int64_t row, double x, double y) noexcept {
    gradient[2 * row] += x;
    gradient[2 * row + 1] += y;
}

template <class Visit>
void for_each_range(const DualEdges& edges, int num_threads, const Visit& visit) {
    parallel_for(edges.num_ranges, 1, num_threads, [&] {
        return [&](std::int64_t begin, std::int64_t end) {
            for (std::int64_t k = edges.ptr[begin]; k < edges.ptr[end]; ++k) visit(k);
        };
    });
}

}  // namespace

void dual_edge_ratio(const DualEdges& edges, int num_threads, double* ratio) {
    for_each_range(edges, num_threads, [&](std::int64_t e) {
        const std::int64_t right = edges.critical[2 * e], left = edges.critical[2 * e + 1];
        if (left == kBlocked) {
            ratio[e] = -2 * edges.bound;
            return;
        }
        const Point i = point(edges.points, edges.pairs[2 * e]), j = point(edges.points, edges.pairs[2 * e + 1]);
        const auto end = [&](std::int64_t k) {
            return k == kNone ? edges.bound : clipped_end(i, j, point(edges.points, k), edges.bound);
        };
        ratio[e] = end(right) + end(left);
    });
}

void dual_edge_ratio_backward(const DualEdges& edges, const double* ratio_gradient, int num_threads, double* gradient) {
    for_each_range(edges, num_threads, [&](std::int64_t e) {
        if (ratio_gradient[e] == 0) return;
        const std::int64_t row_i = edges.pairs[2 * e], row_j = edges.pairs[2 * e + 1];
        const Point i = point(edges.points, row_i), j = point(edges.points, row_j);
        const double dx = j.x - i.x, dy = j.y - i.y;
        for (int side = 0; side < 2; ++side) {
            const std::int64_t row_k = edges.critical[2 * e + side];
            if (row_k < 0) continue;
            const Point k = point(edges.points, row_k);
            const double x = k.x - i.x, y = k.y - i.y;
            const double cross = std::fabs(dx * y - dy * x), end = (x * (x - dx) + y * (y - dy)) / (2 * cross);
            if (!(std::fabs(end) < edges.bound)) continue;
            const double scale = ratio_gradient[e] / (2 * cross);
            const double turn = side == 0 ? -2 * end : 2 * end;  // the cross product is negative on the right
            const double k_x = scale * (2 * x - dx + turn * dy), k_y = scale * (2 * y - dy - turn * dx);
            const double j_x = -scale * (x + turn * y), j_y = -scale * (y - turn * x);
            add(gradient, row_k, k_x, k_y);
            add(gradient, row_j, j_x, j_y);
            add(gradient, row_i, -(k_x + j_x), -(k_y + j_y));
        }
    });
}

}  // namespace tensor_stereo
