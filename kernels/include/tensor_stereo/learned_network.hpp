// The network of the learned score on the graphs of both views.
#pragma once

#include <cstdint>

#include "tensor_stereo/vectors.hpp"

namespace tensor_stereo {

namespace learned {

constexpr int kWidth = 24, kMessage = 12, kRounds = 3, kTolerances = 5;
constexpr int kNodes = 8, kCosts = 2, kEdges = 15, kOdd = 2, kRefined = 4, kCurves = 2;
constexpr int kEdgeImages = 2 * kCurves + 1 + kRefined, kPlanes = 9, kRefinedPlanes = kPlanes + kTolerances;
constexpr int kImages = 172;  // values of the evidence of the images

// Weights of a linear layer, (out, in) as torch keeps them, and its bias unless that is null.
struct Linear {
    const float* weight;
    const float* bias;
};

// By how much values are shifted and scaled before they are cut to four standard deviations.
struct Scale {
    const float* mean;
    const float* scale;
};

struct Round {
    Linear ends, edge, odd, edge_image, belief, mix, mix_refined, whole, out;
    Scale norm;  // weight and bias of the layer norm, in this order
};

struct Weights {
    Linear enter, enter_image, enter_image_out, enter_out, head, last, head_whole;
    Round rounds[kRounds];
    Scale nodes, cost, image, edges, edge_image;
};

}  // namespace learned

// M matches of B pairs, pair by pair, and their graphs in CSR form with rising columns.
struct LearnedInputs {
    const std::int64_t* ptr;  // (B + 1)
    const double* points[2];  // (M, 2) px, aligned
    const bool* has_rows;     // (B)
    const double* cost;       // (M); null: none
    const std::int64_t* crow[2];
    const std::int64_t* cols[2];
    // What the images say; null: nothing.
    const float* image;               // (M, kImages)
    const float* curve[2];            // (M, kCurves, width)
    const float* first;               // (M) px
    const std::int64_t* num_columns;  // (M)
    const float* offset;              // (M) px
    std::int64_t width;
};

// (M, kTolerances) logits. Throws std::bad_alloc.
void learned_network(const learned::Weights& weights, const LearnedInputs& inputs, std::int64_t num_pairs,
                     int num_threads, float* logits, Vectors vectors = Vectors::kBest);

}  // namespace tensor_stereo
