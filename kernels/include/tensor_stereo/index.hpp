// Numbers of the vertices, half-edges and triangles of one segment.
#pragma once

#include <cstdint>

namespace tensor_stereo {

using Index = std::int32_t;
inline constexpr Index kNone = -1;
inline constexpr Index kBlocked = -2;  // of a link

}  // namespace tensor_stereo
