// |a - b|**2 = |a|**2 + |b|**2 - 2 a.b: products of blocks of both views tell which sums can matter at all.
//
// Whole numbers whose products and sums float32 holds give the sum itself, in any order. Other descriptors give a lower
// bound of it, and only where that is below the best so far is the sum taken. No matrix of all sums is formed. Grey
// levels, whole numbers from 0 to 255, are multiplied as bytes where the machine can.
#include "dense_ssd.hpp"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <limits>
#include <mutex>
#include <vector>

#include "byte_products.hpp"
#include "dispatch.hpp"
#include "lanes.hpp"
#include "tensor_stereo/parallel.hpp"

namespace tensor_stereo {
namespace {

constexpr int kRows = 6;             // of view 0 at a time, whose sums are held in registers
constexpr std::int64_t kChunk = 60;  // rows that one thread takes
constexpr float kInfinity = std::numeric_limits<float>::infinity();

// What a value of the product says about the sum: it is at least `value`, and matters below `bound * growth + least`.
struct Rounding {
    float shrink = 0, growth = 1, least = 0;
};

// Rounding of a product of `size` terms, at most 2 (size + 8) roundings of |a|**2 + |b|**2 (Higham, Accuracy and
// Stability of Numerical Algorithms, section 3.1), taken twice; that of the sum itself, at most size + 2 of itself; and
// of squares too small for normal numbers.
Rounding rounding_of(std::int64_t size) {
    constexpr float kEpsilon = std::numeric_limits<float>::epsilon(), kTiny = std::numeric_limits<float>::min();
    const auto terms = static_cast<float>(size + 8);
    return {4 * terms * kEpsilon, 1 + 2 * terms * kEpsilon, 4 * terms * kTiny};
}

constexpr std::int64_t kLanes = kMaxLanes;  // that a loop works on side by side

// What values have in common.
struct Range {
    float least = 0, most = 0, part = 0;  // the part that is not whole

    TENSOR_STEREO_INLINE void take(const float* values, std::int64_t count) {
        float low[kLanes] = {}, high[kLanes] = {}, rest[kLanes] = {};
        auto look = [&](std::int64_t lane, float value) {
            low[lane] = low[lane] < value ? low[lane] : value;
            high[lane] = high[lane] > value ? high[lane] : value;
            const float magnitude = std::fabs(value);
            // adding 2**23 rounds away what is not whole; above it the peak decides
            const float away = std::fabs((magnitude + 8388608.0f) - 8388608.0f - magnitude);
            rest[lane] = rest[lane] > away ? rest[lane] : away;
        };
        std::int64_t k = 0;
        for (; k + kLanes <= count; k += kLanes) {
            for (std::int64_t l = 0; l < kLanes; ++l) look(l, values[k + l]);
        }
        for (; k < count; ++k) look(0, values[k]);
        least = std::min(least, *std::min_element(low, low + kLanes));
        most = std::max(most, *std::max_element(high, high + kLanes));
        part = std::max(part, *std::max_element(rest, rest + kLanes));
    }

