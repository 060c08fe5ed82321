// Tests of the kernels without Python: laws that hold for every input, and the circle definition on small integer sets.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <random>
#include <set>
#include <utility>
#include <vector>

#include "expect.hpp"
#include "tensor_stereo/delaunay_graph.hpp"
#include "tensor_stereo/gated_ssd.hpp"
#include "tensor_stereo/one_to_one.hpp"
#include "tensor_stereo/predicates.hpp"
#include "tensor_stereo/row_overlap.hpp"
#include "tensor_stereo/soft_counts.hpp"
#include "tensor_stereo/soft_match_graphs.hpp"
#include "tensor_stereo/triangulation.hpp"

namespace ts = tensor_stereo;

// In test_consensus_belief.cpp.
void test_consensus_believes_matches_that_agree();
void test_consensus_without_neighbours_is_zero();
void test_consensus_does_not_depend_on_threads_or_batches();

namespace {

using Rng = std::mt19937_64;
using Edges = std::set<std::pair<std::int64_t, std::int64_t>>;

std::vector<ts::Point> distinct(std::vector<ts::Point> points) {
    const auto less = [](ts::Point a, ts::Point b) { return a.x < b.x || (a.x == b.x && a.y < b.y); };
    std::sort(points.begin(), points.end(), less);
    const auto same = [](ts::Point a, ts::Point b) { return a.x == b.x && a.y == b.y; };
    points.erase(std::unique(points.begin(), points.end(), same), points.end());
    return points;
}

std::vector<ts::Point> random_integers(Rng& rng, int count, int range) {
    std::uniform_int_distribution<int> coordinate(-range, range);
    std::vector<ts::Point> points(count);
    for (auto& p : points) p = {static_cast<double>(coordinate(rng)), static_cast<double>(coordinate(rng))};
    return distinct(points);
}

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
            if (is_free && (lower.empty() || upper.empty() ||
                            *std::max_element(lower.begin(), lower.end()) < *std::min_element(upper.begin(), upper.end()))) {
                edges.insert({i, j});
            }
        }
    }
    return edges;
}

void test_predicates_are_exact() {
    const ts::Point o{0, 0}, p{1, 1};
    EXPECT(ts::exact_orientation(o, p, {3, 3}) == 0);
    EXPECT(ts::exact_orientation(o, p, {3, std::nextafter(3.0, 4.0)}) == 1);
    EXPECT(ts::exact_orientation(o, p, {3, std::nextafter(3.0, 2.0)}) == -1);
    const double tenth = 0.1;  // corners of a rectangle share their coordinates, so they are co-circular in any rounding
    EXPECT(ts::exact_incircle({0, 0}, {3 * tenth, 0}, {3 * tenth, 7 * tenth}, {0, 7 * tenth}) == 0);
    EXPECT(ts::exact_incircle({0, 0}, {1, 0}, {1, 1}, {0, std::nextafter(1.0, 0.0)}) == 1);
    EXPECT(ts::exact_incircle({0, 0}, {1, 0}, {1, 1}, {0, std::nextafter(1.0, 2.0)}) == -1);
    EXPECT(ts::exact_incircle({0, 0}, {1e-60, 0}, {1e-60, 1e-60}, {0, 1e-60}) == 0);
    EXPECT(ts::exact_incircle({0, 0}, {1e60, 0}, {1e60, 1e60}, {1e-60, 1e60}) == 1);
}

void test_bounds_agree_with_exact_signs() {
    Rng rng(1);
    for (const int range : {2, 30, 4000}) {
        for (const double scale : {1.0, 0.1, 1e-3}) {
            auto points = random_integers(rng, 200, range);
            for (auto& p : points) p = {p.x * scale, p.y * scale};
            double side = 0;
            for (const auto& p : points) {
                for (const auto& q : points) side = std::max({side, p.x - q.x, p.y - q.y});
            }
            const auto bounds = ts::determinant_bounds(points.data(), points.size(), side);
            std::uniform_int_distribution<std::size_t> any(0, points.size() - 1);
            for (int k = 0; k < 2000; ++k) {
                const auto a = points[any(rng)], b = points[any(rng)], c = points[any(rng)], d = points[any(rng)];
                EXPECT(ts::orientation(a, b, c, bounds) == ts::exact_orientation(a, b, c));
                EXPECT(ts::incircle(a, b, c, d, bounds) == ts::exact_incircle(a, b, c, d));
            }
        }
    }
}

