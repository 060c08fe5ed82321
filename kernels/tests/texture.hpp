// A random texture and the same seen a few px to the left.
#pragma once

#include <cmath>
#include <cstdint>
#include <random>
#include <vector>

#include "tensor_stereo/gray_image.hpp"

struct Texture {
    static constexpr std::int64_t kHeight = 40, kWidth = 70, kShift = 6;
    std::vector<std::uint8_t> left, right;
    const std::vector<char> known = std::vector<char>(kHeight * kWidth, 1);

    Texture() : left(kHeight * kWidth), right(kHeight * kWidth) {
        std::mt19937 random(0);
        for (auto& level : left) level = static_cast<std::uint8_t>(random() % 256);
        for (std::int64_t y = 0; y < kHeight; ++y) {
            for (std::int64_t x = 0; x < kWidth; ++x) {
                right[y * kWidth + x] = left[y * kWidth + std::min(x + kShift, kWidth - 1)];
            }
        }
    }

    // Both views, the second one with a map of what is known.
    void show(tensor_stereo::GrayImage (&view)[2]) const {
        for (int v = 0; v < 2; ++v) {
            view[v].levels = v == 0 ? left.data() : right.data();
            view[v].height = kHeight;
            view[v].width = kWidth;
        }
        view[1].known = reinterpret_cast<const bool*>(known.data());
    }
};

// Coordinates that are no pixels.
constexpr float kStrange[] = {NAN, 1e30f, -1e30f, INFINITY};
