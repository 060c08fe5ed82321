// How many neighbours move as a match does.
#pragma once

#include <cstdint>

namespace tensor_stereo {

// points*: (num_rows, 2) px. crow*, cols*: neighbours in either view. Two matches agree if their row offsets differ by
// at most row_px and their disparities by at most disparity_px + slope |dx0|. Writes (num_rows) counts over both views.
void agreeing_neighbors(const double* points0, const double* points1, const std::int64_t* crow0,
                        const std::int64_t* cols0, const std::int64_t* crow1, const std::int64_t* cols1,
                        std::int64_t num_rows, double row_px, double disparity_px, double slope, double spread,
                        int num_threads, std::int64_t* count);

}  // namespace tensor_stereo
