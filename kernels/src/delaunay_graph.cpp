#include "tensor_stereo/delaunay_graph.hpp"

#include "segment_graph.hpp"
#include "tensor_stereo/parallel.hpp"

namespace tensor_stereo {

SparsePattern delaunay_graph(const double* points, std::int64_t num_points, const std::int64_t* index,
                             const std::int64_t* ptr, std::int64_t num_segments, double tie_tolerance,
                             int num_threads) {
    const SegmentRows rows(ptr[num_segments]);
    parallel_for(num_segments, 1, num_threads, [&] {
        return [&, graph = SegmentGraph(points, tie_tolerance)](std::int64_t begin, std::int64_t end) mutable {
            for (std::int64_t s = begin; s < end; ++s) {
                const auto count = static_cast<std::size_t>(ptr[s + 1] - ptr[s]);
                graph.build(index + ptr[s], count, rows.degree.get() + ptr[s], rows.neighbors.get() + 6 * ptr[s]);
            }
        };
    });
    return assemble(rows, num_points, index, ptr, num_segments, num_threads);
}

}  // namespace tensor_stereo
