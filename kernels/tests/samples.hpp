// Random points for tests.
#pragma once

#include <algorithm>
#include <random>
#include <vector>

#include "tensor_stereo/predicates.hpp"

using Rng = std::mt19937_64;

inline std::vector<tensor_stereo::Point> distinct(std::vector<tensor_stereo::Point> points) {
    const auto less = [](tensor_stereo::Point a, tensor_stereo::Point b) {
        return a.x < b.x || (a.x == b.x && a.y < b.y);
    };
    std::sort(points.begin(), points.end(), less);
    const auto same = [](tensor_stereo::Point a, tensor_stereo::Point b) { return a.x == b.x && a.y == b.y; };
    points.erase(std::unique(points.begin(), points.end(), same), points.end());
    return points;
}

// Fewer than count if points repeat.
inline std::vector<tensor_stereo::Point> random_integers(Rng& rng, int count, int range) {
    std::uniform_int_distribution<int> coordinate(-range, range);
    std::vector<tensor_stereo::Point> points(count);
    for (auto& p : points) p = {static_cast<double>(coordinate(rng)), static_cast<double>(coordinate(rng))};
    return distinct(points);
}
