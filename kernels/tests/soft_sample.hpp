// Matches for tests of soft consistency.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "samples.hpp"
#include "tensor_stereo/soft_counts.hpp"
#include "tensor_stereo/soft_match_graphs.hpp"

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

    tensor_stereo::SoftMatchGraphs build(tensor_stereo::Reach reach, int num_threads) const {
        return tensor_stereo::soft_match_graphs(points[0].data(), points[1].data(), count(), index.data(), ptr.data(),
                                                static_cast<std::int64_t>(ptr.size()) - 1, 1e-3, reach, num_threads);
    }

    tensor_stereo::SoftViews views(const tensor_stereo::SoftMatchGraphs& found, double temperature, bool in_px) const {
        const auto edges = [&](int v) {
            return tensor_stereo::DualEdges{points[v].data(), found.links.get(), found.view[v].critical.get(), 1e3};
        };
        return {{edges(0), edges(1)},
                {found.view[0].is_edge.get(), found.view[1].is_edge.get()},
                {found.link_ptr.get(), static_cast<std::int64_t>(ptr.size()) - 1},
                temperature,
                40,
                in_px};
    }
};
