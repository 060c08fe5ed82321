#include "tensor_stereo/agreeing_neighbors.hpp"

#include <cmath>

#include "tensor_stereo/parallel.hpp"

namespace tensor_stereo {

namespace {

struct Seen {
    double x, y, disparity, row;
};

}  // namespace

void agreeing_neighbors(const double* points0, const double* points1, const std::int64_t* crow0,
                        const std::int64_t* cols0, const std::int64_t* crow1, const std::int64_t* cols1,
                        std::int64_t num_rows, double row_px, double disparity_px, double slope, double spread,
                        int num_threads, std::int64_t* count) {
    constexpr std::int64_t kGrain = 8192;
    const std::int64_t* const crows[] = {crow0, crow1};
    const std::int64_t* const cols[] = {cols0, cols1};
    const auto see = [&](std::int64_t k) {
        const double *p = points0 + 2 * k, *q = points1 + 2 * k;
        return Seen{p[0], p[1], p[0] - q[0], q[1] - p[1]};
    };
    parallel_for(num_rows, kGrain, num_threads, [&] {
        return [&](std::int64_t begin, std::int64_t end) {
            for (std::int64_t i = begin; i < end; ++i) {
                const Seen own = see(i);
                std::int64_t found = 0;
                for (int view = 0; view < 2; ++view) {
                    for (std::int64_t e = crows[view][i]; e < crows[view][i + 1]; ++e) {
                        const Seen other = see(cols[view][e]);
                        const double way_x = std::abs(own.x - other.x), way_y = std::abs(own.y - other.y);
                        const double more = spread * (way_x + way_y);
                        found += (std::abs(own.row - other.row) <= row_px + more) &
                                 (std::abs(own.disparity - other.disparity) <= disparity_px + slope * way_x + more);
                    }
                }
                count[i] = found;
            }
        };
    });
}

}  // namespace tensor_stereo
