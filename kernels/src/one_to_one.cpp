#include "tensor_stereo/one_to_one.hpp"

#include <algorithm>
#include <bit>
#include <cstddef>
#include <numeric>
#include <vector>

#include "tensor_stereo/index.hpp"
#include "tensor_stereo/parallel.hpp"

namespace tensor_stereo {
namespace {

// Labels the points of one segment by the first row of equal coordinates.
class Labels {
   public:
    // Whether any two points coincide; if so, label[k] is the first row equal to row k.
    bool assign(const double* points, std::size_t count) {
        const std::size_t size = std::bit_ceil(2 * count + 1);
        table_.assign(size, -1);
        label.resize(count);
        const int shift = 64 - std::countr_zero(size);
        bool any = false;
        for (std::size_t k = 0; k < count; ++k) {
            const double x = points[2 * k] + 0.0, y = points[2 * k + 1] + 0.0;  // -0 becomes 0
            const std::uint64_t hash = (std::bit_cast<std::uint64_t>(x) * 0x9e3779b97f4a7c15u) ^
                                       (std::rotl(std::bit_cast<std::uint64_t>(y), 32) * 0xd6e8feb86659fd93u);
            std::size_t slot = (hash * 0x9e3779b97f4a7c15u) >> shift;
            while (table_[slot] >= 0) {
                const std::size_t other = table_[slot];
                if (points[2 * other] == x && points[2 * other + 1] == y) break;
                slot = (slot + 1) & (size - 1);
            }
            if (table_[slot] < 0) {
                table_[slot] = static_cast<Index>(k);
            } else {
                any = true;
            }
            label[k] = table_[slot];
        }
        return any;
    }

    std::vector<Index> label;

   private:
    std::vector<Index> table_;
};

}  // namespace

void one_to_one(const double* points0, const double* points1, const std::int64_t* ptr, std::int64_t num_pairs,
                const double* cost, int num_threads, bool* kept) {
    parallel_for(num_pairs, 1, num_threads, [&] {
        return [&, labels0 = Labels(), labels1 = Labels(), order = std::vector<Index>(), taken0 = std::vector<bool>(),
                taken1 = std::vector<bool>()](std::int64_t begin, std::int64_t end) mutable {
            for (std::int64_t b = begin; b < end; ++b) {
                const std::int64_t start = ptr[b];
                const auto count = static_cast<std::size_t>(ptr[b + 1] - start);
                const bool repeats0 = labels0.assign(points0 + 2 * start, count);
                const bool repeats1 = labels1.assign(points1 + 2 * start, count);
                bool* const result = kept + start;
                std::fill_n(result, count, true);
                if (!repeats0 && !repeats1) continue;
                order.resize(count);
                std::iota(order.begin(), order.end(), 0);
                if (cost != nullptr) {
                    const double* const value = cost + start;
                    std::stable_sort(order.begin(), order.end(),
                                     [value](Index i, Index j) { return value[i] < value[j]; });
                }
                taken0.assign(count, false);
                taken1.assign(count, false);
                for (const Index row : order) {
                    const Index left = labels0.label[row], right = labels1.label[row];
                    result[row] = !taken0[left] && !taken1[right];
                    if (result[row]) taken0[left] = taken1[right] = true;
                }
            }
        };
    });
}

}  // namespace tensor_stereo
