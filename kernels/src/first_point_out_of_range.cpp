#include "tensor_stereo/first_point_out_of_range.hpp"

#include <algorithm>
#include <cmath>

namespace tensor_stereo {

std::int64_t first_point_out_of_range(const double* points, std::int64_t num_points) noexcept {
    const auto is_bad = [](double value) {
        const double magnitude = std::fabs(value);
        return !(magnitude == 0 || (magnitude >= 1e-60 && magnitude <= 1e60));
    };
    constexpr std::int64_t kBlock = 1024;
    for (std::int64_t begin = 0; begin < 2 * num_points; begin += kBlock) {
        const std::int64_t end = std::min(begin + kBlock, 2 * num_points);
        bool any = false;
        for (std::int64_t k = begin; k < end; ++k) any |= is_bad(points[k]);
        if (!any) continue;
        for (std::int64_t k = begin; k < end; ++k) {
            if (is_bad(points[k])) return k / 2;
        }
    }
    return -1;
}

}  // namespace tensor_stereo
