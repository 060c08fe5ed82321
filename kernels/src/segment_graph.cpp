#include "segment_graph.hpp"

#include <algorithm>

#include "tensor_stereo/parallel.hpp"

namespace tensor_stereo {

SparsePattern assemble(const SegmentRows& rows, std::int64_t num_points, const std::int64_t* index,
                       const std::int64_t* ptr, std::int64_t num_segments, int num_threads) {
    SparsePattern result;
    result.num_rows = num_points;
    result.crow = allocate<std::int64_t>(num_points + 1);
    std::fill_n(result.crow.get(), num_points + 1, 0);
    for (std::int64_t v = 0; v < ptr[num_segments]; ++v) result.crow[index[v] + 1] = rows.degree[v];
    for (std::int64_t row = 0; row < num_points; ++row) result.crow[row + 1] += result.crow[row];
    result.cols = allocate<std::int64_t>(result.crow[num_points]);
    parallel_for(num_segments, 1, num_threads, [&] {
        return [&](std::int64_t begin, std::int64_t end) {
            for (std::int64_t s = begin; s < end; ++s) {
                const std::int64_t* members = index + ptr[s];
                const Index* source = rows.neighbors.get() + 6 * ptr[s];
                for (std::int64_t v = ptr[s]; v < ptr[s + 1]; ++v) {
                    std::int64_t* target = result.cols.get() + result.crow[index[v]];
                    for (Index k = 0; k < rows.degree[v]; ++k) target[k] = members[*source++];
                }
            }
        };
    });
    return result;
}

}  // namespace tensor_stereo
