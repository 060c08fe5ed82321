// Grey levels of windows and strips, bilinear, with the border repeated.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "lanes.hpp"
#include "tensor_stereo/gray_image.hpp"

namespace tensor_stereo {

constexpr int kSide = 2 * kWindowRadius + 1;
constexpr int kMaxPlaces = 256;  // of one strip
constexpr int kStride = ((kMaxPlaces + kSide + kMaxLanes - 1) / kMaxLanes + 1) * kMaxLanes;

// kSide rows of grey levels; columns behind `width` are finite.
struct Strip {
    alignas(64) float row[kSide][kStride];
};

struct Place {
    float x, y;
};

// Coordinates that are far off, or no numbers, lie outside of every image.
TENSOR_STEREO_INLINE float bounded(float x) {
    constexpr float kFar = 4e6f;
    return x > -kFar ? (x < kFar ? x : kFar) : -kFar;
}

// Of the offsets of a sheared window, which reach no farther than that.
constexpr float kReachPx = 60;
TENSOR_STEREO_INLINE float within_reach(float x) {
    return x > -kReachPx ? (x < kReachPx ? x : kReachPx) : -kReachPx;  // also of what is no number
}

// The axes in which the windows of a match lie: the step from column to column and from row to row.
struct Axes {
    Place along, across;
};

TENSOR_STEREO_INLINE Place move(Place place, float along, float across, const Axes& axes) {
    return {place.x + along * axes.along.x + across * axes.across.x,
            place.y + along * axes.along.y + across * axes.across.y};
}

template <class T>
TENSOR_STEREO_INLINE void sample_rows(const GrayImage& image, Place start, int width, Strip& strip) {
    const auto* const levels = static_cast<const T*>(image.levels);
    const float left = std::clamp(bounded(start.x), -2.0f * width, image.width + 2.0f * width);
    const float middle = std::clamp(bounded(start.y), -2.0f * kWindowRadius, image.height + 2.0f * kWindowRadius);
    const float x0 = std::floor(left), y0 = std::floor(middle);
    const float fx = left - x0, fy = middle - y0;
    const auto column = static_cast<std::int64_t>(x0), top = static_cast<std::int64_t>(y0) - kWindowRadius;
    const bool is_inside = column >= 0 && column + width + 1 <= image.width;
    alignas(64) float upper[kStride], lower[kStride];
    auto read = [&](std::int64_t y, float* row) {
        const T* const from = levels + std::clamp<std::int64_t>(y, 0, image.height - 1) * image.width;
        if (is_inside) {
            for (int x = 0; x <= width; ++x) row[x] = static_cast<float>(from[column + x]) - image.brighter;
        } else {
            for (int x = 0; x <= width; ++x) {
                const auto place = std::clamp<std::int64_t>(column + x, 0, image.width - 1);
                row[x] = static_cast<float>(from[place]) - image.brighter;
            }
        }
    };
    float *above = upper, *below = lower;
    read(top, above);
    for (int y = 0; y < kSide; ++y) {
        read(top + y + 1, below);
        for (int x = 0; x <= width; ++x) above[x] = above[x] + fy * (below[x] - above[x]);
        float* const row = strip.row[y];
        for (int x = 0; x < width; ++x) row[x] = above[x] + fx * (above[x + 1] - above[x]);
        for (int x = width; x < width + kMaxLanes; ++x) row[x] = 0;
        std::swap(above, below);
    }
}

// Columns `first`, `first` + 1, ... of a frame around `center`.
template <class T>
TENSOR_STEREO_INLINE void sample_frame(const GrayImage& image, Place center, const Axes& axes, int first, int width,
                                       Strip& strip) {
    const auto* const levels = static_cast<const T*>(image.levels);
    const float center_x = bounded(center.x - image.origin[0]), center_y = bounded(center.y - image.origin[1]);
    const float base_x = std::floor(center_x), base_y = std::floor(center_y);
    const float fraction_x = center_x - base_x, fraction_y = center_y - base_y;
    const float last_x = static_cast<float>(image.width - 1), last_y = static_cast<float>(image.height - 1);
    const float least_x = -base_x, most_x = last_x - base_x, least_y = -base_y, most_y = last_y - base_y;
    const auto column = static_cast<std::int64_t>(base_x), line = static_cast<std::int64_t>(base_y);
    for (int y = 0; y < kSide; ++y) {
        const auto down = static_cast<float>(y - kWindowRadius);
        float* const row = strip.row[y];
        for (int k = 0; k < width; ++k) {
            const auto ahead = static_cast<float>(first + k);
            const float dx = fraction_x + ahead * axes.along.x + down * axes.across.x;
            const float dy = fraction_y + ahead * axes.along.y + down * axes.across.y;
            // In this order what is no number becomes the least.
            const float u = std::max(least_x, std::min(most_x, dx)), v = std::max(least_y, std::min(most_y, dy));
            const float u0 = std::floor(u), v0 = std::floor(v);
            const float fu = u - u0, fv = v - v0;
            const auto x = std::clamp<std::int64_t>(column + static_cast<std::int64_t>(u0), 0, image.width - 1);
            const auto z = std::clamp<std::int64_t>(line + static_cast<std::int64_t>(v0), 0, image.height - 1);
            const std::int64_t x1 = std::min(x + 1, image.width - 1), z1 = std::min(z + 1, image.height - 1);
            const T* const upper = levels + z * image.width;
            const T* const lower = levels + z1 * image.width;
            const float a = static_cast<float>(upper[x]) * (1 - fu) + static_cast<float>(upper[x1]) * fu;
            const float b = static_cast<float>(lower[x]) * (1 - fu) + static_cast<float>(lower[x1]) * fu;
            row[k] = (a + fv * (b - a)) - image.brighter;
        }
        for (int k = width; k < width + kMaxLanes; ++k) row[k] = 0;
    }
}

// The same along rows that are stretched by 1 + `shear_x` and each shifted by `shear_y` px more, around a center.
template <class T>
TENSOR_STEREO_INLINE void sample_sheared(const GrayImage& image, Place center, float shear_x, float shear_y, int radius,
                                         Strip& strip) {
    constexpr int kReach = 64;  // px on either side, beyond all shears of a window
    const auto* const levels = static_cast<const T*>(image.levels);
    const float center_x = bounded(center.x), center_y = bounded(center.y);
    const float base_x = std::floor(center_x), base_y = std::floor(center_y);
    const float fraction_x = center_x - base_x, fraction_y = center_y - base_y;
    const float least_y = -base_y, most_y = static_cast<float>(image.height - 1) - base_y;
    const auto column = static_cast<std::int64_t>(base_x), line = static_cast<std::int64_t>(base_y);
    const int width = 2 * radius + 1;
    alignas(64) float between[2 * kReach];
    for (int y = 0; y < kSide; ++y) {
        const auto down = static_cast<float>(y - kWindowRadius);
        const float v = std::max(std::min(fraction_y + down, most_y), least_y), v0 = std::floor(v), fv = v - v0;
        const auto z = std::clamp<std::int64_t>(line + static_cast<std::int64_t>(v0), 0, image.height - 1);
        const T* const upper = levels + z * image.width;
        const T* const lower = levels + std::min(z + 1, image.height - 1) * image.width;
        const auto reach = static_cast<float>(radius);
        const float shift = fraction_x + down * shear_y, stretch = 1 + shear_x;
        const float one = shift - reach * stretch, other = shift + reach * stretch;
        const int low = static_cast<int>(within_reach(std::min(one, other))) - 1;
        const int high = static_cast<int>(within_reach(std::max(one, other))) + 2;
        const bool is_inside = column + low >= 0 && column + high < image.width;
        for (int x = low; x <= high; ++x) {
            const auto from = is_inside ? column + x : std::clamp<std::int64_t>(column + x, 0, image.width - 1);
            const auto above = static_cast<float>(upper[from]), below = static_cast<float>(lower[from]);
            between[x + kReach] = above + fv * (below - above);
        }
        float* const row = strip.row[y];
        for (int k = 0; k < width; ++k) {
            const float dx = within_reach(shift + static_cast<float>(k - radius) * stretch);
            const int at = static_cast<int>(dx + kReach) - kReach;  // rounds down
            const float fu = dx - static_cast<float>(at);
            const float* const from = between + at + kReach;
            row[k] = (from[0] * (1 - fu) + from[1] * fu) - image.brighter;
        }
        for (int k = width; k < width + kMaxLanes; ++k) row[k] = 0;
    }
}

// Where the windows of one view are looked for.
class Look {
   public:
    TENSOR_STEREO_INLINE Look(const GrayImage& image, bool is_rectified, Place along)
        : image_(image), is_rectified_(is_rectified), axes_{along, {-along.y, along.x}} {}

