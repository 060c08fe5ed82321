#include <cstdint>

#include "expect.hpp"
#include "tensor_stereo/relate.hpp"

namespace ts = tensor_stereo;

TEST(relate_needs_evidence) {
    const std::int64_t overlap[] = {2, 0, 0, 0}, degree0[] = {3, 0, 1, 0}, degree1[] = {2, 1, 1, 0};
    const std::int64_t group_size[] = {3, 3, 0, 1};
    std::int8_t relation[4];
    bool inlier[4];
    ts::relate(overlap, degree0, degree1, group_size, 4, 1, true, relation, inlier);
    EXPECT(relation[0] == ts::kSuperset && relation[1] == ts::kUntested && relation[2] == ts::kUntested);
    EXPECT(relation[3] == ts::kEqual);  // alone in its group, as the paper reads literally
    EXPECT(inlier[0] && !inlier[1] && !inlier[2] && inlier[3]);
    ts::relate(overlap, degree0, degree1, group_size, 4, 4, true, relation, inlier);
    for (int k = 0; k < 4; ++k) EXPECT(relation[k] == ts::kUntested && !inlier[k]);
}

TEST(subsets_are_inliers_on_request) {
    const std::int64_t overlap[] = {2, 2, 2, 1}, degree0[] = {2, 2, 3, 2}, degree1[] = {2, 3, 2, 2};
    const std::int64_t group_size[] = {5, 5, 5, 5};
    const std::int8_t expected[] = {ts::kEqual, ts::kSubset, ts::kSuperset, ts::kConflict};
    std::int8_t relation[4];
    bool inlier[4];
    for (const bool accept_subsets : {false, true}) {
        ts::relate(overlap, degree0, degree1, group_size, 4, 4, accept_subsets, relation, inlier);
        for (int k = 0; k < 4; ++k) EXPECT(relation[k] == expected[k]);
        EXPECT(inlier[0] && inlier[1] == accept_subsets && inlier[2] == accept_subsets && !inlier[3]);
    }
}