void test_graph_is_the_circle_definition() {
    Rng rng(2);
    for (int k = 0; k < 3000; ++k) {
        auto points = random_integers(rng, 1 + k % 9, k % 2 ? 2 : 10);
        std::shuffle(points.begin(), points.end(), rng);
        EXPECT(graph(points, 0) == circle_graph(points));
    }
}

void test_divide_and_conquer_gives_the_same_graph() {
    Rng rng(3);
    std::uniform_real_distribution<double> unit(0, 1);
    for (int k = 0; k < 40; ++k) {
        std::vector<ts::Point> points = k % 2 ? random_integers(rng, 400, 15) : std::vector<ts::Point>(400);
        if (k % 2 == 0) {
            for (auto& p : points) p = {unit(rng), unit(rng)};
        }
        std::vector<double> values;
        std::vector<std::int64_t> index;
        for (const auto p : points) {
            index.push_back(static_cast<std::int64_t>(index.size()));
            values.insert(values.end(), {p.x, p.y});
        }
        ts::Triangulation sweep;
        ts::Workspace workspace;
        ts::triangulate(values.data(), index.data(), points.size(), sweep, workspace);
        ts::Triangulation divided = sweep;
        ts::divide_and_conquer(divided);
        // Triangulations may differ in the diagonals of co-circular polygons; strict edges may not.
        const auto strict = [](const ts::Triangulation& mesh) {
            Edges edges;
            for (std::size_t h = 0; h < mesh.origin.size(); ++h) {
                const auto half = static_cast<ts::Index>(h);
                const auto at = [&](ts::Index e) { return mesh.points[mesh.origin[e]]; };
                const ts::Index twin = mesh.twin[h];
                const ts::Index next = ts::next_in_triangle(half), last = ts::previous_in_triangle(half);
                if (twin == ts::kNone ||
                    ts::exact_incircle(at(half), at(next), at(last), at(ts::previous_in_triangle(twin))) < 0) {
                    edges.insert(std::minmax(mesh.vertex[mesh.origin[h]], mesh.vertex[mesh.origin[next]]));
                }
            }
            return edges;
        };
        EXPECT(strict(sweep) == strict(divided));
        EXPECT(sweep.origin.size() == divided.origin.size());
    }
}

