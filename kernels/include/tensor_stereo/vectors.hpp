// Which vector instructions a kernel may use.
#pragma once

namespace tensor_stereo {

// All give the same bits.
enum class Vectors { kBest, kBaseline, kAvx2, kAvx512 };

// Whether this machine has them.
bool has_vectors(Vectors vectors);

}  // namespace tensor_stereo
