// The only file that knows Python. Shapes are checked here; values are the business of the callers in tensor_stereo/ops.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <optional>
#include <stdexcept>
#include <tuple>
#include <utility>

#include "tensor_stereo/buffer.hpp"
#include "tensor_stereo/consensus_belief.hpp"
#include "tensor_stereo/delaunay_graph.hpp"
#include "tensor_stereo/dual_edge_ratio.hpp"
#include "tensor_stereo/gated_ssd.hpp"
#include "tensor_stereo/one_to_one.hpp"
#include "tensor_stereo/predicates.hpp"
#include "tensor_stereo/row_overlap.hpp"
#include "tensor_stereo/soft_counts.hpp"
#include "tensor_stereo/soft_match_graphs.hpp"

namespace nb = nanobind;
namespace ts = tensor_stereo;

namespace {

template <class T, class... Shape>
using Input = nb::ndarray<const T, Shape..., nb::c_contig, nb::device::cpu>;
using Points = Input<double, nb::shape<-1, 2>>;
using Pairs = Input<std::int64_t, nb::shape<-1, 2>>;
using Triples = Input<double, nb::shape<-1, 3>>;
using Flags = Input<bool, nb::ndim<1>>;
using Matrix = Input<float, nb::ndim<2>>;
using Integers = Input<std::int64_t, nb::ndim<1>>;
using Doubles = Input<double, nb::ndim<1>>;
template <class T>
using Output = nb::ndarray<nb::numpy, T, nb::ndim<1>>;

// What frees an array that NumPy holds.
nb::capsule owner_of(void* data) {
    return nb::capsule(data, [](void* memory) noexcept { ts::Free()(memory); });
}

template <class T>
Output<T> give(ts::Buffer<T> values, std::size_t size) {
    T* const data = values.release();
    return Output<T>(data, {size}, owner_of(data));
}

template <std::size_t kColumns, class T>
auto give_rows(ts::Buffer<T> values, std::size_t rows) {
    T* const data = values.release();
    return nb::ndarray<nb::numpy, T, nb::shape<-1, kColumns>>(data, {rows, kColumns}, owner_of(data));
}

void check(bool condition, const char* message) {
    if (!condition) throw std::invalid_argument(message);
}

void check_offsets(const Integers& ptr, std::int64_t total, const char* message) {
    const std::size_t size = ptr.shape(0);
    check(size >= 1 && ptr.data()[0] == 0 && ptr.data()[size - 1] == total, message);
    for (std::size_t k = 1; k < size; ++k) check(ptr.data()[k - 1] <= ptr.data()[k], message);
}

auto give_pattern(ts::SparsePattern graph) {
    const auto num_entries = static_cast<std::size_t>(graph.crow[graph.num_rows]);
    return std::pair(give(std::move(graph.crow), graph.num_rows + 1), give(std::move(graph.cols), num_entries));
}

void check_index(const Integers& index, std::int64_t num_points, const char* message = "index must name rows of points") {
    for (std::size_t k = 0; k < index.shape(0); ++k) {
        check(index.data()[k] >= 0 && index.data()[k] < num_points, message);
    }
}

auto delaunay_graph(Points points, Integers index, Integers ptr, double tie_tolerance, int num_threads) {
    const auto num_points = static_cast<std::int64_t>(points.shape(0));
    check_offsets(ptr, static_cast<std::int64_t>(index.shape(0)), "ptr must rise from 0 to the length of index");
    check_index(index, num_points);
    ts::SparsePattern graph;
    {
        const nb::gil_scoped_release release;
        graph = ts::delaunay_graph(points.data(), num_points, index.data(), ptr.data(),
                                   static_cast<std::int64_t>(ptr.shape(0)) - 1, tie_tolerance, num_threads);
    }
    return give_pattern(std::move(graph));
}

auto soft_match_graphs(Points points0, Points points1, Integers index, Integers ptr, double tie_tolerance,
                       double reach_edge_lengths, double reach_px, int num_threads) {
    const auto num_points = static_cast<std::int64_t>(points0.shape(0));
    check(points1.shape(0) == points0.shape(0), "points0 and points1 must have the same length");
    check_offsets(ptr, static_cast<std::int64_t>(index.shape(0)), "ptr must rise from 0 to the length of index");
    check_index(index, num_points);
    ts::SoftMatchGraphs found;
    {
        const nb::gil_scoped_release release;
        found = ts::soft_match_graphs(points0.data(), points1.data(), num_points, index.data(), ptr.data(),
                                      static_cast<std::int64_t>(ptr.shape(0)) - 1, tie_tolerance,
                                      {reach_edge_lengths, reach_px}, num_threads);
    }
    const auto num_pairs = static_cast<std::size_t>(found.num_pairs);
    return std::tuple(give_pattern(std::move(found.graph[0])), give_pattern(std::move(found.graph[1])),
                      give_rows<2>(std::move(found.pairs), num_pairs), give(std::move(found.pair_ptr), ptr.shape(0)),
                      give_rows<2>(std::move(found.view[0].critical), num_pairs),
                      give_rows<2>(std::move(found.view[1].critical), num_pairs),
                      give(std::move(found.view[0].is_edge), num_pairs),
                      give(std::move(found.view[1].is_edge), num_pairs));
}

auto dual_critical_points(Points points, Integers index, Integers ptr, Pairs pairs, Integers pair_ptr, int num_threads) {
    check_offsets(ptr, static_cast<std::int64_t>(index.shape(0)), "ptr must rise from 0 to the length of index");
    check_index(index, static_cast<std::int64_t>(points.shape(0)));
    const std::size_t num_pairs = pairs.shape(0);
    check(pair_ptr.shape(0) == ptr.shape(0), "pair_ptr and ptr must have the same length");
    check_offsets(pair_ptr, static_cast<std::int64_t>(num_pairs), "pair_ptr must rise from 0 to the length of pairs");
    ts::Buffer<std::int64_t> found;
    {
        const nb::gil_scoped_release release;
        found = ts::dual_critical_points(points.data(), index.data(), ptr.data(),
                                         static_cast<std::int64_t>(ptr.shape(0)) - 1, pairs.data(), pair_ptr.data(),
                                         num_threads);
    }
    return give_rows<2>(std::move(found), num_pairs);
}

void check_rows(const Pairs& rows, std::int64_t lowest, std::int64_t num_points, const char* message) {
    for (std::size_t k = 0; k < 2 * rows.shape(0); ++k) {
        check(rows.data()[k] >= lowest && rows.data()[k] < num_points, message);
    }
}

ts::DualEdges dual_edges(const Points& points, const Pairs& pairs, const Pairs& critical, double bound) {
    const auto num_points = static_cast<std::int64_t>(points.shape(0));
    check(critical.shape(0) == pairs.shape(0), "critical must have one row per pair");
    check_rows(pairs, 0, num_points, "pairs must name rows of points");
    check_rows(critical, ts::kBlocked, num_points, "critical must name rows of points, -1 or -2");
    return {points.data(), pairs.data(), critical.data(), bound};
}

ts::PairRanges pair_ranges(const Integers& ptr, const Pairs& pairs) {
    check_offsets(ptr, static_cast<std::int64_t>(pairs.shape(0)), "ptr must rise from 0 to the length of pairs");
    return {ptr.data(), static_cast<std::int64_t>(ptr.shape(0)) - 1};
}

ts::Buffer<double> zeros(std::size_t size) {
    auto values = ts::allocate<double>(size);
    std::fill_n(values.get(), size, 0.0);
    return values;
}

auto dual_edge_ratio(Points points, Pairs pairs, Pairs critical, Integers ptr, double bound, int num_threads) {
    const ts::DualEdges edges = dual_edges(points, pairs, critical, bound);
    const ts::PairRanges ranges = pair_ranges(ptr, pairs);
    auto ratio = ts::allocate<double>(pairs.shape(0));
    {
        const nb::gil_scoped_release release;
        ranges.each(num_threads, [&](std::int64_t, std::int64_t pair) { ratio[pair] = edges.ratio(pair); });
    }
    return give(std::move(ratio), pairs.shape(0));
}

auto dual_edge_ratio_backward(Points points, Pairs pairs, Pairs critical, Integers ptr, Doubles ratio_gradient,
                              double bound, int num_threads) {
    const ts::DualEdges edges = dual_edges(points, pairs, critical, bound);
    const ts::PairRanges ranges = pair_ranges(ptr, pairs);
    check(ratio_gradient.shape(0) == pairs.shape(0), "ratio_gradient must have one entry per pair");
    auto gradient = zeros(2 * points.shape(0));
    {
        const nb::gil_scoped_release release;
        ranges.each(num_threads, [&](std::int64_t, std::int64_t pair) {
            if (ratio_gradient.data()[pair] == 0) return;
            edges.add_ratio_gradient(pair, ratio_gradient.data()[pair], gradient.get());
        });
    }
    return give_rows<2>(std::move(gradient), points.shape(0));
}

ts::SoftViews soft_views(const Points& points0, const Points& points1, const Pairs& pairs, const Pairs& critical0,
                         const Pairs& critical1, const Flags& is_edge0, const Flags& is_edge1, const Integers& ptr,
                         double temperature, double saturation, bool in_px, double bound) {
    check(points0.shape(0) == points1.shape(0), "points0 and points1 must have the same length");
    check(is_edge0.shape(0) == pairs.shape(0) && is_edge1.shape(0) == pairs.shape(0), "is_edge must have one entry per pair");
    return {{dual_edges(points0, pairs, critical0, bound), dual_edges(points1, pairs, critical1, bound)},
            {is_edge0.data(), is_edge1.data()},
            pair_ranges(ptr, pairs),
            temperature,
            saturation,
            in_px};
}

auto soft_counts(Points points0, Points points1, Pairs pairs, Pairs critical0, Pairs critical1, Flags is_edge0,
                 Flags is_edge1, Integers ptr, double temperature, double saturation, bool in_px, double bound,
                 int num_threads) {
    const ts::SoftViews views = soft_views(points0, points1, pairs, critical0, critical1, is_edge0, is_edge1, ptr,
                                           temperature, saturation, in_px, bound);
    auto counts = zeros(3 * points0.shape(0));
    {
        const nb::gil_scoped_release release;
        ts::soft_counts(views, num_threads, counts.get());
    }
    return give_rows<3>(std::move(counts), points0.shape(0));
}

auto soft_counts_backward(Points points0, Points points1, Pairs pairs, Pairs critical0, Pairs critical1, Flags is_edge0,
                          Flags is_edge1, Integers ptr, Triples counts_gradient, double temperature, double saturation,
                          bool in_px, double bound, int num_threads) {
    const ts::SoftViews views = soft_views(points0, points1, pairs, critical0, critical1, is_edge0, is_edge1, ptr,
                                           temperature, saturation, in_px, bound);
    check(counts_gradient.shape(0) == points0.shape(0), "counts_gradient must have one row per point");
    auto gradient0 = zeros(2 * points0.shape(0)), gradient1 = zeros(2 * points0.shape(0));
    auto partial = zeros(views.ranges.count);
    {
        const nb::gil_scoped_release release;
        ts::soft_counts_backward(views, counts_gradient.data(), num_threads, gradient0.get(), gradient1.get(),
                                 partial.get());
    }
    double of_temperature = 0;
    for (std::int64_t range = 0; range < views.ranges.count; ++range) of_temperature += partial[range];
    return std::tuple(give_rows<2>(std::move(gradient0), points0.shape(0)),
                      give_rows<2>(std::move(gradient1), points0.shape(0)), of_temperature);
}

auto row_overlap(Integers crow0, Integers cols0, Integers crow1, Integers cols1, int num_threads) {
    check(crow0.shape(0) == crow1.shape(0), "crow0 and crow1 must have the same length");
    check_offsets(crow0, static_cast<std::int64_t>(cols0.shape(0)), "crow0 must rise from 0 to the length of cols0");
    check_offsets(crow1, static_cast<std::int64_t>(cols1.shape(0)), "crow1 must rise from 0 to the length of cols1");
    const std::size_t num_rows = crow0.shape(0) - 1;
    auto overlap = ts::allocate<std::int64_t>(num_rows), degree0 = ts::allocate<std::int64_t>(num_rows),
         degree1 = ts::allocate<std::int64_t>(num_rows);
    {
        const nb::gil_scoped_release release;
        ts::row_overlap(crow0.data(), cols0.data(), crow1.data(), cols1.data(), static_cast<std::int64_t>(num_rows),
                        num_threads, overlap.get(), degree0.get(), degree1.get());
    }
    return std::tuple(give(std::move(overlap), num_rows), give(std::move(degree0), num_rows),
                      give(std::move(degree1), num_rows));
}

auto consensus_belief(Points keypoints0, Points keypoints1, Integers ptr, std::optional<Doubles> cost, Integers crow0,
                      Integers cols0, Integers crow1, Integers cols1, double tolerance, double whole_tolerance,
                      std::optional<double> row_tolerance, double whole_row_tolerance, double slope, double reach,
                      double doubt, double cost_weight, int num_rounds, int num_threads) {
    const std::size_t num_matches = keypoints0.shape(0);
    const auto num_rows = static_cast<std::int64_t>(num_matches);
    check(keypoints1.shape(0) == num_matches, "keypoints0 and keypoints1 must have the same length");
    check(!cost || cost->shape(0) == num_matches, "cost must have one entry per match");
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
                              {crow0.data(), crow1.data()},
                              {cols0.data(), cols1.data()}},
                             {tolerance, whole_tolerance, row_tolerance, whole_row_tolerance, slope, reach, doubt,
                              cost_weight, num_rounds},
                             num_threads, belief.get());
    }
    return give(std::move(belief), num_matches);
}

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

