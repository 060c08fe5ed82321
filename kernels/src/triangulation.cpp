#include "tensor_stereo/triangulation.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>

#include "divide_and_conquer.hpp"
#include "sweep_hull.hpp"

namespace tensor_stereo {
namespace {

// Positive floats order as their bits do.
inline std::uint32_t order_bits(double value) noexcept {
    return std::bit_cast<std::uint32_t>(static_cast<float>(value));
}

// Sorts by the squared distance from the centre of the bounding box: each point lies outside the hull of those before
// it, but for rounding. Radix passes order by the distance as a float, insertion repairs what that rounds together.
void sort_radially(const double* points, const std::int64_t* index, std::size_t count, Triangulation& result,
                   Workspace& workspace) {
    double min_x = std::numeric_limits<double>::infinity(), min_y = min_x, max_x = -min_x, max_y = -min_x;
    for (std::size_t k = 0; k < count; ++k) {
        const double x = points[2 * index[k]], y = points[2 * index[k] + 1];
        min_x = std::min(min_x, x);
        max_x = std::max(max_x, x);
        min_y = std::min(min_y, y);
        max_y = std::max(max_y, y);
    }
    const Point centre{min_x + (max_x - min_x) / 2, min_y + (max_y - min_y) / 2};
    result.box = {{min_x, min_y}, centre, std::max(max_x - min_x, max_y - min_y)};
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
            for (; hole > 0 && order[hole - 1].distance > item.distance; --hole) {
                order[hole] = order[hole - 1];
                ++shifts;
            }
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

}  // namespace

Bounds determinant_bounds(const Point* points, std::size_t count, double side) noexcept {
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
    sort_radially(points, index, count, result, workspace);
    result.is_collinear = count < 3;
    if (result.is_collinear) {
        result.origin.clear();
        result.twin.clear();
        return;
    }
    result.bounds = determinant_bounds(result.points.data(), count, result.box.side);
    if (!sweep_hull(result, workspace)) divide_and_conquer(result);
}

}  // namespace tensor_stereo
