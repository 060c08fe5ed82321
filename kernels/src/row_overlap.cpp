#include "tensor_stereo/row_overlap.hpp"

#include "tensor_stereo/parallel.hpp"

namespace tensor_stereo {

void row_overlap(const std::int64_t* crow0, const std::int64_t* cols0, const std::int64_t* crow1,
                 const std::int64_t* cols1, std::int64_t num_rows, int num_threads, std::int64_t* overlap,
                 std::int64_t* degree0, std::int64_t* degree1) {
    constexpr std::int64_t kGrain = 16384;
    parallel_for(num_rows, kGrain, num_threads, [&] {
        return [&](std::int64_t begin, std::int64_t end) {
            for (std::int64_t row = begin; row < end; ++row) {
                const std::int64_t *p = cols0 + crow0[row], *p_end = cols0 + crow0[row + 1];
                const std::int64_t *q = cols1 + crow1[row], *q_end = cols1 + crow1[row + 1];
                degree0[row] = p_end - p;
                degree1[row] = q_end - q;
                std::int64_t shared = 0;
                while (p != p_end && q != q_end) {  // no branch inside: which column is smaller cannot be predicted
                    const std::int64_t a = *p, b = *q;
                    shared += a == b;
                    p += a <= b;
                    q += b <= a;
                }
                overlap[row] = shared;
            }
        };
    });
}

}  // namespace tensor_stereo
