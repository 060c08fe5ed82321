#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "expect.hpp"
#include "soft_sample.hpp"
#include "tensor_stereo/dual_edge_ratio.hpp"

namespace ts = tensor_stereo;

TEST(ratio_is_the_dual_length_in_lengths_of_the_link) {
    const double points[] = {0, 0, 2, 0, 1, 2, 1, -2};
    const std::int64_t links[] = {0, 1, 0, 1, 0, 1, 0, 1}, critical[] = {3, 2, -1, 2, -1, -1, -2, -2};
    const ts::DualEdges edges{points, links, critical, 1e3};
    EXPECT(edges.ratio(0) == 0.75);  // both centres lie 3/4 px from the midpoint, and the link is 2 px long
    EXPECT(edges.ratio(1) == 1e3 + 0.375);
    EXPECT(edges.ratio(2) == 2e3);
    EXPECT(edges.ratio(3) == -2e3);
}

TEST(gradient_of_ratio_is_that_of_finite_differences) {
    Rng rng(11);
    SoftSample sample(rng, 3, 1000);
    const auto found = sample.build({16, 0}, 1);
    for (int v = 0; v < 2; ++v) {
        std::vector<double>& points = sample.points[v];
        const ts::DualEdges edges{points.data(), found.links.get(), found.view[v].critical.get(), 1e3};
        for (std::int64_t link = 0; link < found.num_links; link += 5) {
            std::vector<double> gradient(points.size(), 0.0);
            edges.add_ratio_gradient(link, 2, gradient.data());
            const double size = std::fabs(edges.ratio(link));
            for (std::size_t k = 0; k < points.size(); ++k) {
                const double before = points[k], step = 1e-4;
                points[k] = before + step;
                const double above = edges.ratio(link);
                points[k] = before - step;
                const double below = edges.ratio(link);
                points[k] = before;
                EXPECT(std::fabs((above - below) / step - gradient[k]) < 1e-5 * (1 + size * size));
            }
        }
    }
}
