// Which matches of each pair form a bijection of distinct points.
#pragma once

#include <cstdint>

namespace tensor_stereo {

// First row of (num_points, 2) whose coordinates are not all 0 or 1e-60..1e60 in magnitude; -1 if there is none.
std::int64_t first_point_out_of_range(const double* points, std::int64_t num_points) noexcept;

// points0, points1: (ptr[num_pairs], 2) partners, compared by value, so that -0 is 0. cost: one per match, no NaN, or
// null. Matches are taken in the order (cost, row); kept[row] is 1 iff neither point was taken by a kept one.
// Throws std::bad_alloc.
void one_to_one(const double* points0, const double* points1, const std::int64_t* ptr, std::int64_t num_pairs,
                const double* cost, int num_threads, bool* kept);

}  // namespace tensor_stereo
