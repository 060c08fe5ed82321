// The points that bound the dual Voronoi edges of given links.
#pragma once

#include <cstdint>

#include "tensor_stereo/buffer.hpp"

namespace tensor_stereo {

// Critical points (num_links, 2) of links, which are two rows each, as in LinkGeometry but without reach: links
// link_ptr[s] to link_ptr[s + 1] join vertices of segment s.
Buffer<std::int64_t> dual_critical_points(const double* points, const std::int64_t* index, const std::int64_t* ptr,
                                          std::int64_t num_segments, const std::int64_t* links,
                                          const std::int64_t* link_ptr, int num_threads);

}  // namespace tensor_stereo
