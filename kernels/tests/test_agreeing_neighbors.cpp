#include <cstdint>

#include "expect.hpp"
#include "tensor_stereo/agreeing_neighbors.hpp"

namespace ts = tensor_stereo;

TEST(agreeing_neighbors_are_counted_in_each_view) {
    // Disparities 5, 7, 5 and row offsets 0, 1, 1.5; x0 = 0, 10, 20.
    const double points0[] = {0, 0, 10, 0, 20, 0}, points1[] = {-5, 0, 3, 1, 15, 1.5};
    const std::int64_t crow0[] = {0, 2, 3, 4}, cols0[] = {1, 2, 0, 0}, crow1[] = {0, 1, 3, 4}, cols1[] = {1, 0, 2, 1};
    std::int64_t count[3];
    for (const int num_threads : {1, 4}) {
        ts::agreeing_neighbors(points0, points1, crow0, cols0, crow1, cols1, 3, 1.0, 2.0, 0.0, 0.0, num_threads, count);
        EXPECT(count[0] == 2 && count[1] == 3 && count[2] == 1);  // both differences are just allowed
        ts::agreeing_neighbors(points0, points1, crow0, cols0, crow1, cols1, 3, 1.0, 1.0, 0.05, 0.0, num_threads,
                               count);
        EXPECT(count[0] == 0 && count[1] == 0 && count[2] == 0);  // 2 px are beyond 1 + .05 * 10
        ts::agreeing_neighbors(points0, points1, crow0, cols0, crow1, cols1, 3, 0.5, 1.5, 0.0, 0.05, num_threads,
                               count);
        EXPECT(count[0] == 3 && count[1] == 3 && count[2] == 2);  // 1.5 px of rows at 20 px are just allowed too
    }
}
