// Bindings of what is found and said about matches.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <optional>
#include <tuple>
#include <utility>

#include "bindings.hpp"
#include "tensor_stereo/agreeing_neighbors.hpp"
#include "tensor_stereo/consensus_belief.hpp"
#include "tensor_stereo/nearest_ssd.hpp"
#include "tensor_stereo/one_to_one.hpp"
#include "tensor_stereo/relate.hpp"

namespace bindings {
namespace {

using Matrix = Input<float, nb::ndim<2>>;

auto relate(Integers overlap, Integers degree0, Integers degree1, Integers group_size, std::int64_t min_group_size,
            bool accept_subsets) {
    const std::size_t count = overlap.shape(0);
    check(degree0.shape(0) == count && degree1.shape(0) == count && group_size.shape(0) == count,
          "overlap, degree0, degree1 and group_size must have the same length");
    auto relation = ts::allocate<std::int8_t>(count);
    auto inlier = ts::allocate<bool>(count);
    {
        const nb::gil_scoped_release release;
        ts::relate(overlap.data(), degree0.data(), degree1.data(), group_size.data(), static_cast<std::int64_t>(count),
                   min_group_size, accept_subsets, relation.get(), inlier.get());
    }
    return std::tuple(give(std::move(relation), count), give(std::move(inlier), count));
}

auto consensus_belief(Points keypoints0, Points keypoints1, Integers ptr, std::optional<Doubles> cost,
                      std::optional<Doubles> row_offset, std::optional<Points> found1, Integers crow0, Integers cols0,
                      Integers crow1, Integers cols1, double tolerance, double whole_tolerance, double row_tolerance,
                      double whole_row_tolerance, double slope, double reach, double doubt, double cost_weight,
                      int num_rounds, int num_threads) {
    const std::size_t num_matches = keypoints0.shape(0);
    const auto num_rows = static_cast<std::int64_t>(num_matches);
    check(keypoints1.shape(0) == num_matches, "keypoints0 and keypoints1 must have the same length");
    check(!cost || cost->shape(0) == num_matches, "cost must have one entry per match");
    check(!row_offset || row_offset->shape(0) == num_matches, "row_offset must have one entry per match");
    check(!found1 || found1->shape(0) == num_matches, "found1 must have one row per match");
    check_offsets(ptr, num_rows, "ptr must rise from 0 to the number of matches");
    check(crow0.shape(0) == num_matches + 1 && crow1.shape(0) == num_matches + 1, "crow must have one row per match");
    check_offsets(crow0, static_cast<std::int64_t>(cols0.shape(0)), "crow0 must rise from 0 to the length of cols0");
    check_offsets(crow1, static_cast<std::int64_t>(cols1.shape(0)), "crow1 must rise from 0 to the length of cols1");
    check_index(cols0, num_rows, "cols0 must name matches");
    check_index(cols1, num_rows, "cols1 must name matches");
    check(num_rounds >= 0, "num_rounds must not be negative");
    auto belief = ts::allocate<double>(num_matches);
    {
        const nb::gil_scoped_release release;
        ts::consensus_belief({{keypoints0.data(), keypoints1.data()},
                              ptr.data(),
                              static_cast<std::int64_t>(ptr.shape(0)) - 1,
                              cost ? cost->data() : nullptr,
                              row_offset ? row_offset->data() : nullptr,
                              {keypoints0.data(), (found1 ? *found1 : keypoints1).data()},
                              {crow0.data(), crow1.data()},
                              {cols0.data(), cols1.data()}},
                             {tolerance, whole_tolerance, row_tolerance, whole_row_tolerance, slope, reach, doubt,
                              cost_weight, num_rounds},
                             num_threads, belief.get());
    }
    return give(std::move(belief), num_matches);
}

auto agreeing_neighbors(Points points0, Points points1, Integers crow0, Integers cols0, Integers crow1, Integers cols1,
                        double row_px, double disparity_px, double slope, double spread, int num_threads) {
    const std::size_t num_matches = points0.shape(0);
    const auto num_rows = static_cast<std::int64_t>(num_matches);
    check(points1.shape(0) == num_matches, "keypoints0 and keypoints1 must have the same length");
    check(crow0.shape(0) == num_matches + 1 && crow1.shape(0) == num_matches + 1, "crow must have one row per match");
    check_offsets(crow0, static_cast<std::int64_t>(cols0.shape(0)), "crow0 must rise from 0 to the length of cols0");
    check_offsets(crow1, static_cast<std::int64_t>(cols1.shape(0)), "crow1 must rise from 0 to the length of cols1");
    check_index(cols0, num_rows, "cols0 must name matches");
    check_index(cols1, num_rows, "cols1 must name matches");
    auto count = ts::allocate<std::int64_t>(num_matches);
    {
        const nb::gil_scoped_release release;
        ts::agreeing_neighbors(points0.data(), points1.data(), crow0.data(), cols0.data(), crow1.data(), cols1.data(),
                               num_rows, row_px, disparity_px, slope, spread, num_threads, count.get());
    }
    return give(std::move(count), num_matches);
}

auto one_to_one(Points points0, Points points1, Integers ptr, std::optional<Doubles> cost, int num_threads) {
    const std::size_t num_matches = points0.shape(0);
    check(points1.shape(0) == num_matches, "points0 and points1 must have the same length");
    check(!cost || cost->shape(0) == num_matches, "cost must have one entry per match");
    check_offsets(ptr, static_cast<std::int64_t>(num_matches), "ptr must rise from 0 to the number of matches");
    auto kept = ts::allocate<bool>(num_matches);
    {
        const nb::gil_scoped_release release;
        ts::one_to_one(points0.data(), points1.data(), ptr.data(), static_cast<std::int64_t>(ptr.shape(0)) - 1,
                       cost ? cost->data() : nullptr, num_threads, kept.get());
    }
    return give(std::move(kept), num_matches);
}

auto nearest_ssd(Points keypoints0, Points keypoints1, Matrix descriptors0, Matrix descriptors1, Integers ptr0,
                 Integers ptr1, double row_offset, double min_disparity, double max_disparity, int num_threads) {
    const std::size_t num0 = keypoints0.shape(0), num1 = keypoints1.shape(0);
    check(descriptors0.shape(0) == num0 && descriptors1.shape(0) == num1, "descriptors must have one row per keypoint");
    check(descriptors0.shape(1) == descriptors1.shape(1), "descriptors of both views must have one length");
    check(ptr0.shape(0) == ptr1.shape(0), "ptr0 and ptr1 must have the same length");
    check_offsets(ptr0, static_cast<std::int64_t>(num0), "ptr0 must rise from 0 to the number of keypoints");
    check_offsets(ptr1, static_cast<std::int64_t>(num1), "ptr1 must rise from 0 to the number of keypoints");
    auto cost = ts::allocate<float>(num0), second_cost = ts::allocate<float>(num0), cost1 = ts::allocate<float>(num1);
    auto index = ts::allocate<std::int64_t>(num0), index1 = ts::allocate<std::int64_t>(num1);
    {
        const nb::gil_scoped_release release;
        ts::nearest_ssd({keypoints0.data(), descriptors0.data(), ptr0.data()},
                        {keypoints1.data(), descriptors1.data(), ptr1.data()},
                        static_cast<std::int64_t>(ptr0.shape(0)) - 1, static_cast<std::int64_t>(descriptors0.shape(1)),
                        {row_offset, min_disparity, max_disparity}, num_threads, ts::Vectors::kBest,
                        {cost.get(), index.get(), second_cost.get(), cost1.get(), index1.get()});
    }
    return std::tuple(give(std::move(cost), num0), give(std::move(index), num0), give(std::move(second_cost), num0),
                      give(std::move(cost1), num1), give(std::move(index1), num1));
}

}  // namespace

void bind_matches(nb::module_& module) {
    module.def("relate", &relate, nb::arg("overlap"), nb::arg("degree0"), nb::arg("degree1"), nb::arg("group_size"),
               nb::arg("min_group_size"), nb::arg("accept_subsets"));
    module.def("consensus_belief", &consensus_belief, nb::arg("keypoints0"), nb::arg("keypoints1"), nb::arg("ptr"),
               nb::arg("cost").none(), nb::arg("row_offset").none(), nb::arg("found1").none(), nb::arg("crow0"),
               nb::arg("cols0"), nb::arg("crow1"), nb::arg("cols1"), nb::arg("tolerance"), nb::arg("whole_tolerance"),
               nb::arg("row_tolerance"), nb::arg("whole_row_tolerance"), nb::arg("slope"), nb::arg("reach"),
               nb::arg("doubt"), nb::arg("cost_weight"), nb::arg("num_rounds"), nb::arg("num_threads"));
    module.def("agreeing_neighbors", &agreeing_neighbors, nb::arg("points0"), nb::arg("points1"), nb::arg("crow0"),
               nb::arg("cols0"), nb::arg("crow1"), nb::arg("cols1"), nb::arg("row_px"), nb::arg("disparity_px"),
               nb::arg("slope"), nb::arg("spread"), nb::arg("num_threads"));
    module.def("one_to_one", &one_to_one, nb::arg("points0"), nb::arg("points1"), nb::arg("ptr"),
               nb::arg("cost").none(), nb::arg("num_threads"));
    module.def("nearest_ssd", &nearest_ssd, nb::arg("keypoints0"), nb::arg("keypoints1"), nb::arg("descriptors0"),
               nb::arg("descriptors1"), nb::arg("ptr0"), nb::arg("ptr1"), nb::arg("row_offset"),
               nb::arg("min_disparity"), nb::arg("max_disparity"), nb::arg("num_threads"));
}

}  // namespace bindings
