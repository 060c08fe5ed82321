// Nearest neighbours by sum of squared differences among the keypoints inside a gate, or among all.
#pragma once

#include <cstdint>

#include "tensor_stereo/vectors.hpp"

namespace tensor_stereo {

// Keypoints (x, y) and float32 descriptors of the images of one view.
struct FeatureView {
    const double* keypoints;   // (N, 2)
    const float* descriptors;  // (N, size)
    const std::int64_t* ptr;   // (B + 1) offsets of the images
};

// |y0 - y1| <= row_offset and min_disparity <= x0 - x1 <= max_disparity, bounds included; infinite ones are open.
// Tested as y1 against y0 +- row_offset and x1 against x0 - max_disparity, x0 - min_disparity.
struct Gate {
    double row_offset, min_disparity, max_disparity;
};

// What each keypoint found. Ties go to the lowest index. Without a candidate the index is -1 and the cost infinite.
struct Neighbors {
    float* cost;           // (N0)
    std::int64_t* index;   // (N0) global row in view 1
    float* second_cost;    // (N0) of the second-best candidate
    float* cost1;          // (N1) the same seen from view 1
    std::int64_t* index1;  // (N1)
};

// Candidates are the keypoints inside the gate; all of them, and no keypoint is looked at, if none of it is closed.
// The sum runs in 16 interleaved lanes, each in order, which are then added in halves: the same bits as the reference.
// Throws std::bad_alloc.
void nearest_ssd(const FeatureView& view0, const FeatureView& view1, std::int64_t num_images, std::int64_t size,
                 const Gate& gate, int num_threads, Vectors vectors, const Neighbors& result);

}  // namespace tensor_stereo
