// Bindings of graphs over points.
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>

#include <tuple>
#include <utility>

#include "bindings.hpp"
#include "tensor_stereo/delaunay_graph.hpp"
#include "tensor_stereo/dual_critical_points.hpp"
#include "tensor_stereo/first_point_out_of_range.hpp"
#include "tensor_stereo/predicates.hpp"
#include "tensor_stereo/row_overlap.hpp"
#include "tensor_stereo/soft_match_graphs.hpp"

namespace bindings {
namespace {

auto give_pattern(ts::SparsePattern graph) {
    const auto num_entries = static_cast<std::size_t>(graph.crow[graph.num_rows]);
    return std::pair(give(std::move(graph.crow), graph.num_rows + 1), give(std::move(graph.cols), num_entries));
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
    const auto num_links = static_cast<std::size_t>(found.num_links);
    return std::tuple(give_pattern(std::move(found.graph[0])), give_pattern(std::move(found.graph[1])),
                      give_rows<2>(std::move(found.links), num_links), give(std::move(found.link_ptr), ptr.shape(0)),
                      give_rows<2>(std::move(found.view[0].critical), num_links),
                      give_rows<2>(std::move(found.view[1].critical), num_links),
                      give(std::move(found.view[0].is_edge), num_links),
                      give(std::move(found.view[1].is_edge), num_links));
}

auto dual_critical_points(Points points, Integers index, Integers ptr, RowsOfTwo links, Integers link_ptr,
                          int num_threads) {
    check_offsets(ptr, static_cast<std::int64_t>(index.shape(0)), "ptr must rise from 0 to the length of index");
    check_index(index, static_cast<std::int64_t>(points.shape(0)));
    const std::size_t num_links = links.shape(0);
    check(link_ptr.shape(0) == ptr.shape(0), "pair_ptr and ptr must have the same length");
    check_offsets(link_ptr, static_cast<std::int64_t>(num_links), "pair_ptr must rise from 0 to the length of pairs");
    ts::Buffer<std::int64_t> found;
    {
        const nb::gil_scoped_release release;
        found = ts::dual_critical_points(points.data(), index.data(), ptr.data(),
                                         static_cast<std::int64_t>(ptr.shape(0)) - 1, links.data(), link_ptr.data(),
                                         num_threads);
    }
    return give_rows<2>(std::move(found), num_links);
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

std::int64_t first_point_out_of_range(Points points) {
    const nb::gil_scoped_release release;
    return ts::first_point_out_of_range(points.data(), static_cast<std::int64_t>(points.shape(0)));
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

// Python calls links `pairs`, and their offsets `pair_ptr`.
void bind_graphs(nb::module_& module) {
    module.def("delaunay_graph", &delaunay_graph, nb::arg("points"), nb::arg("index"), nb::arg("ptr"),
               nb::arg("tie_tolerance"), nb::arg("num_threads"));
    module.def("soft_match_graphs", &soft_match_graphs, nb::arg("points0"), nb::arg("points1"), nb::arg("index"),
               nb::arg("ptr"), nb::arg("tie_tolerance"), nb::arg("reach_edge_lengths"), nb::arg("reach_px"),
               nb::arg("num_threads"));
    module.def("dual_critical_points", &dual_critical_points, nb::arg("points"), nb::arg("index"), nb::arg("ptr"),
               nb::arg("pairs"), nb::arg("pair_ptr"), nb::arg("num_threads"));
    module.def("row_overlap", &row_overlap, nb::arg("crow0"), nb::arg("cols0"), nb::arg("crow1"), nb::arg("cols1"),
               nb::arg("num_threads"));
    module.def("first_point_out_of_range", &first_point_out_of_range, nb::arg("points"));
    module.def("orientation", &orientation, nb::arg("a"), nb::arg("b"), nb::arg("c"));
    module.def("incircle", &incircle, nb::arg("a"), nb::arg("b"), nb::arg("c"), nb::arg("d"));
}

}  // namespace bindings
