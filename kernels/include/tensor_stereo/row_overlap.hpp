// How many columns the rows of two sparse patterns share.
#pragma once

#include <cstdint>

namespace tensor_stereo {

// crow*: (num_rows + 1) offsets, cols*: ascending columns of each row. Writes overlap and both degrees (num_rows).
void row_overlap(const std::int64_t* crow0, const std::int64_t* cols0, const std::int64_t* crow1,
                 const std::int64_t* cols1, std::int64_t num_rows, int num_threads, std::int64_t* overlap,
                 std::int64_t* degree0, std::int64_t* degree1);

}  // namespace tensor_stereo
