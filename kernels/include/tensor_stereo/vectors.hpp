// Which vector instructions a kernel may use.
#pragma once

namespace tensor_stereo {

// All give the same bits, but for the last digits of the learned network.
enum class Vectors { kBest, kBaseline, kAvx2, kAvx512 };

// Whether this machine has them.
bool has_vectors(Vectors vectors);

}  // namespace tensor_stereo
