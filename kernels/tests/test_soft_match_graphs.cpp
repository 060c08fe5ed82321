#include <algorithm>
#include <cstddef>
#include <cstdint>

#include "expect.hpp"
#include "soft_sample.hpp"
#include "tensor_stereo/soft_match_graphs.hpp"

namespace ts = tensor_stereo;

TEST(critical_points_leave_their_side_of_the_circle_empty) {
    Rng rng(4);
    for (const int range : {2, 5, 300}) {
        const SoftSample sample(rng, 30, range);
        const auto found = sample.build({1e9, 0}, 1);
        for (int v = 0; v < 2; ++v) {
            const double* const values = sample.points[v].data();
            const auto point = [values](std::int64_t row) { return ts::Point{values[2 * row], values[2 * row + 1]}; };
            for (std::size_t s = 0; s + 1 < sample.ptr.size(); ++s) {
                for (std::int64_t e = found.link_ptr[s]; e < found.link_ptr[s + 1]; ++e) {
                    const std::int64_t i = found.links[2 * e], j = found.links[2 * e + 1];
                    for (int side = 0; side < 2; ++side) {
                        const std::int64_t best = found.view[v].critical[2 * e + side];
                        if (best == ts::kBlocked) continue;
                        const auto a = side == 1 ? i : j, b = side == 1 ? j : i;  // the side on the left of a -> b
                        for (std::int64_t k = sample.ptr[s]; k < sample.ptr[s + 1]; ++k) {
                            if (k == i || k == j || ts::exact_orientation(point(a), point(b), point(k)) <= 0) continue;
                            EXPECT(best != ts::kNone);
                            EXPECT(ts::exact_incircle(point(a), point(b), point(best), point(k)) <= 0);
                        }
                    }
                }
            }
        }
    }
}

TEST(soft_match_graphs_do_not_depend_on_threads) {
    Rng rng(5);
    const SoftSample sample(rng, 40, 6);
    const auto one = sample.build({4, 0}, 1), many = sample.build({4, 0}, 4);
    EXPECT(one.num_links == many.num_links);
    EXPECT(std::equal(one.links.get(), one.links.get() + 2 * one.num_links, many.links.get()));
    for (int v = 0; v < 2; ++v) {
        const auto* const critical = one.view[v].critical.get();
        EXPECT(std::equal(critical, critical + 2 * one.num_links, many.view[v].critical.get()));
    }
}