void test_degenerate_and_adversarial_inputs_end() {
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

void test_row_overlap_counts_shared_columns() {
    const std::int64_t crow0[] = {0, 3, 3, 4}, cols0[] = {0, 2, 5, 1}, crow1[] = {0, 2, 3, 4}, cols1[] = {2, 5, 0, 0};
    std::int64_t overlap[3], degree0[3], degree1[3];
    for (const int num_threads : {1, 4}) {
        ts::row_overlap(crow0, cols0, crow1, cols1, 3, num_threads, overlap, degree0, degree1);
        EXPECT(overlap[0] == 2 && overlap[1] == 0 && overlap[2] == 0);
        EXPECT(degree0[0] == 3 && degree0[1] == 0 && degree1[1] == 1);
        const std::int64_t group_size[] = {3, 3, 0};
        std::int8_t relation[3];
        bool inlier[3];
        ts::relate(overlap, degree0, degree1, group_size, 3, 1, true, relation, inlier);
        EXPECT(relation[0] == ts::kSuperset && relation[1] == ts::kUntested && relation[2] == ts::kUntested);
        EXPECT(inlier[0] && !inlier[1] && !inlier[2]);
    }
}

void test_one_to_one_is_greedy_by_cost() {
    const double left[] = {0, 0, 0, -0.0, 5, 1}, right[] = {0, 0, 1, 3, 5, 1}, cost[] = {2, 1, 1};
    const std::int64_t ptr[] = {0, 3};
    bool kept[3];
    ts::one_to_one(left, right, ptr, 1, nullptr, 1, kept);
    EXPECT(kept[0] && !kept[1] && kept[2]);
    ts::one_to_one(left, right, ptr, 1, cost, 2, kept);
    EXPECT(!kept[0] && kept[1] && kept[2]);
    const double bad[] = {0, 1, 2, std::nan(""), 1e61, 0};
    EXPECT(ts::first_point_out_of_range(bad, 3) == 1);
    EXPECT(ts::first_point_out_of_range(left, 3) == -1);
}

void test_gated_ssd_takes_the_lowest_index_of_equals() {
    const double keypoints0[] = {10, 5, 10, 9}, keypoints1[] = {8, 5, 9, 5, 9, 6.5, 3, 5};
    const float descriptors0[] = {1, 2, 7, 7}, descriptors1[] = {1, 3, 2, 2, 1, 2, 1, 2};
    const std::int64_t ptr0[] = {0, 2}, ptr1[] = {0, 4};
    float cost[2], second[2], cost1[4];
    std::int64_t index[2], index1[4];
    ts::gated_ssd({keypoints0, descriptors0, ptr0}, {keypoints1, descriptors1, ptr1}, 1, 2, {1, 0, 5}, 1,
                  {cost, index, second, cost1, index1});
    EXPECT(cost[0] == 1 && index[0] == 0 && second[0] == 1);
    EXPECT(std::isinf(cost[1]) && index[1] == -1);
    EXPECT(index1[0] == 0 && index1[1] == 0 && index1[2] == -1 && index1[3] == -1);
}

// Two views of the same points, of which some are moved, in segments of 20.
struct SoftSample {
    std::vector<double> points[2];
    std::vector<std::int64_t> index, ptr{0};

    SoftSample(Rng& rng, int num_segments, int range) {
        for (int s = 0; s < num_segments; ++s) {
            auto points0 = random_integers(rng, 20, range);
            std::shuffle(points0.begin(), points0.end(), rng);
            auto points1 = points0;
            std::shuffle(points1.begin(), points1.begin() + static_cast<std::ptrdiff_t>(points1.size() / 2), rng);
            for (std::size_t k = 0; k < points0.size(); ++k) {
                points[0].insert(points[0].end(), {points0[k].x, points0[k].y});
                points[1].insert(points[1].end(), {points1[k].x, points1[k].y});
                index.push_back(static_cast<std::int64_t>(index.size()));
            }
            ptr.push_back(static_cast<std::int64_t>(index.size()));
        }
    }

    std::int64_t count() const { return static_cast<std::int64_t>(index.size()); }

    ts::SoftMatchGraphs build(ts::Reach reach, int num_threads) const {
        return ts::soft_match_graphs(points[0].data(), points[1].data(), count(), index.data(), ptr.data(),
                                     static_cast<std::int64_t>(ptr.size()) - 1, 1e-3, reach, num_threads);
    }

    ts::SoftViews views(const ts::SoftMatchGraphs& found, double temperature, bool in_px) const {
        const auto edges = [&](int v) {
            return ts::DualEdges{points[v].data(), found.pairs.get(), found.view[v].critical.get(), 1e3};
        };
        return {{edges(0), edges(1)},
                {found.view[0].is_edge.get(), found.view[1].is_edge.get()},
                {found.pair_ptr.get(), static_cast<std::int64_t>(ptr.size()) - 1},
                temperature,
                40,
                in_px};
    }
};

void test_critical_points_leave_their_side_of_the_circle_empty() {
    Rng rng(4);
    for (const int range : {2, 5, 300}) {
        const SoftSample sample(rng, 30, range);
        const auto found = sample.build({1e9, 0}, 1);
        for (int v = 0; v < 2; ++v) {
            const double* const values = sample.points[v].data();
            const auto point = [values](std::int64_t row) { return ts::Point{values[2 * row], values[2 * row + 1]}; };
            for (std::size_t s = 0; s + 1 < sample.ptr.size(); ++s) {
                for (std::int64_t e = found.pair_ptr[s]; e < found.pair_ptr[s + 1]; ++e) {
                    const std::int64_t i = found.pairs[2 * e], j = found.pairs[2 * e + 1];
                    for (int side = 0; side < 2; ++side) {
                        const std::int64_t best = found.view[v].critical[2 * e + side];
                        if (best == ts::kBlocked) continue;
                        const auto a = side == 1 ? i : j, b = side == 1 ? j : i;  // the side on the left of a -> b
                        for (std::int64_t k = sample.ptr[s]; k < sample.ptr[s + 1]; ++k) {
                            if (k == i || k == j || ts::exact_orientation(point(a), point(b), point(k)) <= 0) continue;
                            EXPECT(best != ts::kNone);
                            EXPECT(ts::exact_incircle(point(a), point(b), point(best), point(k)) <= 0);
                        }
                    }
                }
            }
        }
    }
}

void test_soft_match_graphs_do_not_depend_on_threads() {
    Rng rng(5);
    const SoftSample sample(rng, 40, 6);
    const auto one = sample.build({4, 0}, 1), many = sample.build({4, 0}, 4);
    EXPECT(one.num_pairs == many.num_pairs);
    EXPECT(std::equal(one.pairs.get(), one.pairs.get() + 2 * one.num_pairs, many.pairs.get()));
    for (int v = 0; v < 2; ++v) {
        const auto* const critical = one.view[v].critical.get();
        EXPECT(std::equal(critical, critical + 2 * one.num_pairs, many.view[v].critical.get()));
    }
}

void test_gradient_of_soft_counts_is_that_of_finite_differences() {
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
        std::vector<double> gradient[2] = {std::vector<double>(2 * n, 0.0), std::vector<double>(2 * n, 0.0)}, partial(3, 0.0);
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
                EXPECT(std::fabs((above - below) / (2 * step) - gradient[v][k]) < 1e-6 * (1 + std::fabs(gradient[v][k])));
            }
        }
        const double of_temperature = partial[0] + partial[1] + partial[2];
        const double difference = (loss(temperature + step) - loss(temperature - step)) / (2 * step);
        EXPECT(std::fabs(difference - of_temperature) < 1e-6 * (1 + std::fabs(of_temperature)));
    }
}

}  // namespace

