#include "tensor_stereo/relate.hpp"

namespace tensor_stereo {

void relate(const std::int64_t* overlap, const std::int64_t* degree0, const std::int64_t* degree1,
            const std::int64_t* group_size, std::int64_t count, std::int64_t min_group_size, bool accept_subsets,
            std::int8_t* relation, bool* inlier) {
    constexpr std::int8_t kTable[] = {kConflict, kSubset, kSuperset, kEqual};
    const std::int8_t last = accept_subsets ? kSuperset : kEqual;
    for (std::int64_t k = 0; k < count; ++k) {
        const bool within0 = overlap[k] == degree0[k], within1 = overlap[k] == degree1[k];
        const bool has_evidence = (degree0[k] > 0 && degree1[k] > 0) || group_size[k] == 1;
        const bool is_tested = group_size[k] >= min_group_size && group_size[k] > 0 && has_evidence;
        relation[k] = is_tested ? kTable[within0 + 2 * within1] : static_cast<std::int8_t>(kUntested);
        inlier[k] = relation[k] >= kEqual && relation[k] <= last;
    }
}

}  // namespace tensor_stereo
