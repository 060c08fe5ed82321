#include <algorithm>
#include <cstdint>
#include <limits>

#include "expect.hpp"
#include "soft_sample.hpp"
#include "tensor_stereo/dual_critical_points.hpp"

namespace ts = tensor_stereo;

TEST(dual_critical_points_are_those_of_soft_match_graphs) {
    Rng rng(10);
    for (const int range : {2, 5, 300}) {
        const SoftSample sample(rng, 30, range);
        const auto found = sample.build({std::numeric_limits<double>::infinity(), 0}, 1);
        const auto num_segments = static_cast<std::int64_t>(sample.ptr.size()) - 1;
        for (int v = 0; v < 2; ++v) {
            for (const int num_threads : {1, 3}) {
                const auto critical =
                    ts::dual_critical_points(sample.points[v].data(), sample.index.data(), sample.ptr.data(),
                                             num_segments, found.links.get(), found.link_ptr.get(), num_threads);
                EXPECT(std::equal(critical.get(), critical.get() + 2 * found.num_links, found.view[v].critical.get()));
            }
        }
    }
}

TEST(a_point_between_blocks_a_link) {
    const double points[] = {0, 0, 1, 0, 2, 0, 1, 5};
    const std::int64_t index[] = {0, 1, 2, 3}, ptr[] = {0, 4}, links[] = {0, 1, 2, 0, 1, 3}, link_ptr[] = {0, 3};
    const auto critical = ts::dual_critical_points(points, index, ptr, 1, links, link_ptr, 1);
    EXPECT(critical[0] == -1 && critical[1] == 3);
    EXPECT(critical[2] == -2 && critical[3] == -2);
    EXPECT(critical[4] == 2 && critical[5] == 0);
}
