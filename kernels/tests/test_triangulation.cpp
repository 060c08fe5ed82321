#include <algorithm>
#include <cstdint>
#include <random>
#include <set>
#include <utility>
#include <vector>

#include "divide_and_conquer.hpp"
#include "expect.hpp"
#include "samples.hpp"
#include "sweep_hull.hpp"
#include "tensor_stereo/triangulation.hpp"

namespace ts = tensor_stereo;

using Edges = std::set<std::pair<ts::Index, ts::Index>>;

TEST(divide_and_conquer_gives_the_same_graph) {
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
