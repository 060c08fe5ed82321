// The kernel as a compiler without vector types builds it, beside that of the library in one program.
#pragma once

#include <cstdint>

#include "tensor_stereo/consensus_belief.hpp"

namespace tensor_stereo {

void plain_consensus_belief(const ConsensusMatches& matches, const ConsensusSettings& settings, int num_threads,
                            double* belief);

}  // namespace tensor_stereo
