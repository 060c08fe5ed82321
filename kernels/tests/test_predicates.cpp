#include <algorithm>
#include <cmath>
#include <random>

#include "expect.hpp"
#include "samples.hpp"
#include "tensor_stereo/predicates.hpp"
#include "tensor_stereo/triangulation.hpp"

namespace ts = tensor_stereo;

TEST(predicates_are_exact) {
    const ts::Point o{0, 0}, p{1, 1};
    EXPECT(ts::exact_orientation(o, p, {3, 3}) == 0);
    EXPECT(ts::exact_orientation(o, p, {3, std::nextafter(3.0, 4.0)}) == 1);
    EXPECT(ts::exact_orientation(o, p, {3, std::nextafter(3.0, 2.0)}) == -1);
    // Corners of a rectangle share their coordinates, so they are co-circular in any rounding.
    const double tenth = 0.1;
    EXPECT(ts::exact_incircle({0, 0}, {3 * tenth, 0}, {3 * tenth, 7 * tenth}, {0, 7 * tenth}) == 0);
    EXPECT(ts::exact_incircle({0, 0}, {1, 0}, {1, 1}, {0, std::nextafter(1.0, 0.0)}) == 1);
    EXPECT(ts::exact_incircle({0, 0}, {1, 0}, {1, 1}, {0, std::nextafter(1.0, 2.0)}) == -1);
    EXPECT(ts::exact_incircle({0, 0}, {1e-60, 0}, {1e-60, 1e-60}, {0, 1e-60}) == 0);
    EXPECT(ts::exact_incircle({0, 0}, {1e60, 0}, {1e60, 1e60}, {1e-60, 1e60}) == 1);
}

TEST(bounds_agree_with_exact_signs) {
    Rng rng(1);
    for (const int range : {2, 30, 4000}) {
        for (const double scale : {1.0, 0.1, 1e-3}) {
            auto points = random_integers(rng, 200, range);
            for (auto& p : points) p = {p.x * scale, p.y * scale};
            double side = 0;
            for (const auto& p : points) {
                for (const auto& q : points) side = std::max({side, p.x - q.x, p.y - q.y});
            }
            const auto bounds = ts::determinant_bounds(points.data(), points.size(), side);
            std::uniform_int_distribution<std::size_t> any(0, points.size() - 1);
            for (int k = 0; k < 2000; ++k) {
                const auto a = points[any(rng)], b = points[any(rng)], c = points[any(rng)], d = points[any(rng)];
                EXPECT(ts::orientation(a, b, c, bounds) == ts::exact_orientation(a, b, c));
                EXPECT(ts::incircle(a, b, c, d, bounds) == ts::exact_incircle(a, b, c, d));
            }
        }
    }
}
