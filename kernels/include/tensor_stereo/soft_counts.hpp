// Soft sizes of the neighbour sets of matches and their gradient.
#pragma once

#include <cstdint>

#include "tensor_stereo/dual_edge_ratio.hpp"

namespace tensor_stereo {

// Both views of a batch of matches, as soft_match_graphs gives them. The adjacency of a link is the sigmoid of its
// signed dual length over the temperature, cut at +-saturation; its sign is that of the hard graph.
struct SoftViews {
    DualEdges view[2];
    const bool* is_edge[2];  // (num_links)
    LinkRanges ranges;
    double temperature, saturation;
    bool in_px;  // the temperature, not in lengths of the link
};

// counts: (num_points, 3), zero before: sums over the links of each match of the lesser adjacency and of either.
void soft_counts(const SoftViews& views, int num_threads, double* counts);

// From the gradient of counts, those of both point sets (num_points, 2 each, zero before) and of the temperature: one
// partial sum a range.
void soft_counts_backward(const SoftViews& views, const double* counts_gradient, int num_threads, double* gradient0,
                          double* gradient1, double* temperature_gradient);

}  // namespace tensor_stereo
