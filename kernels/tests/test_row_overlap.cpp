#include <cstdint>

#include "expect.hpp"
#include "tensor_stereo/row_overlap.hpp"

namespace ts = tensor_stereo;

TEST(row_overlap_counts_shared_columns) {
    const std::int64_t crow0[] = {0, 3, 3, 4}, cols0[] = {0, 2, 5, 1}, crow1[] = {0, 2, 3, 4}, cols1[] = {2, 5, 0, 0};
    std::int64_t overlap[3], degree0[3], degree1[3];
    for (const int num_threads : {1, 4}) {
        ts::row_overlap(crow0, cols0, crow1, cols1, 3, num_threads, overlap, degree0, degree1);
        EXPECT(overlap[0] == 2 && overlap[1] == 0 && overlap[2] == 0);
        EXPECT(degree0[0] == 3 && degree0[1] == 0 && degree0[2] == 1);
        EXPECT(degree1[0] == 2 && degree1[1] == 1 && degree1[2] == 1);
    }
}
