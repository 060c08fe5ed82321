#include "plain_consensus_belief.hpp"

#include <type_traits>

#define TENSOR_STEREO_PLAIN_VECTORS
#define consensus_belief plain_consensus_belief
#include "../src/consensus_belief.cpp"

static_assert(std::is_class_v<tensor_stereo::Vector2>);
