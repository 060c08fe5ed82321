// What the windows around both keypoints of matches say, held against the other view.
#pragma once

#include <cstdint>

namespace tensor_stereo {

constexpr int kWindowRadius = 7;      // px, of the largest window
constexpr std::int64_t kMaxSearched = 256;  // places along a row or line
constexpr std::int64_t kMaxInDisc = 9;     // in each row of a disc
constexpr int kNearPlaces = 7;        // around the match
constexpr int kWholeWindows = 4;      // 5 x 5, 11 x 11, like the middle, near and like it
constexpr int kHalfWindows = 4;       // left, right, upper, lower half of 11 x 11
constexpr int kSlantedWindows = 2;    // 11 x 11, like the middle
constexpr int kEvidenceCurves = 2;    // like the middle, near and like it
constexpr int kEvidenceOfView = kWholeWindows * (kNearPlaces + 7) + 2 * kHalfWindows + 1 +
                                kSlantedWindows * (kNearPlaces + 3);
constexpr int kEvidenceValues = 2 * kEvidenceOfView + 2;

// One view of a pair. Grey levels are uint8, or float where a view was resampled.
struct GrayImage {
    const void* levels = nullptr;  // (height, width)
    bool is_float = false;
    std::int64_t height = 0, width = 0;
    const bool* known = nullptr;  // (height, width) where the view was seen; null: everywhere
    float origin[2] = {0, 0};     // px of view 0, where the first pixel lies
    float brighter = 0;           // grey levels to take off
};

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
    float* values;   // (M, kEvidenceValues)
    float* curve[2];  // (M, kEvidenceCurves, width)
    float* start;    // (M) px, the first disparity of the curves
    float* offset;   // (M) px
    std::int64_t width;
};

// Which vector instructions may be used; all give the same bits.
enum class Vectors { kBest, kBaseline, kAvx2, kAvx512 };

// Whether this machine has them.
bool has_vectors(Vectors vectors);

// Throws std::bad_alloc.
void window_evidence(const EvidencePair* pairs, std::int64_t num_pairs, const EvidenceMatches& matches,
                     int num_threads, const Evidence& result, Vectors vectors = Vectors::kBest);

}  // namespace tensor_stereo