std::int64_t first_point_out_of_range(Points points) {
    const nb::gil_scoped_release release;
    return ts::first_point_out_of_range(points.data(), static_cast<std::int64_t>(points.shape(0)));
}

auto gated_ssd(Points keypoints0, Points keypoints1, Matrix descriptors0, Matrix descriptors1, Integers ptr0,
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
        ts::gated_ssd({keypoints0.data(), descriptors0.data(), ptr0.data()},
                      {keypoints1.data(), descriptors1.data(), ptr1.data()},
                      static_cast<std::int64_t>(ptr0.shape(0)) - 1, static_cast<std::int64_t>(descriptors0.shape(1)),
                      {row_offset, min_disparity, max_disparity}, num_threads,
                      {cost.get(), index.get(), second_cost.get(), cost1.get(), index1.get()});
    }
    return std::tuple(give(std::move(cost), num0), give(std::move(index), num0), give(std::move(second_cost), num0),
                      give(std::move(cost1), num1), give(std::move(index1), num1));
}

ts::Point point(const Points& points, std::size_t k) { return {points.data()[2 * k], points.data()[2 * k + 1]}; }

auto orientation(Points a, Points b, Points c) {
    const std::size_t count = a.shape(0);
    check(b.shape(0) == count && c.shape(0) == count, "a, b and c must have the same length");
    auto signs = ts::allocate<std::int8_t>(count);
    for (std::size_t k = 0; k < count; ++k) {
        signs[k] = static_cast<std::int8_t>(ts::exact_orientation(point(a, k), point(b, k), point(c, k)));
    }
    return give(std::move(signs), count);
}

