#include <cstdint>
#include <limits>
#include <random>
#include <vector>

#include "expect.hpp"
#include "samples.hpp"
#include "segment_graph.hpp"
#include "tensor_stereo/critical_points.hpp"

namespace ts = tensor_stereo;

TEST(a_search_finds_what_a_walk_finds) {
    Rng rng(21);
    std::uniform_real_distribution<double> unit(0, 1);
    const ts::Reach unlimited{std::numeric_limits<double>::infinity(), 0}, near{2, 0};
    long num_found = 0, num_blocked = 0;
    for (int k = 0; k < 36; ++k) {
        std::vector<ts::Point> points = random_integers(rng, 45, k % 2 ? 4 : 60);
        if (k % 3 == 0) {  // two curves that face each other
            points.clear();
            for (int i = 0; i < 30; ++i) {
                const double x = 100 * unit(rng);
                points.push_back(i % 2 ? ts::Point{x, 20 + x * x / 400} : ts::Point{x, k % 2 ? 0.0 : -x * x / 900});
            }
            points = distinct(points);
        }
        const double offset = k % 5 == 0 ? 16000000 : 0;
        std::vector<double> values;
        std::vector<std::int64_t> index;
        for (const auto p : points) {
            index.push_back(static_cast<std::int64_t>(index.size()));
            values.insert(values.end(), {p.x + offset, p.y});
        }
        const auto count = static_cast<ts::Index>(index.size());
        ts::SegmentGraph graph(values.data(), 0);
        std::vector<ts::Index> degree(index.size()), neighbors(6 * index.size());
        graph.build(index.data(), index.size(), degree.data(), neighbors.data());
        for (const ts::Reach reach : {unlimited, near}) {
            ts::CriticalPoints walk(reach), search(reach, 0);
            walk.prepare(graph.mesh(), graph.edges());
            search.prepare(graph.mesh(), graph.edges());
            for (ts::Index i = 0; i < count; ++i) {
                for (ts::Index j = 0; j < count; ++j) {
                    if (i == j) continue;
                    const ts::Critical a = walk.find(i, j), b = search.find(i, j);
                    EXPECT(a.left == b.left && a.right == b.right && a.is_edge == b.is_edge);
                    ++(a.left == ts::kBlocked ? num_blocked : num_found);
                }
            }
        }
    }
    EXPECT(num_found > 1000 && num_blocked > 1000);
}
