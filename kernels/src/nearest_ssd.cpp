#include "tensor_stereo/nearest_ssd.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <numeric>
#include <vector>

#include "dense_ssd.hpp"
#include "dispatch.hpp"
#include "lanes.hpp"
#include "tensor_stereo/parallel.hpp"

namespace tensor_stereo {
namespace {

constexpr std::int64_t kLanes = kMaxLanes;

// Of sixteen sums side by side, whatever the instructions: compiled for each of them, it gives the same bits.
TENSOR_STEREO_INLINE float sum_of_squared_differences(const float* a, const float* b, std::int64_t size) noexcept {
    float lane[kLanes] = {};
    std::int64_t k = 0;
    for (; k + kLanes <= size; k += kLanes) {
        for (std::int64_t l = 0; l < kLanes; ++l) {
            const float difference = a[k + l] - b[k + l];
            lane[l] += difference * difference;
        }
    }
    for (std::int64_t l = 0; k + l < size; ++l) {
        const float difference = a[k + l] - b[k + l];
        lane[l] += difference * difference;
    }
    for (std::int64_t half = kLanes / 2; half > 0; half /= 2) {
        for (std::int64_t l = 0; l < half; ++l) lane[l] += lane[l + half];
    }
    return lane[0];
}

// Matches one image with its partner.
class ImageMatcher {
   public:
    TENSOR_STEREO_INLINE void match(const FeatureView& view0, const FeatureView& view1, std::int64_t b,
                                    std::int64_t size, const Gate& gate, const Neighbors& result) {
        const std::int64_t start1 = view1.ptr[b], count1 = view1.ptr[b + 1] - start1;
        sort_by_row(view1.keypoints + 2 * start1, count1);
        for (std::int64_t i = view0.ptr[b]; i < view0.ptr[b + 1]; ++i) {
            const double x = view0.keypoints[2 * i], y = view0.keypoints[2 * i + 1];
            const double left = x - gate.max_disparity, right = x - gate.min_disparity;
            const double top = y - gate.row_offset, bottom = y + gate.row_offset;
            std::size_t k = std::lower_bound(rows_.begin(), rows_.end(), top) - rows_.begin();
            for (; k < rows_.size() && rows_[k] <= bottom; ++k) {
                if (!(columns_[k] >= left && columns_[k] <= right)) continue;
                const std::int64_t j = start1 + order_[k];
                const float cost =
                    sum_of_squared_differences(view0.descriptors + i * size, view1.descriptors + j * size, size);
                if (cost < result.cost[i] || (cost == result.cost[i] && j < result.index[i])) {
                    result.second_cost[i] = result.cost[i];
                    result.cost[i] = cost;
                    result.index[i] = j;
                } else if (cost < result.second_cost[i]) {
                    result.second_cost[i] = cost;
                }
                if (cost < result.cost1[j]) {  // i ascends, so a tie keeps the lowest
                    result.cost1[j] = cost;
                    result.index1[j] = i;
                }
            }
        }
    }

   private:
    void sort_by_row(const double* keypoints, std::int64_t count) {
        order_.resize(count);
        std::iota(order_.begin(), order_.end(), 0);
        std::sort(order_.begin(), order_.end(), [keypoints](std::int64_t i, std::int64_t j) {
            const double y = keypoints[2 * i + 1], z = keypoints[2 * j + 1];
            return y < z || (y == z && i < j);
        });
        rows_.resize(count);
        columns_.resize(count);
        for (std::int64_t k = 0; k < count; ++k) {
            columns_[k] = keypoints[2 * order_[k]];
            rows_[k] = keypoints[2 * order_[k] + 1];
        }
    }

    std::vector<std::int64_t> order_;
    std::vector<double> rows_, columns_;
};

struct Sum {
    const float *a, *b;
    std::int64_t size;
    float& result;

    template <int>
    TENSOR_STEREO_INLINE void run() const {
        result = sum_of_squared_differences(a, b, size);
    }
};

// The images from begin to end.
struct Images {
    const FeatureView &view0, &view1;
    std::int64_t begin, end, size;
    const Gate& gate;
    const Neighbors& result;
    ImageMatcher& matcher;

    template <int>
    TENSOR_STEREO_INLINE void run() const {
        for (std::int64_t b = begin; b < end; ++b) matcher.match(view0, view1, b, size, gate, result);
    }
};

bool is_open(const Gate& gate) {
    constexpr double kInfinity = std::numeric_limits<double>::infinity();
    return gate.row_offset == kInfinity && gate.min_disparity == -kInfinity && gate.max_disparity == kInfinity;
}

}  // namespace

float ssd_of(const float* a, const float* b, std::int64_t size, Vectors vectors) {
    float result;
    run_with(vectors, Sum{a, b, size, result});
    return result;
}

void nearest_ssd(const FeatureView& view0, const FeatureView& view1, std::int64_t num_images, std::int64_t size,
                 const Gate& gate, int num_threads, Vectors vectors, const Neighbors& result) {
    constexpr float kInfinity = std::numeric_limits<float>::infinity();
    const std::int64_t num0 = view0.ptr[num_images], num1 = view1.ptr[num_images];
    std::fill_n(result.cost, num0, kInfinity);
    std::fill_n(result.index, num0, -1);
    std::fill_n(result.second_cost, num0, kInfinity);
    std::fill_n(result.cost1, num1, kInfinity);
    std::fill_n(result.index1, num1, -1);
    if (is_open(gate)) return dense_ssd(view0, view1, num_images, size, num_threads, vectors, result);
    parallel_for(num_images, 1, num_threads, [&] {
        return [&, matcher = ImageMatcher()](std::int64_t begin, std::int64_t end) mutable {
            run_with(vectors, Images{view0, view1, begin, end, size, gate, result, matcher});
        };
    });
}

}  // namespace tensor_stereo
