// Which point on one side of a segment sees it under the largest angle, by a tree of boxes.
#pragma once

#include <vector>

#include "tensor_stereo/index.hpp"
#include "tensor_stereo/predicates.hpp"

namespace tensor_stereo {

// Exact, and much faster than all points one by one where these lie in long rows that no walk through their
// triangulation leaves soon. Points outside the circle through the ends and the best so far are passed over by boxes.
class PointSearch {
   public:
    // The points must live on and stay as they are.
    void build(const std::vector<Point>& points, const Bounds& bounds);

    // Of the points on the left of i -> j the one that sees it under the largest angle, of several the
    // lexicographically first; kNone: no point on the left; kBlocked: a point lies between i and j, or the dual of some
    // point on the left ends below `enough`, beyond doubt.
    Index find_left(Index i, Index j, double enough);

   private:
    static constexpr Index kLeaf = 8;

    struct Box {
        Point low, high;
        Index begin, end;  // of order_
        Index right;       // the second child, after whose first the node itself stands; kNone: a leaf
    };

    struct Query;

    Index build_node(Index begin, Index end);
    bool look(Query& query, Index node) const;

    const Point* points_ = nullptr;
    Bounds bounds_;
    std::vector<Index> order_;
    std::vector<Box> nodes_;
};

}  // namespace tensor_stereo
