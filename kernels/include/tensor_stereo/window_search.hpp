// Where the window of a keypoint fits best along its row or line, near some predictions.
#pragma once

#include <cstdint>

#include "tensor_stereo/gray_image.hpp"
#include "tensor_stereo/vectors.hpp"

namespace tensor_stereo {

// The views of a pair, and the whole disparities that its keypoints are searched at.
struct SearchPair {
    GrayImage view[2];
    std::int64_t first = 0, count = 0;
    bool is_rectified = true;
};

// T keypoints of view 0 of B pairs, pair by pair.
struct SearchKeypoints {
    const std::int64_t* ptr;  // (B + 1)
    const float* points;      // (T, 2) px
    const float* along;       // (T, 2) unit vectors along the epipolar lines
    const float* across;      // (T) px, where the line of the keypoint lies in view 1, across it
    const float* predicted;   // (T, num_predictions) px of disparity
    std::int64_t num_predictions;
};

// Disparity (T) in px, to a fraction, of the least mean of the log SSDs of pixels like the middle and near it, among
// the whole ones at most near_px from a prediction; of equal ones the least. found (T): whether such a place lies in
// view 1. Throws std::bad_alloc.
void window_search(const SearchPair* pairs, std::int64_t num_pairs, const SearchKeypoints& keypoints, float near_px,
                   int num_threads, float* disparity, bool* found, Vectors vectors = Vectors::kBest);

}  // namespace tensor_stereo
