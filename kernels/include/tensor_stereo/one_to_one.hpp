// Which matches of each pair form a bijection of distinct points.
#pragma once

#include <cstdint>

namespace tensor_stereo {

// points0, points1: (ptr[num_pairs], 2) partners, compared by value, so that -0 is 0. cost: one per match, no NaN, or
// null. Matches are taken in the order (cost, row); kept[row] is 1 iff neither point was taken by a kept one.
// Throws std::bad_alloc.
void one_to_one(const double* points0, const double* points1, const std::int64_t* ptr, std::int64_t num_pairs,
                const double* cost, int num_threads, bool* kept);

}  // namespace tensor_stereo
