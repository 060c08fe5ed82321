// Binding of the network of the learned score.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <optional>
#include <tuple>
#include <utility>

#include "bindings.hpp"
#include "tensor_stereo/learned_network.hpp"

namespace bindings {
namespace {

using Floats = Input<float, nb::ndim<1>>;
using Table = Input<float, nb::ndim<2>>;
using Curves = Input<float, nb::ndim<3>>;
using Flags = Input<bool, nb::ndim<1>>;

// Reads weights one after the other from an array.
class Reader {
   public:
    explicit Reader(const Floats& values) : next_(values.data()), end_(next_ + values.shape(0)) {}

    const float* take(std::ptrdiff_t size) {
        check(end_ - next_ >= size, "weights must be those of the network of this library");
        return std::exchange(next_, next_ + size);
    }
    ts::learned::Scale scale(int size) {
        const float* const mean = take(size);
        return {mean, take(size)};
    }
    ts::learned::Linear linear(int in, int out, bool has_bias = true) {
        const float* const weight = take(static_cast<std::ptrdiff_t>(in) * out);
        return {weight, has_bias ? take(out) : nullptr};
    }
    void check_end() const { check(next_ == end_, "weights must be those of the network of this library"); }

   private:
    const float* next_;
    const float* end_;
};

// The order of pack_weights in scores/learned_native.py.
ts::learned::Weights read_weights(const Floats& values) {
    using namespace ts::learned;
    Reader reader(values);
    Weights weights;
    weights.nodes = reader.scale(kNodes);
    weights.cost = reader.scale(kCosts);
    weights.image = reader.scale(kImages);
    weights.edges = reader.scale(kEdges);
    weights.edge_image = reader.scale(kEdgeImages);
    weights.enter = reader.linear(kNodes + kCosts + 2, kWidth);
    weights.enter_image = reader.linear(kImages, kWidth);
    weights.enter_image_out = reader.linear(kWidth, kWidth, false);
    weights.enter_out = reader.linear(kWidth, kWidth);
    for (int r = 0; r < kRounds; ++r) {
        const bool has_plane = r > 1;
        Round& round = weights.rounds[r];
        round.ends = reader.linear(kWidth, 2 * kMessage);
        round.edge = reader.linear(kEdges, kMessage, false);
        round.odd = reader.linear(kOdd, kMessage, false);
        round.edge_image = reader.linear(kEdgeImages, kMessage, false);
        round.belief = reader.linear(kWidth, 1);
        round.mix = reader.linear(kWidth + kMessage + (has_plane ? kPlanes : 0), kWidth);
        round.mix_refined = has_plane ? reader.linear(kRefinedPlanes, kWidth, false) : Linear{nullptr, nullptr};
        round.whole = reader.linear(kWidth, kWidth, false);
        round.out = reader.linear(kWidth, kWidth);
        round.norm = reader.scale(kWidth);
    }
    weights.head = reader.linear(kWidth, kWidth);
    weights.last = reader.linear(kWidth, kTolerances);
    weights.head_whole = reader.linear(kWidth, kWidth, false);
    reader.check_end();
    return weights;
}

auto learned_network(Floats weights, Integers ptr, Points points0, Points points1, Flags has_rows,
                     std::optional<Doubles> cost, Integers crow0, Integers cols0, Integers crow1, Integers cols1,
                     std::optional<Table> image, std::optional<Curves> curve0, std::optional<Curves> curve1,
                     std::optional<Floats> first, std::optional<Integers> num_columns, std::optional<Floats> offset,
                     int num_threads) {
    using ts::learned::kCurves, ts::learned::kImages, ts::learned::kTolerances;
    const std::size_t num_matches = points0.shape(0), num_pairs = ptr.shape(0) - 1;
    const auto num_rows = static_cast<std::int64_t>(num_matches);
    check(points1.shape(0) == num_matches, "points0 and points1 must have the same length");
    check(has_rows.shape(0) == num_pairs, "has_rows must have one entry per pair");
    check(!cost || cost->shape(0) == num_matches, "cost must have one entry per match");
    check_offsets(ptr, num_rows, "ptr must rise from 0 to the number of matches");
    check(crow0.shape(0) == num_matches + 1 && crow1.shape(0) == num_matches + 1, "crow must have one row per match");
    check_offsets(crow0, static_cast<std::int64_t>(cols0.shape(0)), "crow0 must rise from 0 to the length of cols0");
    check_offsets(crow1, static_cast<std::int64_t>(cols1.shape(0)), "crow1 must rise from 0 to the length of cols1");
    for (std::size_t b = 0; b < num_pairs; ++b) {
        for (std::int64_t m = ptr(b); m < ptr(b + 1); ++m) {
            for (const auto& [crow, cols] : {std::pair(&crow0, &cols0), std::pair(&crow1, &cols1)}) {
                for (std::int64_t k = (*crow)(m); k < (*crow)(m + 1); ++k) {
                    check((*cols)(k) >= ptr(b) && (*cols)(k) < ptr(b + 1), "cols must name matches of the same pair");
                }
            }
        }
    }
    std::int64_t width = 0;
    if (image) {
        check(curve0 && curve1 && first && num_columns && offset, "evidence must be given as a whole");
        width = static_cast<std::int64_t>(curve0->shape(2));
        check(image->shape(0) == num_matches && image->shape(1) == kImages && first->shape(0) == num_matches &&
                  num_columns->shape(0) == num_matches && offset->shape(0) == num_matches,
              "evidence must have one row per match");
        for (const auto* const curve : {&*curve0, &*curve1}) {
            check(curve->shape(0) == num_matches && curve->shape(1) == kCurves &&
                      static_cast<std::int64_t>(curve->shape(2)) == width,
                  "evidence must have one row per match");
        }
        for (std::size_t m = 0; m < num_matches; ++m) {
            check((*num_columns)(m) >= 0 && (*num_columns)(m) <= width,
                  "evidence must have as many columns as it says");
        }
    }
    const ts::learned::Weights read = read_weights(weights);
    auto logits = ts::allocate<float>(num_matches * kTolerances);
    {
        const nb::gil_scoped_release release;
        ts::learned_network(read,
                            {ptr.data(),
                             {points0.data(), points1.data()},
                             has_rows.data(),
                             cost ? cost->data() : nullptr,
                             {crow0.data(), crow1.data()},
                             {cols0.data(), cols1.data()},
                             image ? image->data() : nullptr,
                             {image ? curve0->data() : nullptr, image ? curve1->data() : nullptr},
                             image ? first->data() : nullptr,
                             image ? num_columns->data() : nullptr,
                             image ? offset->data() : nullptr,
                             width},
                            static_cast<std::int64_t>(num_pairs), num_threads, logits.get());
    }
    return give_rows<kTolerances>(std::move(logits), num_matches);
}

}  // namespace

void bind_learned(nb::module_& module) {
    module.def("learned_network", &learned_network, nb::arg("weights"), nb::arg("ptr"), nb::arg("points0"),
               nb::arg("points1"), nb::arg("has_rows"), nb::arg("cost").none(), nb::arg("crow0"), nb::arg("cols0"),
               nb::arg("crow1"), nb::arg("cols1"), nb::arg("image").none(), nb::arg("curve0").none(),
               nb::arg("curve1").none(), nb::arg("first").none(), nb::arg("num_columns").none(),
               nb::arg("offset").none(), nb::arg("num_threads"));
}

}  // namespace bindings
