// libFuzzer target: the sweep and divide and conquer must find the same graph for any bytes, with and without tolerance.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "tensor_stereo/delaunay_graph.hpp"
#include "tensor_stereo/one_to_one.hpp"
#include "tensor_stereo/triangulation.hpp"

namespace ts = tensor_stereo;

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    if (size < 1) return 0;
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
