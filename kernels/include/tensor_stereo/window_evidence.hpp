// What the windows around both keypoints of matches say, held against the other view.
#pragma once

#include <cstdint>

#include "tensor_stereo/gray_image.hpp"
#include "tensor_stereo/vectors.hpp"

namespace tensor_stereo {

constexpr std::int64_t kMaxSearched = 256;  // places along a row or line
constexpr std::int64_t kMaxInDisc = 9;      // in each row of a disc
constexpr int kNearPlaces = 7;              // around the match
constexpr int kSlantedWindows = 2;          // 11 x 11, like the middle
constexpr int kEvidenceCurves = 2;          // like the middle, near and like it
constexpr int kEvidenceOfView =
    kWholeWindows * (kNearPlaces + 7) + 2 * kHalfWindows + 1 + kSlantedWindows * (kNearPlaces + 3);
constexpr int kEvidenceValues = 2 * kEvidenceOfView + 2;

// What is searched in a pair.
struct EvidencePair {
    GrayImage view[2];
    std::int64_t first = 0, count = 0;  // disparities, in whole px
    bool has_rows = true;               // else a disc around each match is searched
    bool is_rectified = true;           // along the columns, else along the lines of the matches
};

// M matches of B pairs, pair by pair.
struct EvidenceMatches {
    const std::int64_t* ptr;  // (B + 1)
    const float* left;        // (M, 2) px
    const float* right;       // (M, 2) px
    const float* along;       // (M, 2) unit vectors along the epipolar lines
    const float* disparity;   // (M)
    const float* across;      // (M) px, where the line of the keypoint lies in view 1, across it
    const float* slope;       // (M, 2) px/px
};

struct Evidence {
    float* values;    // (M, kEvidenceValues)
    float* curve[2];  // (M, kEvidenceCurves, width)
    float* start;     // (M) px, the first disparity of the curves
    float* offset;    // (M) px
    std::int64_t width;
};

// Throws std::bad_alloc.
void window_evidence(const EvidencePair* pairs, std::int64_t num_pairs, const EvidenceMatches& matches, int num_threads,
                     const Evidence& result, Vectors vectors = Vectors::kBest);

}  // namespace tensor_stereo
