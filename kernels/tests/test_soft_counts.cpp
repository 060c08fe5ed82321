#include <cmath>
#include <cstddef>
#include <vector>

#include "expect.hpp"
#include "soft_sample.hpp"
#include "tensor_stereo/soft_counts.hpp"

namespace ts = tensor_stereo;

TEST(gradient_of_soft_counts_is_that_of_finite_differences) {
    Rng rng(6);
    for (const bool in_px : {false, true}) {
        SoftSample sample(rng, 3, 1000);
        const auto found = sample.build({16, 0}, 1);
        const auto n = static_cast<std::size_t>(sample.count());
        std::vector<double> weights(3 * n);
        for (std::size_t k = 0; k < weights.size(); ++k) weights[k] = std::sin(static_cast<double>(k));
        const auto loss = [&](double temperature) {
            std::vector<double> counts(3 * n, 0.0);
            ts::soft_counts(sample.views(found, temperature, in_px), 2, counts.data());
            double sum = 0;
            for (std::size_t k = 0; k < counts.size(); ++k) sum += weights[k] * counts[k];
            return sum;
        };
        const double temperature = in_px ? 150 : 1;
        std::vector<double> gradient[2] = {std::vector<double>(2 * n, 0.0), std::vector<double>(2 * n, 0.0)};
        std::vector<double> partial(3, 0.0);
        ts::soft_counts_backward(sample.views(found, temperature, in_px), weights.data(), 2, gradient[0].data(),
                                 gradient[1].data(), partial.data());
        const double step = 1e-4;
        for (int v = 0; v < 2; ++v) {
            for (std::size_t k = 0; k < 2 * n; k += 7) {
                const double before = sample.points[v][k];
                sample.points[v][k] = before + step;
                const double above = loss(temperature);
                sample.points[v][k] = before - step;
                const double below = loss(temperature);
                sample.points[v][k] = before;
                EXPECT(std::fabs((above - below) / (2 * step) - gradient[v][k]) <
                       1e-6 * (1 + std::fabs(gradient[v][k])));
            }
        }
        const double of_temperature = partial[0] + partial[1] + partial[2];
        const double difference = (loss(temperature + step) - loss(temperature - step)) / (2 * step);
        EXPECT(std::fabs(difference - of_temperature) < 1e-6 * (1 + std::fabs(of_temperature)));
    }
}