    // Whether float32 holds all products, their sums and the sums of squared differences of `size` terms.
    bool is_exact(std::int64_t size) const {
        const double peak = std::max(-least, most), span = static_cast<double>(most) - least;
        return part == 0 && static_cast<double>(size) * std::max(2 * peak * peak, span * span) <= 16777216.0;
    }
};

struct Job {
    const FeatureView &view0, &view1;
    std::int64_t size;
    Vectors vectors;
    const Neighbors& result;
    std::mutex& lock;  // of cost1 and index1
};

// What a thread keeps of the pair that it works on, and its own findings for view 1.
struct Workspace {
    std::int64_t pair = -1;
    Rounding rounding;
    std::vector<float> panels, square1, cost1;
    std::vector<std::int64_t> index1;
    bool is_bytes = false;
    std::int64_t quads = 0;
    std::vector<std::int32_t> missing1;     // of the products of bytes
    std::vector<std::uint8_t> byte_panels;  // (panel, quads, 2 N, 4)
    std::vector<std::int8_t> byte_rows;     // (kChunk, 4 quads) less 128
};

// Sum of the values, or of their squares.
template <bool kSquares>
TENSOR_STEREO_INLINE float sum_of(const float* values, std::int64_t size) {
    float lane[kLanes] = {};
    std::int64_t k = 0;
    for (; k + kLanes <= size; k += kLanes) {
        for (std::int64_t l = 0; l < kLanes; ++l) lane[l] += values[k + l] * (kSquares ? values[k + l] : 1);
    }
    for (; k < size; ++k) lane[0] += values[k] * (kSquares ? values[k] : 1);
    float sum = 0;
    for (const float part : lane) sum += part;
    return sum;
}

// Descriptors of view 1 with 2 N of them side by side: (panel, component, 2 N).
template <int N>
TENSOR_STEREO_INLINE void prepare(const Job& job, std::int64_t b, Workspace& work) {
    const std::int64_t start0 = job.view0.ptr[b], start1 = job.view1.ptr[b], size = job.size;
    const std::int64_t count0 = job.view0.ptr[b + 1] - start0, count1 = job.view1.ptr[b + 1] - start1;
    const float *first0 = job.view0.descriptors + start0 * size, *first1 = job.view1.descriptors + start1 * size;
    Range range;
    range.take(first0, count0 * size);
    range.take(first1, count1 * size);
    const bool is_exact = range.is_exact(size);
    work.rounding = is_exact ? Rounding{} : rounding_of(size);
    work.is_bytes = 2 * N == kByteColumns && is_exact && range.least >= 0 && range.most <= 255 && has_byte_products();
    work.quads = (size + 3) / 4;
    const std::int64_t num_panels = (count1 + 2 * N - 1) / (2 * N);
    work.square1.assign(num_panels * 2 * N, kInfinity);
    if (work.is_bytes) {
        work.byte_panels.assign(num_panels * work.quads * 4 * kByteColumns, 0);
        work.byte_rows.resize(kChunk * work.quads * 4);
        work.missing1.assign(num_panels * 2 * N, 0);
    } else {
        work.panels.assign(num_panels * size * 2 * N, 0);
    }
    for (std::int64_t j = 0; j < count1; ++j) {
        const float* values = first1 + j * size;
        const std::int64_t panel = j / (2 * N), column = j % (2 * N);
        work.square1[j] = sum_of<true>(values, size);
        if (work.is_bytes) {
            std::uint8_t* bytes = work.byte_panels.data() + (panel * work.quads * kByteColumns + column) * 4;
            for (std::int64_t k = 0; k < size; ++k) {
                bytes[k / 4 * 4 * kByteColumns + k % 4] = static_cast<std::uint8_t>(values[k]);
            }
            work.missing1[j] = 128 * static_cast<std::int32_t>(sum_of<false>(values, size));  // rows are less by 128
        } else {
            for (std::int64_t k = 0; k < size; ++k) work.panels[(panel * size + k) * 2 * N + column] = values[k];
        }
    }
    work.cost1.resize(num_panels * 2 * N);
    work.index1.resize(num_panels * 2 * N);
    work.pair = b;
}

// Lanes of a comparison that are true, one byte each.
template <int N>
class Mask {
   public:
    TENSOR_STEREO_INLINE explicit Mask(const typename Vector<N>::Integers& lanes) {
        typedef std::int8_t Bytes __attribute__((vector_size(N)));
        const Bytes bytes = __builtin_convertvector(lanes, Bytes);
        if constexpr (std::endian::native == std::endian::little) {
            std::memcpy(words_, &bytes, sizeof bytes);
        } else {
            std::uint8_t byte[N];
            std::memcpy(byte, &bytes, sizeof bytes);
            for (int l = 0; l < N; ++l) words_[l / 8] |= static_cast<std::uint64_t>(byte[l]) << (8 * (l % 8));
        }
    }

