// The triangulation by divide and conquer.
#pragma once

#include "tensor_stereo/triangulation.hpp"

namespace tensor_stereo {

// Triangulates result.points, and orders them along the x axis; O(N log N) for every input.
void divide_and_conquer(Triangulation& result);

}  // namespace tensor_stereo
