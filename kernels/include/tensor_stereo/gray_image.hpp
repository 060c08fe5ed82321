// Images in which windows are looked at.
#pragma once

#include <cstdint>

namespace tensor_stereo {

constexpr int kWindowRadius = 7;  // px, of the largest window
constexpr int kWholeWindows = 4;  // 5 x 5, 11 x 11, like the middle, near and like it
constexpr int kHalfWindows = 4;   // left, right, upper, lower half of 11 x 11

// One view of a pair. Grey levels are uint8, or float where a view was resampled.
struct GrayImage {
    const void* levels = nullptr;  // (height, width)
    bool is_float = false;
    std::int64_t height = 0, width = 0;
    const bool* known = nullptr;  // (height, width) where the view was seen; null: everywhere
    float origin[2] = {0, 0};     // px of view 0, where the first pixel lies
    float brighter = 0;           // grey levels to take off
};

}  // namespace tensor_stereo