    TENSOR_STEREO_INLINE Place place(Place point, float along, float across) const {
        return move(point, along, across, axes_);
    }

    // Columns around a place.
    TENSOR_STEREO_INLINE void window(Place center, int radius, Strip& strip) const {
        if (is_rectified_) {
            rows({center.x - static_cast<float>(radius), center.y}, 2 * radius + 1, strip);
        } else {
            frame(center, axes_, -radius, 2 * radius + 1, strip);
        }
    }

    // Columns from a place on.
    TENSOR_STEREO_INLINE void strip(Place start, int width, Strip& strip) const {
        is_rectified_ ? rows(start, width, strip) : frame(start, axes_, 0, width, strip);
    }

    // What a slanted surface moves to the columns around a place.
    TENSOR_STEREO_INLINE void slanted(Place center, int radius, float shear_x, float shear_y, Strip& strip) const {
        if (is_rectified_) {
            image_.is_float ? sample_sheared<float>(image_, center, shear_x, shear_y, radius, strip)
                            : sample_sheared<std::uint8_t>(image_, center, shear_x, shear_y, radius, strip);
            return;
        }
        const Axes axes{{axes_.along.x * (1 + shear_x), axes_.along.y * (1 + shear_x)},
                        {axes_.across.x + axes_.along.x * shear_y, axes_.across.y + axes_.along.y * shear_y}};
        frame(center, axes, -radius, 2 * radius + 1, strip);
    }

