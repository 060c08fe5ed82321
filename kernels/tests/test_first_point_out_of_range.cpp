#include <cmath>
#include <limits>
#include <vector>

#include "expect.hpp"
#include "tensor_stereo/first_point_out_of_range.hpp"

namespace ts = tensor_stereo;

TEST(first_bad_row_is_found) {
    const double good[] = {0, 0, 0, -0.0, 5, 1}, bad[] = {0, 1, 2, std::nan(""), 1e61, 0};
    EXPECT(ts::first_point_out_of_range(bad, 3) == 1);
    EXPECT(ts::first_point_out_of_range(good, 3) == -1);
    EXPECT(ts::first_point_out_of_range(good, 0) == -1);
}

TEST(a_bad_value_is_found_wherever_it_stands) {
    std::vector<double> points(2 * 3000, 1.0);  // several blocks
    for (const double value : {std::nan(""), std::numeric_limits<double>::infinity(), -1e61, 1e-61}) {
        for (const int place : {0, 1, 1023, 1024, 4096, 5999}) {
            points[place] = value;
            EXPECT(ts::first_point_out_of_range(points.data(), 3000) == place / 2);
            points[place] = 1e60;
        }
    }
}
