// How the neighbour sets of matches in both views relate.
#pragma once

#include <cstdint>

namespace tensor_stereo {

// How the neighbour sets N0, N1 of a match relate; the values of tensor_stereo.Relation.
enum Relation : std::int8_t { kUntested, kEqual, kSubset, kSuperset, kConflict };

// From |N0 & N1|, |N0|, |N1| and the number of distinct matches in the group, (count) each, 0 for duplicates: relation,
// kUntested below min_group_size or if a set is empty though the group has other matches; inlier for kEqual and, with
// accept_subsets, for kSubset and kSuperset.
void relate(const std::int64_t* overlap, const std::int64_t* degree0, const std::int64_t* degree1,
            const std::int64_t* group_size, std::int64_t count, std::int64_t min_group_size, bool accept_subsets,
            std::int8_t* relation, bool* inlier);

}  // namespace tensor_stereo