auto incircle(Points a, Points b, Points c, Points d) {
    const std::size_t count = a.shape(0);
    check(b.shape(0) == count && c.shape(0) == count && d.shape(0) == count, "a, b, c and d must have the same length");
    auto signs = ts::allocate<std::int8_t>(count);
    for (std::size_t k = 0; k < count; ++k) {
        signs[k] = static_cast<std::int8_t>(ts::exact_incircle(point(a, k), point(b, k), point(c, k), point(d, k)));
    }
    return give(std::move(signs), count);
}

}  // namespace

NB_MODULE(_kernels, module) {
    module.def("delaunay_graph", &delaunay_graph, nb::arg("points"), nb::arg("index"), nb::arg("ptr"),
               nb::arg("tie_tolerance"), nb::arg("num_threads"));
    module.def("soft_match_graphs", &soft_match_graphs, nb::arg("points0"), nb::arg("points1"), nb::arg("index"),
               nb::arg("ptr"), nb::arg("tie_tolerance"), nb::arg("reach_edge_lengths"), nb::arg("reach_px"),
               nb::arg("num_threads"));
    module.def("dual_critical_points", &dual_critical_points, nb::arg("points"), nb::arg("index"), nb::arg("ptr"),
               nb::arg("pairs"), nb::arg("pair_ptr"), nb::arg("num_threads"));
    module.def("dual_edge_ratio", &dual_edge_ratio, nb::arg("points"), nb::arg("pairs"), nb::arg("critical"),
               nb::arg("ptr"), nb::arg("bound"), nb::arg("num_threads"));
    module.def("dual_edge_ratio_backward", &dual_edge_ratio_backward, nb::arg("points"), nb::arg("pairs"),
               nb::arg("critical"), nb::arg("ptr"), nb::arg("ratio_gradient"), nb::arg("bound"), nb::arg("num_threads"));
    module.def("soft_counts", &soft_counts, nb::arg("points0"), nb::arg("points1"), nb::arg("pairs"),
               nb::arg("critical0"), nb::arg("critical1"), nb::arg("is_edge0"), nb::arg("is_edge1"), nb::arg("ptr"),
               nb::arg("temperature"), nb::arg("saturation"), nb::arg("in_px"), nb::arg("bound"),
               nb::arg("num_threads"));
    module.def("soft_counts_backward", &soft_counts_backward, nb::arg("points0"), nb::arg("points1"), nb::arg("pairs"),
               nb::arg("critical0"), nb::arg("critical1"), nb::arg("is_edge0"), nb::arg("is_edge1"), nb::arg("ptr"),
               nb::arg("counts_gradient"), nb::arg("temperature"), nb::arg("saturation"), nb::arg("in_px"),
               nb::arg("bound"), nb::arg("num_threads"));
    module.def("row_overlap", &row_overlap, nb::arg("crow0"), nb::arg("cols0"), nb::arg("crow1"), nb::arg("cols1"),
               nb::arg("num_threads"));
    module.def("consensus_belief", &consensus_belief, nb::arg("keypoints0"), nb::arg("keypoints1"), nb::arg("ptr"),
               nb::arg("cost").none(), nb::arg("crow0"), nb::arg("cols0"), nb::arg("crow1"), nb::arg("cols1"),
               nb::arg("tolerance"), nb::arg("whole_tolerance"), nb::arg("row_tolerance").none(),
               nb::arg("whole_row_tolerance"), nb::arg("slope"), nb::arg("reach"), nb::arg("doubt"),
               nb::arg("cost_weight"), nb::arg("num_rounds"), nb::arg("num_threads"));
    module.def("relate", &relate, nb::arg("overlap"), nb::arg("degree0"), nb::arg("degree1"), nb::arg("group_size"),
               nb::arg("min_group_size"), nb::arg("accept_subsets"));
    module.def("one_to_one", &one_to_one, nb::arg("points0"), nb::arg("points1"), nb::arg("ptr"),
               nb::arg("cost").none(), nb::arg("num_threads"));
    module.def("first_point_out_of_range", &first_point_out_of_range, nb::arg("points"));
    module.def("gated_ssd", &gated_ssd, nb::arg("keypoints0"), nb::arg("keypoints1"), nb::arg("descriptors0"),
               nb::arg("descriptors1"), nb::arg("ptr0"), nb::arg("ptr1"), nb::arg("row_offset"),
               nb::arg("min_disparity"), nb::arg("max_disparity"), nb::arg("num_threads"));
    module.def("orientation", &orientation, nb::arg("a"), nb::arg("b"), nb::arg("c"));
    module.def("incircle", &incircle, nb::arg("a"), nb::arg("b"), nb::arg("c"), nb::arg("d"));
}
