// Which point the exact predicates could not handle.
#pragma once

#include <cstdint>

namespace tensor_stereo {

// First row of (num_points, 2) whose coordinates are not all 0 or 1e-60..1e60 in magnitude; -1 if there is none.
std::int64_t first_point_out_of_range(const double* points, std::int64_t num_points) noexcept;

}  // namespace tensor_stereo