int main() {
    const std::pair<const char*, std::function<void()>> tests[] = {
        {"predicates are exact", test_predicates_are_exact},
        {"bounds agree with exact signs", test_bounds_agree_with_exact_signs},
        {"graph is the circle definition", test_graph_is_the_circle_definition},
        {"divide and conquer gives the same graph", test_divide_and_conquer_gives_the_same_graph},
        {"degenerate and adversarial inputs end", test_degenerate_and_adversarial_inputs_end},
        {"row overlap counts shared columns", test_row_overlap_counts_shared_columns},
        {"one-to-one is greedy by cost", test_one_to_one_is_greedy_by_cost},
        {"critical points leave their side of the circle empty", test_critical_points_leave_their_side_of_the_circle_empty},
        {"soft match graphs do not depend on threads", test_soft_match_graphs_do_not_depend_on_threads},
        {"gradient of soft counts", test_gradient_of_soft_counts_is_that_of_finite_differences},
        {"consensus believes matches that agree", test_consensus_believes_matches_that_agree},
        {"consensus without neighbours is zero", test_consensus_without_neighbours_is_zero},
        {"consensus does not depend on threads or batches", test_consensus_does_not_depend_on_threads_or_batches},
        {"gated SSD takes the lowest index of equals", test_gated_ssd_takes_the_lowest_index_of_equals},
    };
    for (const auto& [name, test] : tests) {
        const int before = failures;
        test();
        std::printf("%s %s\n", failures == before ? "ok    " : "FAILED", name);
    }
    return failures == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}
