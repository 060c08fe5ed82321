#include <cmath>
#include <cstdint>
#include <memory>
#include <random>
#include <vector>

#include "expect.hpp"
#include "tensor_stereo/learned_network.hpp"

namespace ts = tensor_stereo;
using namespace ts::learned;

namespace {

// Random weights of some size, all in one row that outlives them.
class RandomWeights {
   public:
    RandomWeights() {
        for (Scale* const scale :
             {&weights.nodes, &weights.cost, &weights.image, &weights.edges, &weights.edge_image}) {
            *scale = {take(kImages), take(kImages)};
        }
        weights.enter = linear(kNodes + kCosts + 2, kWidth);
        weights.enter_image = linear(kImages, kWidth);
        weights.enter_image_out = weights.enter_out = weights.head = weights.head_whole = linear(kWidth, kWidth);
        weights.last = linear(kWidth, kTolerances);
        for (Round& round : weights.rounds) {
            round.ends = linear(kWidth, 2 * kMessage);
            round.edge = linear(kEdges, kMessage);
            round.odd = linear(kOdd, kMessage);
            round.edge_image = linear(kEdgeImages, kMessage);
            round.belief = linear(kWidth, 1);
            round.mix = linear(kWidth + kMessage + kPlanes, kWidth);
            round.mix_refined = linear(kRefinedPlanes, kWidth);
            round.whole = round.out = linear(kWidth, kWidth);
            round.norm = {take(kWidth), take(kWidth)};
        }
    }

    Weights weights;

   private:
    const float* take(int size) {
        rows_.push_back(std::make_unique<float[]>(size));
        for (int k = 0; k < size; ++k) rows_.back()[k] = std::normal_distribution<float>(0, 0.2f)(random_);
        return rows_.back().get();
    }
    Linear linear(int in, int out) {
        const float* const weight = take(in * out);
        return {weight, take(out)};
    }

    std::mt19937 random_{0};
    std::vector<std::unique_ptr<float[]>> rows_;
};

// Pairs of 0, 1 and 30 matches whose graphs are a ring and a line.
struct Given {
    std::vector<std::int64_t> ptr{0, 0, 1, 31}, crow[2], cols[2], num_columns;
    std::vector<double> points[2], cost;
    std::vector<float> image, curve[2], first, offset;
    bool has_rows[3] = {true, true, false};

    Given() {
        std::mt19937 random(1);
        std::uniform_real_distribution<double> place(0, 200);
        for (int m = 0; m < 31; ++m) {
            const double x = place(random), y = place(random);
            points[0].insert(points[0].end(), {x, y});
            points[1].insert(points[1].end(), {x - 20 + place(random) / 50, y});
            cost.push_back(place(random));
            num_columns.push_back(m % 5 == 0 ? 0 : 9);
            first.push_back(15);
            offset.push_back(0.25f);
        }
        image.assign(31 * kImages, 0.5f);
        for (auto& values : curve) values.assign(31 * kCurves * 9, 0.3f);
        for (int v = 0; v < 2; ++v) {
            crow[v].assign(2, 0);  // the lone match has no neighbours
            for (int m = 0; m < 30; ++m) {
                std::vector<std::int64_t> near;
                for (int n = 0; n < 30; ++n) {
                    const int apart = std::abs(m - n);
                    if (apart == 1 || (v == 0 && apart == 29)) near.push_back(1 + n);
                }
                cols[v].insert(cols[v].end(), near.begin(), near.end());
                crow[v].push_back(static_cast<std::int64_t>(cols[v].size()));
            }
        }
    }

    std::vector<float> run(const Weights& weights, bool has_images, ts::Vectors vectors) const {
        std::vector<float> logits(31 * kTolerances);
        const ts::LearnedInputs inputs{ptr.data(),
                                       {points[0].data(), points[1].data()},
                                       has_rows,
                                       cost.data(),
                                       {crow[0].data(), crow[1].data()},
                                       {cols[0].data(), cols[1].data()},
                                       has_images ? image.data() : nullptr,
                                       {curve[0].data(), curve[1].data()},
                                       first.data(),
                                       num_columns.data(),
                                       offset.data(),
                                       9};
        ts::learned_network(weights, inputs, 3, 2, logits.data(), vectors);
        return logits;
    }
};

}  // namespace

TEST(learned_network_agrees_on_all_instructions_and_grows_with_the_tolerance) {
    const RandomWeights random;
    const Given given;
    for (const bool has_images : {false, true}) {
        const auto expected = given.run(random.weights, has_images, ts::Vectors::kBaseline);
        for (std::size_t k = 0; k < expected.size(); ++k) {
            EXPECT(std::isfinite(expected[k]));
            if (k % kTolerances != 0) EXPECT(expected[k] >= expected[k - 1]);
        }
        for (const auto vectors : {ts::Vectors::kBest, ts::Vectors::kAvx2, ts::Vectors::kAvx512}) {
            if (!ts::has_vectors(vectors)) continue;
            const auto found = given.run(random.weights, has_images, vectors);
            for (std::size_t k = 0; k < found.size(); ++k) EXPECT(std::abs(found[k] - expected[k]) <= 1e-4f);
        }
    }
}
