#include <cmath>
#include <cstdint>

#include "expect.hpp"
#include "tensor_stereo/gated_ssd.hpp"

namespace ts = tensor_stereo;

TEST(gated_ssd_takes_the_lowest_index_of_equals) {
    const double keypoints0[] = {10, 5, 10, 9}, keypoints1[] = {8, 5, 9, 5, 9, 6.5, 3, 5};
    const float descriptors0[] = {1, 2, 7, 7}, descriptors1[] = {1, 3, 2, 2, 1, 2, 1, 2};
    const std::int64_t ptr0[] = {0, 2}, ptr1[] = {0, 4};
    float cost[2], second[2], cost1[4];
    std::int64_t index[2], index1[4];
    ts::gated_ssd({keypoints0, descriptors0, ptr0}, {keypoints1, descriptors1, ptr1}, 1, 2, {1, 0, 5}, 1,
                  {cost, index, second, cost1, index1});
    EXPECT(cost[0] == 1 && index[0] == 0 && second[0] == 1);
    EXPECT(std::isinf(cost[1]) && index[1] == -1);
    EXPECT(index1[0] == 0 && index1[1] == 0 && index1[2] == -1 && index1[3] == -1);
}