    TENSOR_STEREO_INLINE bool is_empty() const { return N <= 8 ? words_[0] == 0 : (words_[0] | words_[1]) == 0; }

    // Takes out the first.
    TENSOR_STEREO_INLINE int pop() {
        const int w = words_[0] == 0 ? 1 : 0;
        const int byte = std::countr_zero(words_[w]) / 8;
        words_[w] &= ~(std::uint64_t{255} << (8 * byte));
        return 8 * w + byte;
    }

   private:
    std::uint64_t words_[2] = {};
};

struct Chunk {
    const Job& job;
    std::int64_t pair, begin, end;  // rows of view 0
    Workspace& work;

    template <int N>
    TENSOR_STEREO_INLINE void run() const {
        if (work.pair != pair) prepare<N>(job, pair, work);
        const std::int64_t start1 = job.view1.ptr[pair], count1 = job.view1.ptr[pair + 1] - start1;
        {
            const std::lock_guard guard(job.lock);
            std::copy_n(job.result.cost1 + start1, count1, work.cost1.begin());
            std::copy_n(job.result.index1 + start1, count1, work.index1.begin());
        }
        float square0[kChunk];
        for (std::int64_t i = begin; i < end; ++i) {
            square0[i - begin] = sum_of<true>(job.view0.descriptors + i * job.size, job.size);
        }
        if (work.is_bytes) pack_rows();
        for (std::int64_t j = 0; j < count1; j += 2 * N) {
            for (std::int64_t i = begin; i < end; i += kRows) block<N>(i, j, start1, count1, square0 + (i - begin));
        }
        const std::lock_guard guard(job.lock);
        for (std::int64_t j = 0; j < count1; ++j) {
            float& cost = job.result.cost1[start1 + j];
            std::int64_t& index = job.result.index1[start1 + j];
            if (work.cost1[j] < cost || (work.cost1[j] == cost && work.index1[j] < index)) {
                cost = work.cost1[j];
                index = work.index1[j];
            }
        }
    }

    TENSOR_STEREO_INLINE void pack_rows() const {
        for (std::int64_t i = begin; i < end; ++i) {
            const float* values = job.view0.descriptors + i * job.size;
            std::int8_t* row = work.byte_rows.data() + (i - begin) * work.quads * 4;
            for (std::int64_t k = 0; k < job.size; ++k) {
                row[k] = static_cast<std::int8_t>(static_cast<std::int32_t>(values[k]) - 128);
            }
        }
    }

    template <int N>
    TENSOR_STEREO_INLINE void multiply(std::int64_t i, std::int64_t j, Lanes<N> (&sum)[kRows][2]) const {
        const std::int64_t size = job.size;
        const float* row[kRows];
        for (int r = 0; r < kRows; ++r) row[r] = job.view0.descriptors + std::min(i + r, end - 1) * size;
        const float* panel = work.panels.data() + j * size;
        for (std::int64_t k = 0; k < size; ++k) {
            Lanes<N> left, right;
            load(panel + k * 2 * N, left);
            load(panel + k * 2 * N + N, right);
            for (int r = 0; r < kRows; ++r) {
                sum[r][0] += left * row[r][k];
                sum[r][1] += right * row[r][k];
            }
        }
    }

    template <int N>
    TENSOR_STEREO_INLINE void multiply_bytes(std::int64_t i, std::int64_t j, Lanes<N> (&sum)[kRows][2]) const {
        const std::int8_t* row[kRows];
        for (int r = 0; r < kRows; ++r) {
            row[r] = work.byte_rows.data() + (std::min(i + r, end - 1) - begin) * work.quads * 4;
        }
        std::int32_t sums[kByteRows][kByteColumns];
        byte_products(row, work.byte_panels.data() + j * work.quads * 4, work.quads, sums);
        for (int r = 0; r < kRows; ++r) {
            for (int p = 0; p < 2; ++p) {
                typename Vector<N>::Integers part, missing;
                std::memcpy(&part, sums[r] + p * N, sizeof part);
                std::memcpy(&missing, work.missing1.data() + j + p * N, sizeof missing);
                sum[r][p] = __builtin_convertvector(part + missing, Lanes<N>);
            }
        }
    }

