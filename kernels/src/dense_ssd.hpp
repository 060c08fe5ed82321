// Nearest neighbours by sum of squared differences among all keypoints of the partner image.
#pragma once

#include "tensor_stereo/nearest_ssd.hpp"

namespace tensor_stereo {

// The sum whose bits count, see nearest_ssd.
float ssd_of(const float* a, const float* b, std::int64_t size, Vectors vectors);

// `result` starts without candidates.
void dense_ssd(const FeatureView& view0, const FeatureView& view1, std::int64_t num_images, std::int64_t size,
               int num_threads, Vectors vectors, const Neighbors& result);

}  // namespace tensor_stereo
