#include <cstdint>

#include "expect.hpp"
#include "tensor_stereo/one_to_one.hpp"

namespace ts = tensor_stereo;

TEST(one_to_one_is_greedy_by_cost) {
    const double left[] = {0, 0, 0, -0.0, 5, 1}, right[] = {0, 0, 1, 3, 5, 1}, cost[] = {2, 1, 1};
    const std::int64_t ptr[] = {0, 3};
    bool kept[3];
    ts::one_to_one(left, right, ptr, 1, nullptr, 1, kept);
    EXPECT(kept[0] && !kept[1] && kept[2]);
    ts::one_to_one(left, right, ptr, 1, cost, 2, kept);
    EXPECT(!kept[0] && kept[1] && kept[2]);
}
