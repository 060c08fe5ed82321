// Bindings of soft sizes of neighbour sets, and of the dual lengths behind them.
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <tuple>
#include <utility>

#include "bindings.hpp"
#include "tensor_stereo/critical_points.hpp"
#include "tensor_stereo/dual_edge_ratio.hpp"
#include "tensor_stereo/soft_counts.hpp"

namespace bindings {
namespace {

using Triples = Input<double, nb::shape<-1, 3>>;
using Flags = Input<bool, nb::ndim<1>>;

void check_rows(const RowsOfTwo& rows, std::int64_t lowest, std::int64_t num_points, const char* message) {
    for (std::size_t k = 0; k < 2 * rows.shape(0); ++k) {
        check(rows.data()[k] >= lowest && rows.data()[k] < num_points, message);
    }
}

ts::DualEdges dual_edges(const Points& points, const RowsOfTwo& links, const RowsOfTwo& critical, double bound) {
    const auto num_points = static_cast<std::int64_t>(points.shape(0));
    check(critical.shape(0) == links.shape(0), "critical must have one row per pair");
    check_rows(links, 0, num_points, "pairs must name rows of points");
    check_rows(critical, ts::kBlocked, num_points, "critical must name rows of points, -1 or -2");
    return {points.data(), links.data(), critical.data(), bound};
}

ts::LinkRanges link_ranges(const Integers& ptr, const RowsOfTwo& links) {
    check_offsets(ptr, static_cast<std::int64_t>(links.shape(0)), "ptr must rise from 0 to the length of pairs");
    return {ptr.data(), static_cast<std::int64_t>(ptr.shape(0)) - 1};
}

ts::Buffer<double> zeros(std::size_t size) {
    auto values = ts::allocate<double>(size);
    std::fill_n(values.get(), size, 0.0);
    return values;
}

auto dual_edge_ratio(Points points, RowsOfTwo links, RowsOfTwo critical, Integers ptr, double bound, int num_threads) {
    const ts::DualEdges edges = dual_edges(points, links, critical, bound);
    const ts::LinkRanges ranges = link_ranges(ptr, links);
    auto ratio = ts::allocate<double>(links.shape(0));
    {
        const nb::gil_scoped_release release;
        ranges.each(num_threads, [&](std::int64_t, std::int64_t link) { ratio[link] = edges.ratio(link); });
    }
    return give(std::move(ratio), links.shape(0));
}

auto dual_edge_ratio_backward(Points points, RowsOfTwo links, RowsOfTwo critical, Integers ptr, Doubles ratio_gradient,
                              double bound, int num_threads) {
    const ts::DualEdges edges = dual_edges(points, links, critical, bound);
    const ts::LinkRanges ranges = link_ranges(ptr, links);
    check(ratio_gradient.shape(0) == links.shape(0), "ratio_gradient must have one entry per pair");
    auto gradient = zeros(2 * points.shape(0));
    {
        const nb::gil_scoped_release release;
        ranges.each(num_threads, [&](std::int64_t, std::int64_t link) {
            if (ratio_gradient.data()[link] == 0) return;
            edges.add_ratio_gradient(link, ratio_gradient.data()[link], gradient.get());
        });
    }
    return give_rows<2>(std::move(gradient), points.shape(0));
}

ts::SoftViews soft_views(const Points& points0, const Points& points1, const RowsOfTwo& links,
                         const RowsOfTwo& critical0, const RowsOfTwo& critical1, const Flags& is_edge0,
                         const Flags& is_edge1, const Integers& ptr, double temperature, double saturation, bool in_px,
                         double bound) {
    check(points0.shape(0) == points1.shape(0), "points0 and points1 must have the same length");
    check(is_edge0.shape(0) == links.shape(0) && is_edge1.shape(0) == links.shape(0),
          "is_edge must have one entry per pair");
    return {{dual_edges(points0, links, critical0, bound), dual_edges(points1, links, critical1, bound)},
            {is_edge0.data(), is_edge1.data()},
            link_ranges(ptr, links),
            temperature,
            saturation,
            in_px};
}

auto soft_counts(Points points0, Points points1, RowsOfTwo links, RowsOfTwo critical0, RowsOfTwo critical1,
                 Flags is_edge0, Flags is_edge1, Integers ptr, double temperature, double saturation, bool in_px,
                 double bound, int num_threads) {
    const ts::SoftViews views = soft_views(points0, points1, links, critical0, critical1, is_edge0, is_edge1, ptr,
                                           temperature, saturation, in_px, bound);
    auto counts = zeros(3 * points0.shape(0));
    {
        const nb::gil_scoped_release release;
        ts::soft_counts(views, num_threads, counts.get());
    }
    return give_rows<3>(std::move(counts), points0.shape(0));
}

auto soft_counts_backward(Points points0, Points points1, RowsOfTwo links, RowsOfTwo critical0, RowsOfTwo critical1,
                          Flags is_edge0, Flags is_edge1, Integers ptr, Triples counts_gradient, double temperature,
                          double saturation, bool in_px, double bound, int num_threads) {
    const ts::SoftViews views = soft_views(points0, points1, links, critical0, critical1, is_edge0, is_edge1, ptr,
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

}  // namespace

// Python calls links `pairs`.
void bind_soft(nb::module_& module) {
    module.def("dual_edge_ratio", &dual_edge_ratio, nb::arg("points"), nb::arg("pairs"), nb::arg("critical"),
               nb::arg("ptr"), nb::arg("bound"), nb::arg("num_threads"));
    module.def("dual_edge_ratio_backward", &dual_edge_ratio_backward, nb::arg("points"), nb::arg("pairs"),
               nb::arg("critical"), nb::arg("ptr"), nb::arg("ratio_gradient"), nb::arg("bound"),
               nb::arg("num_threads"));
    module.def("soft_counts", &soft_counts, nb::arg("points0"), nb::arg("points1"), nb::arg("pairs"),
               nb::arg("critical0"), nb::arg("critical1"), nb::arg("is_edge0"), nb::arg("is_edge1"), nb::arg("ptr"),
               nb::arg("temperature"), nb::arg("saturation"), nb::arg("in_px"), nb::arg("bound"),
               nb::arg("num_threads"));
    module.def("soft_counts_backward", &soft_counts_backward, nb::arg("points0"), nb::arg("points1"), nb::arg("pairs"),
               nb::arg("critical0"), nb::arg("critical1"), nb::arg("is_edge0"), nb::arg("is_edge1"), nb::arg("ptr"),
               nb::arg("counts_gradient"), nb::arg("temperature"), nb::arg("saturation"), nb::arg("in_px"),
               nb::arg("bound"), nb::arg("num_threads"));
}

}  // namespace bindings