    // Whether `count` places from one on lie outside of what is known.
    TENSOR_STEREO_INLINE void outside(Place start, int count, bool* found) const {
        for (int k = 0; k < count; ++k) {
            const auto ahead = static_cast<float>(k);
            if (is_rectified_) {
                const float x = start.x + ahead;
                found[k] = x < 0 || x > static_cast<float>(image_.width - 1);
                continue;
            }
            const float x = std::nearbyint((start.x - image_.origin[0]) + ahead * axes_.along.x);
            const float y = std::nearbyint((start.y - image_.origin[1]) + ahead * axes_.along.y);
            const bool is_inside =
                x >= 0 && y >= 0 && x < static_cast<float>(image_.width) && y < static_cast<float>(image_.height);
            found[k] = !is_inside ||
                       (image_.known != nullptr &&
                        !image_.known[static_cast<std::int64_t>(y) * image_.width + static_cast<std::int64_t>(x)]);
        }
    }

   private:
    TENSOR_STEREO_INLINE void rows(Place start, int width, Strip& strip) const {
        image_.is_float ? sample_rows<float>(image_, start, width, strip)
                        : sample_rows<std::uint8_t>(image_, start, width, strip);
    }
    TENSOR_STEREO_INLINE void frame(Place center, const Axes& axes, int first, int width, Strip& strip) const {
        image_.is_float ? sample_frame<float>(image_, center, axes, first, width, strip)
                        : sample_frame<std::uint8_t>(image_, center, axes, first, width, strip);
    }

    const GrayImage& image_;
    bool is_rectified_;
    Axes axes_;
};

}  // namespace tensor_stereo
