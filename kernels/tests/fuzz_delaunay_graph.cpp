// libFuzzer target: for any bytes the graph is symmetric and shrinks with the tolerance, divide and conquer makes as
// many triangles as the sweep, and small integers give the graph of the circle definition.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "divide_and_conquer.hpp"
#include "sweep_hull.hpp"
#include "tensor_stereo/delaunay_graph.hpp"
#include "tensor_stereo/first_point_out_of_range.hpp"
#include "tensor_stereo/one_to_one.hpp"
#include "tensor_stereo/triangulation.hpp"

namespace ts = tensor_stereo;

namespace {

// Whether a circle through points i and j has every other point strictly outside, in exact integers (|x|, |y| <= 16).
bool is_edge(const std::vector<double>& values, const std::vector<std::int64_t>& index, std::int64_t i,
             std::int64_t j) {
    // Doubled, so that midpoints are integers.
    const auto x = [&](std::int64_t k) { return 2 * static_cast<std::int64_t>(values[2 * k]); };
    const auto y = [&](std::int64_t k) { return 2 * static_cast<std::int64_t>(values[2 * k + 1]); };
    const std::int64_t mx = (x(i) + x(j)) / 2, my = (y(i) + y(j)) / 2, nx = y(i) - y(j), ny = x(j) - x(i);
    const std::int64_t radius = (x(i) - mx) * (x(i) - mx) + (y(i) - my) * (y(i) - my);
    // Centre m + t n: a t + b > 0 for points outside; low < t < high with bounds as fractions of positive denominator.
    bool has_low = false, has_high = false;
    std::int64_t low = 0, low_by = 1, high = 0, high_by = 1;
    for (const std::int64_t k : index) {
        if (k == i || k == j) continue;
        const std::int64_t a = 2 * (nx * (mx - x(k)) + ny * (my - y(k)));
        const std::int64_t b = (mx - x(k)) * (mx - x(k)) + (my - y(k)) * (my - y(k)) - radius;
        if (a == 0 && b <= 0) return false;
        if (a > 0 && (!has_low || -b * low_by > low * a)) {
            has_low = true;
            low = -b;
            low_by = a;
        }
        if (a < 0 && (!has_high || b * high_by < high * -a)) {
            has_high = true;
            high = b;
            high_by = -a;
        }
    }
    return !has_low || !has_high || low * high_by < high * low_by;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    if (size < 17) return 0;
    // The first byte chooses how bytes become coordinates: raw doubles, or small integers times a step.
    const std::uint8_t mode = data[0];
    std::vector<double> values;
    if (mode % 4 == 0) {
        values.resize((size - 1) / 8);
        std::memcpy(values.data(), data + 1, values.size() * 8);
    } else {
        const double step = mode % 4 == 1 ? 1.0 : mode % 4 == 2 ? 0.1 : 1 / 3.0;
        for (std::size_t k = 1; k < size; ++k) values.push_back(static_cast<double>(data[k] % 16) * step);
    }
    values.resize(values.size() / 2 * 2);
    const auto count = static_cast<std::int64_t>(values.size() / 2);
    if (count == 0 || ts::first_point_out_of_range(values.data(), count) >= 0) return 0;
    const std::int64_t ptr[] = {0, count};
    std::vector<std::int64_t> index;
    const auto kept = ts::allocate<bool>(count);
    ts::one_to_one(values.data(), values.data(), ptr, 1, nullptr, 1, kept.get());
    for (std::int64_t k = 0; k < count; ++k) {
        if (kept[k]) index.push_back(k);
    }
    const std::int64_t segment[] = {0, static_cast<std::int64_t>(index.size())};
    std::int64_t entries[2];
    for (const double tie_tolerance : {0.0, 1e-3}) {
        const auto graph = ts::delaunay_graph(values.data(), count, index.data(), segment, 1, tie_tolerance, 1);
        entries[tie_tolerance > 0] = graph.crow[count];
        for (std::int64_t row = 0; row < count; ++row) {
            for (std::int64_t k = graph.crow[row]; k < graph.crow[row + 1]; ++k) {
                const std::int64_t* begin = graph.cols.get() + graph.crow[graph.cols[k]];
                const std::int64_t* end = graph.cols.get() + graph.crow[graph.cols[k] + 1];
                if (!std::binary_search(begin, end, row)) std::abort();  // not symmetric
            }
        }
        if (mode % 4 != 1 || tie_tolerance != 0 || index.size() > 24) continue;
        for (const std::int64_t i : index) {
            for (const std::int64_t j : index) {
                const std::int64_t* begin = graph.cols.get() + graph.crow[i];
                const std::int64_t* end = graph.cols.get() + graph.crow[i + 1];
                if (i != j && std::binary_search(begin, end, j) != is_edge(values, index, i, j)) std::abort();
            }
        }
    }
    if (entries[1] > entries[0]) std::abort();
    ts::Triangulation mesh;
    ts::Workspace workspace;
    ts::triangulate(values.data(), index.data(), index.size(), mesh, workspace);
    if (index.size() < 3) return 0;
    ts::Triangulation divided = mesh;
    ts::divide_and_conquer(divided);
    if (divided.origin.size() != mesh.origin.size()) std::abort();
    return 0;
}
