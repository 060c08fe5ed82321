#include "tensor_stereo/soft_counts.hpp"

#include <algorithm>
#include <cmath>

namespace tensor_stereo {
namespace {

constexpr double kTie = 1e-9;  // adjacencies closer than that share their gradient

struct Adjacency {
    double value;     // of the sigmoid
    double slope;     // of the value by the dual length in units of the temperature
    double exponent;  // the argument of the sigmoid
    double ratio;     // dual length in lengths of the link
    double length;    // of the link if in px, else 1
};

inline Adjacency adjacency(const SoftViews& views, int v, std::int64_t link) noexcept {
    const DualEdges& edges = views.view[v];
    Adjacency result{0, 0, 0, edges.ratio(link), 1};
    if (views.in_px) {
        const Point i = edges.first(link), j = edges.second(link);
        result.length = std::sqrt((j.x - i.x) * (j.x - i.x) + (j.y - i.y) * (j.y - i.y));
    }
    const double size = std::fabs(result.ratio * result.length) / views.temperature;
    const double signed_size = views.is_edge[v][link] ? size : -size;
    result.exponent = std::min(std::max(signed_size, -views.saturation), views.saturation);
    result.value = 1 / (1 + std::exp(-result.exponent));
    result.slope = size <= views.saturation ? result.value * (1 - result.value) : 0;
    return result;
}

// How much of the gradient of min(own, other) goes to own: half where both agree but for rounding.
inline double share_of_minimum(double own, double other) noexcept {
    return std::min(std::max(0.5 + (other - own) / (2 * kTie), 0.0), 1.0);
}

}  // namespace

void soft_counts(const SoftViews& views, int num_threads, double* counts) {
    const std::int64_t* const links = views.view[0].links;
    views.ranges.each(num_threads, [&](std::int64_t, std::int64_t link) {
        const double a = adjacency(views, 0, link).value, b = adjacency(views, 1, link).value, shared = std::min(a, b);
        for (int end = 0; end < 2; ++end) {
            double* const row = counts + 3 * links[2 * link + end];
            row[0] += shared;
            row[1] += a;
            row[2] += b;
        }
    });
}

void soft_counts_backward(const SoftViews& views, const double* counts_gradient, int num_threads, double* gradient0,
                          double* gradient1, double* temperature_gradient) {
    const std::int64_t* const links = views.view[0].links;
    double* const gradients[] = {gradient0, gradient1};
    views.ranges.each(num_threads, [&](std::int64_t range, std::int64_t link) {
        const double* const of_i = counts_gradient + 3 * links[2 * link];
        const double* const of_j = counts_gradient + 3 * links[2 * link + 1];
        const Adjacency both[] = {adjacency(views, 0, link), adjacency(views, 1, link)};
        for (int v = 0; v < 2; ++v) {
            const Adjacency& own = both[v];
            if (own.slope == 0) continue;
            const double other = both[1 - v].value, share = share_of_minimum(own.value, other);
            const double of_value = share * (of_i[0] + of_j[0]) + of_i[1 + v] + of_j[1 + v];
            const double of_exponent = of_value * own.slope;
            if (of_exponent == 0) continue;
            temperature_gradient[range] -= of_exponent * own.exponent / views.temperature;
            const double of_length = of_exponent / views.temperature;  // of the dual length
            views.view[v].add_ratio_gradient(link, of_length * own.length, gradients[v]);
            if (!views.in_px || own.length == 0) continue;  // points that have moved onto each other have no direction
            const Point i = views.view[v].first(link), j = views.view[v].second(link);
            const double scale = of_length * own.ratio / own.length;
            DualEdges::add(gradients[v], links[2 * link + 1], scale * (j.x - i.x), scale * (j.y - i.y));
            DualEdges::add(gradients[v], links[2 * link], -scale * (j.x - i.x), -scale * (j.y - i.y));
        }
    });
}

}  // namespace tensor_stereo
