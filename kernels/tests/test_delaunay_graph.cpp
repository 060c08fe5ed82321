#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>
#include <set>
#include <utility>
#include <vector>

#include "expect.hpp"
#include "samples.hpp"
#include "tensor_stereo/delaunay_graph.hpp"

namespace ts = tensor_stereo;

namespace {

using Edges = std::set<std::pair<std::int64_t, std::int64_t>>;

Edges graph(const std::vector<ts::Point>& points, double tie_tolerance, int num_threads = 1) {
    std::vector<double> values;
    std::vector<std::int64_t> index;
    for (const auto p : points) {
        index.push_back(static_cast<std::int64_t>(index.size()));
        values.insert(values.end(), {p.x, p.y});
    }
    const auto count = static_cast<std::int64_t>(points.size());
    const std::int64_t ptr[] = {0, count};
    const auto pattern = ts::delaunay_graph(values.data(), count, index.data(), ptr, 1, tie_tolerance, num_threads);
    Edges edges;
    for (std::int64_t row = 0; row < count; ++row) {
        for (std::int64_t k = pattern.crow[row]; k < pattern.crow[row + 1]; ++k) {
            EXPECT(k == pattern.crow[row] || pattern.cols[k - 1] < pattern.cols[k]);
            edges.insert({row, pattern.cols[k]});
        }
    }
    for (const auto& [i, j] : edges) EXPECT(i != j && edges.contains({j, i}));
    return edges;
}

// {i, j} is an edge iff some circle through both has every other point strictly outside. For integers up to 10 all
// products fit in 64 bits: bounds on the centre's position along the bisector are compared as fractions.
Edges circle_graph(const std::vector<ts::Point>& points) {
    struct Fraction {
        std::int64_t numerator, denominator;  // denominator > 0
        bool operator<(const Fraction& o) const { return numerator * o.denominator < o.numerator * denominator; }
    };
    Edges edges;
    const int n = static_cast<int>(points.size());
    for (int i = 0; i < n; ++i) {
        for (int j = 0; j < n; ++j) {
            if (i == j) continue;
            std::vector<Fraction> lower, upper;
            bool is_free = true;
            const auto ax = static_cast<std::int64_t>(points[i].x), ay = static_cast<std::int64_t>(points[i].y);
            const auto bx = static_cast<std::int64_t>(points[j].x), by = static_cast<std::int64_t>(points[j].y);
            for (int k = 0; k < n; ++k) {
                if (k == i || k == j) continue;
                // Twice the vector from k to the midpoint; slope and offset are scaled by 4.
                const auto mx = ax + bx - 2 * static_cast<std::int64_t>(points[k].x);
                const auto my = ay + by - 2 * static_cast<std::int64_t>(points[k].y);
                const auto slope = 4 * ((ay - by) * mx + (bx - ax) * my);
                const auto offset = mx * mx + my * my - (bx - ax) * (bx - ax) - (by - ay) * (by - ay);
                if (slope == 0) is_free = is_free && offset > 0;
                if (slope > 0) lower.push_back({-offset, slope});
                if (slope < 0) upper.push_back({offset, -slope});
            }
            if (is_free &&
                (lower.empty() || upper.empty() ||
                 *std::max_element(lower.begin(), lower.end()) < *std::min_element(upper.begin(), upper.end()))) {
                edges.insert({i, j});
            }
        }
    }
    return edges;
}

}  // namespace

TEST(graph_is_the_circle_definition) {
    Rng rng(2);
    for (int k = 0; k < 3000; ++k) {
        auto points = random_integers(rng, 1 + k % 9, k % 2 ? 2 : 10);
        std::shuffle(points.begin(), points.end(), rng);
        EXPECT(graph(points, 0) == circle_graph(points));
    }
}

TEST(degenerate_and_adversarial_inputs_end) {
    std::vector<ts::Point> line, parabola, circle;
    constexpr int kCount = 4000;
    for (int k = 0; k < kCount; ++k) {
        const double x = -1 + 2.0 * k / kCount;
        line.push_back({x, 0.3 * x + 0.1});
        parabola.push_back(k % 2 ? ts::Point{x, x * x + 1} : ts::Point{x, 0});
        circle.push_back({std::cos(7.0 * k), std::sin(7.0 * k)});
    }
    for (const auto& points : {line, parabola, circle}) {
        EXPECT(graph(points, 1e-3).size() >= 2 * (points.size() - 1));
        const auto exact = graph(points, 0), tolerant = graph(points, 1e-3);
        EXPECT(std::includes(exact.begin(), exact.end(), tolerant.begin(), tolerant.end()));
    }
    EXPECT(graph({}, 1e-3).empty());
    EXPECT(graph({{1, 2}}, 1e-3).empty());
    EXPECT(graph({{1, 2}, {3, 4}}, 1e-3).size() == 2);
}
