// Bindings of what is measured in images.
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <tuple>
#include <utility>
#include <vector>

#include "bindings.hpp"
#include "tensor_stereo/window_evidence.hpp"
#include "tensor_stereo/window_refine.hpp"
#include "tensor_stereo/window_search.hpp"

namespace bindings {
namespace {

using Image = nb::ndarray<nb::ro, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Floats = Input<float, nb::ndim<1>>;
using FloatPoints = Input<float, nb::shape<-1, 2>>;
using Flags = Input<bool, nb::ndim<1>>;

using Images = std::vector<Image>;

ts::GrayImage to_gray(const Image& image) {
    const bool is_float = image.dtype() == nb::dtype<float>();
    check(is_float || image.dtype() == nb::dtype<std::uint8_t>(), "images must be uint8 or float32");
    check(image.shape(0) > 0 && image.shape(1) > 0, "images must not be empty");
    ts::GrayImage gray;
    gray.levels = image.data();
    gray.is_float = is_float;
    gray.height = static_cast<std::int64_t>(image.shape(0));
    gray.width = static_cast<std::int64_t>(image.shape(1));
    return gray;
}

// Both views of pair b; `known1` is read where it is not rectified.
void set_views(ts::GrayImage (&view)[2], std::size_t b, const Images& images0, const Images& images1,
               const Images& known1, const FloatPoints& origin, const Floats& brighter, bool is_rectified) {
    view[0] = to_gray(images0[b]);
    view[1] = to_gray(images1[b]);
    view[1].brighter = brighter(b);
    if (is_rectified) return;
    const Image& known = known1[b];
    check(known.dtype() == nb::dtype<bool>() && known.shape(0) == images1[b].shape(0) &&
              known.shape(1) == images1[b].shape(1),
          "known1 must be maps of the size of images1");
    view[1].known = static_cast<const bool*>(known.data());
    view[1].origin[0] = origin(b, 0);
    view[1].origin[1] = origin(b, 1);
}

void check_vectors(int vectors) {
    check(vectors >= 0 && vectors <= 3 && ts::has_vectors(static_cast<ts::Vectors>(vectors)),
          "vectors must name instructions that this machine has");
}

nb::ndarray<nb::numpy, float, nb::ndim<3>> give_curve(ts::Buffer<float> values, std::size_t rows, std::size_t width) {
    float* const data = values.release();
    return {data, {rows, ts::kEvidenceCurves, width}, owner_of(data)};
}

auto window_evidence(const Images& images0, const Images& images1, const Images& known1, FloatPoints origin,
                     Floats brighter, FloatPoints left, FloatPoints right, FloatPoints along, Floats disparity,
                     Floats across, FloatPoints slope, Integers ptr, Integers first, Integers count, Flags has_rows,
                     Flags rectified, std::int64_t width, int num_threads, int vectors) {
    const std::size_t num_pairs = images0.size(), num_matches = left.shape(0);
    check(images1.size() == num_pairs && known1.size() == num_pairs && origin.shape(0) == num_pairs &&
              brighter.shape(0) == num_pairs && first.shape(0) == num_pairs && count.shape(0) == num_pairs &&
              has_rows.shape(0) == num_pairs && rectified.shape(0) == num_pairs && ptr.shape(0) == num_pairs + 1,
          "what is given for pairs must have one entry per pair");
    check(right.shape(0) == num_matches && along.shape(0) == num_matches && disparity.shape(0) == num_matches &&
              across.shape(0) == num_matches && slope.shape(0) == num_matches,
          "what is given for matches must have one entry per match");
    check_offsets(ptr, static_cast<std::int64_t>(num_matches), "ptr must rise from 0 to the number of matches");
    check_vectors(vectors);
    std::vector<ts::EvidencePair> pairs(num_pairs);
    for (std::size_t b = 0; b < num_pairs; ++b) {
        ts::EvidencePair& pair = pairs[b];
        set_views(pair.view, b, images0, images1, known1, origin, brighter, rectified(b));
        pair.first = first(b);
        pair.count = count(b);
        pair.has_rows = has_rows(b);
        pair.is_rectified = rectified(b);
        const bool is_empty = ptr(b) == ptr(b + 1);
        check(is_empty || (pair.count >= 1 && pair.count <= (pair.has_rows ? ts::kMaxSearched : ts::kMaxInDisc)),
              "count must be in 1..256, and at most 9 without rows");
        check(is_empty || pair.count <= width, "width must be at least every count");
    }
    auto values = ts::allocate<float>(num_matches * ts::kEvidenceValues);
    const std::size_t num_curve = num_matches * ts::kEvidenceCurves * static_cast<std::size_t>(width);
    auto curve0 = ts::allocate<float>(num_curve), curve1 = ts::allocate<float>(num_curve);
    auto start = ts::allocate<float>(num_matches), offset = ts::allocate<float>(num_matches);
    {
        const nb::gil_scoped_release release;
        ts::window_evidence(
            pairs.data(), static_cast<std::int64_t>(num_pairs),
            {ptr.data(), left.data(), right.data(), along.data(), disparity.data(), across.data(), slope.data()},
            num_threads, {values.get(), {curve0.get(), curve1.get()}, start.get(), offset.get(), width},
            static_cast<ts::Vectors>(vectors));
    }
    return std::tuple(give_rows<ts::kEvidenceValues>(std::move(values), num_matches),
                      give_curve(std::move(curve0), num_matches, static_cast<std::size_t>(width)),
                      give_curve(std::move(curve1), num_matches, static_cast<std::size_t>(width)),
                      give(std::move(start), num_matches), give(std::move(offset), num_matches));
}

auto window_search(const Images& images0, const Images& images1, const Images& known1, FloatPoints origin,
                   Floats brighter, FloatPoints points, FloatPoints along, Floats across,
                   Input<float, nb::ndim<2>> predicted, Integers ptr, Integers first, Integers count, Flags rectified,
                   float near_px, int num_threads, int vectors) {
    const std::size_t num_pairs = images0.size(), num_keypoints = points.shape(0);
    check(images1.size() == num_pairs && known1.size() == num_pairs && origin.shape(0) == num_pairs &&
              brighter.shape(0) == num_pairs && first.shape(0) == num_pairs && count.shape(0) == num_pairs &&
              rectified.shape(0) == num_pairs && ptr.shape(0) == num_pairs + 1,
          "what is given for pairs must have one entry per pair");
    check(along.shape(0) == num_keypoints && across.shape(0) == num_keypoints && predicted.shape(0) == num_keypoints,
          "what is given for keypoints must have one entry per keypoint");
    check_offsets(ptr, static_cast<std::int64_t>(num_keypoints), "ptr must rise from 0 to the number of keypoints");
    check_vectors(vectors);
    std::vector<ts::SearchPair> pairs(num_pairs);
    for (std::size_t b = 0; b < num_pairs; ++b) {
        set_views(pairs[b].view, b, images0, images1, known1, origin, brighter, rectified(b));
        pairs[b].first = first(b);
        pairs[b].count = count(b);
        pairs[b].is_rectified = rectified(b);
        check(ptr(b) == ptr(b + 1) || (count(b) >= 3 && count(b) <= 1 << 20), "count must be in 3..2**20");
    }
    auto disparity = ts::allocate<float>(num_keypoints);
    auto found = ts::allocate<bool>(num_keypoints);
    {
        const nb::gil_scoped_release release;
        ts::window_search(pairs.data(), static_cast<std::int64_t>(num_pairs),
                          {ptr.data(), points.data(), along.data(), across.data(), predicted.data(),
                           static_cast<std::int64_t>(predicted.shape(1))},
                          near_px, num_threads, disparity.get(), found.get(), static_cast<ts::Vectors>(vectors));
    }
    return std::tuple(give(std::move(disparity), num_keypoints), give(std::move(found), num_keypoints));
}

auto window_refine(const Images& images0, const Images& images1, const Images& known1, FloatPoints origin,
                   Floats brighter, FloatPoints left, FloatPoints right, FloatPoints along, Floats off_line,
                   FloatPoints slope, Integers ptr, Flags rectified, float max_shift, int num_threads, int vectors) {
    const std::size_t num_pairs = images0.size(), num_matches = left.shape(0);
    check(images1.size() == num_pairs && known1.size() == num_pairs && origin.shape(0) == num_pairs &&
              brighter.shape(0) == num_pairs && rectified.shape(0) == num_pairs && ptr.shape(0) == num_pairs + 1,
          "what is given for pairs must have one entry per pair");
    check(right.shape(0) == num_matches && along.shape(0) == num_matches && off_line.shape(0) == num_matches &&
              slope.shape(0) == num_matches,
          "what is given for matches must have one entry per match");
    check_offsets(ptr, static_cast<std::int64_t>(num_matches), "ptr must rise from 0 to the number of matches");
    check_vectors(vectors);
    std::vector<ts::RefinePair> pairs(num_pairs);
    for (std::size_t b = 0; b < num_pairs; ++b) {
        set_views(pairs[b].view, b, images0, images1, known1, origin, brighter, rectified(b));
        pairs[b].is_rectified = rectified(b);
    }
    auto shift = ts::allocate<float>(num_matches), across = ts::allocate<float>(num_matches),
         variance = ts::allocate<float>(num_matches);
    {
        const nb::gil_scoped_release release;
        ts::window_refine(pairs.data(), static_cast<std::int64_t>(num_pairs),
                          {ptr.data(), left.data(), right.data(), along.data(), off_line.data(), slope.data()},
                          max_shift, num_threads, {shift.get(), across.get(), variance.get()},
                          static_cast<ts::Vectors>(vectors));
    }
    return std::tuple(give(std::move(shift), num_matches), give(std::move(across), num_matches),
                      give(std::move(variance), num_matches));
}

}  // namespace

void bind_images(nb::module_& module) {
    module.def("window_evidence", &window_evidence, nb::arg("images0"), nb::arg("images1"), nb::arg("known1"),
               nb::arg("origin"), nb::arg("brighter"), nb::arg("left"), nb::arg("right"), nb::arg("along"),
               nb::arg("disparity"), nb::arg("across"), nb::arg("slope"), nb::arg("ptr"), nb::arg("first"),
               nb::arg("count"), nb::arg("has_rows"), nb::arg("rectified"), nb::arg("width"), nb::arg("num_threads"),
               nb::arg("vectors") = 0);
    module.def("window_search", &window_search, nb::arg("images0"), nb::arg("images1"), nb::arg("known1"),
               nb::arg("origin"), nb::arg("brighter"), nb::arg("points"), nb::arg("along"), nb::arg("across"),
               nb::arg("predicted"), nb::arg("ptr"), nb::arg("first"), nb::arg("count"), nb::arg("rectified"),
               nb::arg("near_px"), nb::arg("num_threads"), nb::arg("vectors") = 0);
    module.def("window_refine", &window_refine, nb::arg("images0"), nb::arg("images1"), nb::arg("known1"),
               nb::arg("origin"), nb::arg("brighter"), nb::arg("left"), nb::arg("right"), nb::arg("along"),
               nb::arg("off_line"), nb::arg("slope"), nb::arg("ptr"), nb::arg("rectified"), nb::arg("max_shift"),
               nb::arg("num_threads"), nb::arg("vectors") = 0);
}

}  // namespace bindings
