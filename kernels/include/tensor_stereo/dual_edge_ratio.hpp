// Signed lengths of dual Voronoi edges and their gradient.
#pragma once

#include <cstdint>

namespace tensor_stereo {

// Pairs of rows of points with their critical points, as soft_match_graphs gives them. Pairs of different ranges of ptr
// share no point.
struct DualEdges {
    const double* points;          // (num_points, 2)
    const std::int64_t* pairs;     // (num_pairs, 2)
    const std::int64_t* critical;  // (num_pairs, 2)
    const std::int64_t* ptr;       // (num_ranges + 1)
    std::int64_t num_ranges;
    double bound;  // each end is clipped to so many edge lengths from the midpoint
};

// ratio: (num_pairs), in lengths of the pair; -2 bound where the pair is blocked.
void dual_edge_ratio(const DualEdges& edges, int num_threads, double* ratio);

// Adds to gradient (num_points, 2) what flows through the ends that are not clipped.
void dual_edge_ratio_backward(const DualEdges& edges, const double* ratio_gradient, int num_threads, double* gradient);

}  // namespace tensor_stereo