    // Rows i to i + kRows and columns j to j + 2 N of the product.
    template <int N>
    TENSOR_STEREO_INLINE void block(std::int64_t i, std::int64_t j, std::int64_t start1, std::int64_t count1,
                                    const float* square0) const {
        Lanes<N> sum[kRows][2] = {};
        if (work.is_bytes) {
            multiply_bytes<N>(i, j, sum);
        } else {
            multiply<N>(i, j, sum);
        }
        const Rounding& rounding = work.rounding;
        Lanes<N> square1[2], bound1[2];
        for (int p = 0; p < 2; ++p) {
            load(work.square1.data() + j + p * N, square1[p]);
            load(work.cost1.data() + j + p * N, bound1[p]);
        }
        for (int r = 0; r < kRows && i + r < end; ++r) {
            const float second = job.result.second_cost[i + r];
            Lanes<N> least[2];
            typename Vector<N>::Integers matters[2];
            for (int p = 0; p < 2; ++p) {
                const Lanes<N> square = square1[p] + square0[r];
                least[p] = square - square * rounding.shrink - 2.0f * sum[r][p];
                const Lanes<N> bound = bound1[p] > second ? bound1[p] : Lanes<N>{} + second;
                matters[p] = least[p] <= bound * rounding.growth + rounding.least;
            }
            if (Mask<N>(matters[0] | matters[1]).is_empty()) continue;
            for (int p = 0; p < 2; ++p) {
                for (Mask<N> mask(matters[p]); !mask.is_empty();) {
                    const int l = mask.pop();
                    const std::int64_t column = j + p * N + l;
                    if (column < count1) take(i + r, start1 + column, column, least[p][l]);
                }
            }
        }
    }

    TENSOR_STEREO_INLINE void take(std::int64_t i, std::int64_t index, std::int64_t j, float least) const {
        const Rounding& rounding = work.rounding;
        float &cost = job.result.cost[i], &second = job.result.second_cost[i];
        const float bound = std::max(second, work.cost1[j]);
        if (!(least <= bound * rounding.growth + rounding.least)) return;
        const float ssd = rounding.shrink == 0
                              ? least
                              : ssd_of(job.view0.descriptors + i * job.size, job.view1.descriptors + index * job.size,
                                       job.size, job.vectors);
        if (ssd < cost) {  // index ascends, so a tie keeps the lowest
            second = cost;
            cost = ssd;
            job.result.index[i] = index;
        } else if (ssd < second) {
            second = ssd;
        }
        if (ssd < work.cost1[j] || (ssd == work.cost1[j] && i < work.index1[j])) {
            work.cost1[j] = ssd;
            work.index1[j] = i;
        }
    }
};

}  // namespace

void dense_ssd(const FeatureView& view0, const FeatureView& view1, std::int64_t num_images, std::int64_t size,
               int num_threads, Vectors vectors, const Neighbors& result) {
    std::mutex lock;
    const Job job{view0, view1, size, vectors, result, lock};
    struct Rows {
        std::int64_t pair, begin, end;
    };
    std::vector<Rows> chunks;
    for (std::int64_t b = 0; b < num_images; ++b) {
        const std::int64_t end = view1.ptr[b] < view1.ptr[b + 1] ? view0.ptr[b + 1] : view0.ptr[b];
        for (std::int64_t i = view0.ptr[b]; i < end; i += kChunk) {
            chunks.push_back({b, i, std::min(i + kChunk, end)});
        }
    }
    parallel_for(static_cast<std::int64_t>(chunks.size()), 1, num_threads, [&] {
        return [&, work = Workspace()](std::int64_t begin, std::int64_t end) mutable {
            for (std::int64_t c = begin; c < end; ++c) {
                run_with(vectors, Chunk{job, chunks[c].pair, chunks[c].begin, chunks[c].end, work});
            }
        };
    });
}

}  // namespace tensor_stereo
