#include "tensor_stereo/dual_critical_points.hpp"

#include <algorithm>
#include <limits>
#include <vector>

#include "segment_graph.hpp"
#include "tensor_stereo/critical_points.hpp"
#include "tensor_stereo/index.hpp"
#include "tensor_stereo/parallel.hpp"

namespace tensor_stereo {

Buffer<std::int64_t> dual_critical_points(const double* points, const std::int64_t* index, const std::int64_t* ptr,
                                          std::int64_t num_segments, const std::int64_t* links,
                                          const std::int64_t* link_ptr, int num_threads) {
    constexpr double kInfinity = std::numeric_limits<double>::infinity();
    auto result = allocate<std::int64_t>(2 * link_ptr[num_segments]);
    parallel_for(num_segments, 1, num_threads, [&] {
        return [&, graph = SegmentGraph(points, 0), critical = CriticalPoints({kInfinity, 0}),
                degree = std::vector<Index>(),
                neighbors = std::vector<Index>()](std::int64_t begin, std::int64_t end) mutable {
            for (std::int64_t s = begin; s < end; ++s) {
                if (link_ptr[s] == link_ptr[s + 1]) continue;
                const std::int64_t* const members = index + ptr[s];
                const auto count = static_cast<std::size_t>(ptr[s + 1] - ptr[s]);
                degree.resize(count);
                neighbors.resize(6 * count);
                graph.build(members, count, degree.data(), neighbors.data());
                critical.prepare(graph.mesh(), graph.edges());
                const auto number = [&](std::int64_t row) {
                    return static_cast<Index>(std::lower_bound(members, members + count, row) - members);
                };
                for (std::int64_t k = link_ptr[s]; k < link_ptr[s + 1]; ++k) {
                    const Critical found = critical.find(number(links[2 * k]), number(links[2 * k + 1]));
                    result[2 * k] = to_row(members, found.right);
                    result[2 * k + 1] = to_row(members, found.left);
                }
            }
        };
    });
    return result;
}

}  // namespace tensor_stereo
