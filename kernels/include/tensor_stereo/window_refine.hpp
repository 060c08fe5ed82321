// Moves matches to where the windows of both views fit best, to a fraction of a pixel.
#pragma once

#include <cstdint>

#include "tensor_stereo/gray_image.hpp"
#include "tensor_stereo/vectors.hpp"

namespace tensor_stereo {

// The views of a pair, low-pass filtered.
struct RefinePair {
    GrayImage view[2];
    bool is_rectified = true;
};

// M matches of B pairs, pair by pair.
struct RefineMatches {
    const std::int64_t* ptr;  // (B + 1)
    const float* left;        // (M, 2) px
    const float* right;       // (M, 2) px
    const float* along;       // (M, 2) unit vectors along the epipolar lines
    const float* off_line;    // (M) px, how far the partner lies from its line, across it
    const float* slope;       // (M, 2) px/px of the disparity, along and across the line
};

// (M) px along and across the lines, and the variance of the first in squared px.
struct Refined {
    float* along;
    float* across;
    float* variance;
};

// Gauss-Newton steps along the lines minimise the zero-mean weighted SSD of windows half-way along the slope in either
// view; nothing moves farther than max_shift px, or to where it fits worse. Throws std::bad_alloc.
void window_refine(const RefinePair* pairs, std::int64_t num_pairs, const RefineMatches& matches, float max_shift,
                   int num_threads, const Refined& result, Vectors vectors = Vectors::kBest);

}  // namespace tensor_stereo
