// Numbers of the vertices, half-edges and triangles of one segment.
#pragma once

#include <cstdint>

namespace tensor_stereo {

using Index = std::int32_t;
inline constexpr Index kNone = -1;

}  // namespace tensor_stereo
