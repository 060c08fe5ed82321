// How likely every match is right, by how far its neighbours in both views agree with its displacement.
#pragma once

#include <cstdint>

namespace tensor_stereo {

// A batch of pairs and the graphs of both views over its matches.
struct ConsensusMatches {
    const double* keypoints[2];  // (ptr[num_pairs], 2) px
    const std::int64_t* ptr;     // (num_pairs + 1) offsets
    std::int64_t num_pairs;
    const double* cost;           // one per match, or null
    const double* row_offset;     // one per match: how far it lies off its row, px; or null: that is no evidence
    const double* found[2];       // (ptr[num_pairs], 2) px, the keypoints whose grid counts
    const std::int64_t* crow[2];  // one more than matches; offsets
    const std::int64_t* cols[2];  // rows of the neighbours
};

// See tensor_stereo.configs.ConsensusConfig.
struct ConsensusSettings {
    double tolerance, whole_tolerance;
    double row_tolerance, whole_row_tolerance, slope, reach, doubt, cost_weight;
    int num_rounds;
};

// belief: one per match. All sums run in the order of the reference, over the matches of a pair or over the neighbours
// in view 0, then in view 1: only transcendental functions may differ from it in the last bits. Throws std::bad_alloc.
void consensus_belief(const ConsensusMatches& matches, const ConsensusSettings& settings, int num_threads,
                      double* belief);

}  // namespace tensor_stereo
