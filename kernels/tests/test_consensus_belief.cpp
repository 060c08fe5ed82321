#include <cstddef>
#include <cstdint>
#include <cstring>
#include <numeric>
#include <random>
#include <vector>

#include "expect.hpp"
#include "plain_consensus_belief.hpp"
#include "tensor_stereo/consensus_belief.hpp"
#include "tensor_stereo/delaunay_graph.hpp"

namespace ts = tensor_stereo;

namespace {

constexpr ts::ConsensusSettings kSettings{0.6, 1.0, 0.25, 1.5, 0.2, 2.0, 1.0, 0.5, 2};

// Matches of a sloped surface with some noise, of which every `wrong`-th is displaced; 0: none.
struct ConsensusSample {
    std::vector<double> keypoints[2], cost, row_offset;
    std::vector<std::int64_t> ptr{0};

    void add_pair(std::mt19937_64& rng, int count, int wrong) {
        std::uniform_real_distribution<double> unit(0, 1);
        for (int k = 0; k < count; ++k) {
            const double x = 640 * unit(rng), y = 480 * unit(rng), miss = wrong > 0 && k % wrong == 0 ? 30 : 0;
            keypoints[0].insert(keypoints[0].end(), {x, y});
            keypoints[1].insert(keypoints[1].end(), {0.9 * x - 5 + miss + 0.1 * unit(rng), y + 0.1 * unit(rng)});
            cost.push_back(100 * unit(rng) + miss);
            row_offset.push_back(y - keypoints[1].back());
        }
        ptr.push_back(static_cast<std::int64_t>(cost.size()));
    }

    std::vector<double> belief(const ts::ConsensusSettings& settings, int num_threads,
                               decltype(ts::consensus_belief)& kernel = ts::consensus_belief) const {
        const auto count = static_cast<std::int64_t>(cost.size());
        const auto num_pairs = static_cast<std::int64_t>(ptr.size()) - 1;
        std::vector<std::int64_t> index(cost.size());
        std::iota(index.begin(), index.end(), 0);
        const auto build = [&](const std::vector<double>& points) {
            return ts::delaunay_graph(points.data(), count, index.data(), ptr.data(), num_pairs, 1e-3, 1);
        };
        const auto graph0 = build(keypoints[0]), graph1 = build(keypoints[1]);
        std::vector<double> result(cost.size(), -1);
        kernel({{keypoints[0].data(), keypoints[1].data()},
                ptr.data(),
                num_pairs,
                cost.data(),
                row_offset.empty() ? nullptr : row_offset.data(),
                {keypoints[0].data(), keypoints[1].data()},
                {graph0.crow.get(), graph1.crow.get()},
                {graph0.cols.get(), graph1.cols.get()}},
               settings, num_threads, result.data());
        return result;
    }
};

}  // namespace

TEST(consensus_believes_matches_that_agree) {
    std::mt19937_64 rng(7);
    ConsensusSample sample;
    sample.add_pair(rng, 300, 10);
    for (const int num_rounds : {1, 2, 3}) {
        auto settings = kSettings;
        settings.num_rounds = num_rounds;
        const auto belief = sample.belief(settings, 1);
        double wrong = 0, right = 0;  // means
        for (std::size_t k = 0; k < belief.size(); ++k) {
            EXPECT(belief[k] >= 0 && belief[k] < 1);
            (k % 10 == 0 ? wrong : right) += k % 10 == 0 ? belief[k] / 30 : belief[k] / 270;
        }
        EXPECT(wrong < 0.05 && right > 0.5);
    }
}

TEST(consensus_without_neighbours_is_zero) {
    std::mt19937_64 rng(8);
    ConsensusSample sample;
    EXPECT(sample.belief(kSettings, 2).empty());
    for (const int count : {0, 1, 0, 1}) sample.add_pair(rng, count, 0);
    for (const double belief : sample.belief(kSettings, 2)) EXPECT(belief == 0);
    auto settings = kSettings;
    settings.num_rounds = 0;
    settings.cost_weight = 0;
    sample.row_offset.clear();
    for (const double belief : sample.belief(settings, 2)) EXPECT(belief == 0.5);
}

TEST(consensus_does_not_depend_on_threads_or_batches) {
    std::mt19937_64 rng(9);
    ConsensusSample sample;
    for (const int count : {5000, 0, 1, 2, 700}) sample.add_pair(rng, count, 3);
    const auto one = sample.belief(kSettings, 1);
    EXPECT(one == sample.belief(kSettings, 4));
    for (std::size_t b = 0; b + 1 < sample.ptr.size(); ++b) {
        ConsensusSample single;
        const auto begin = sample.ptr[b], end = sample.ptr[b + 1];
        for (int v = 0; v < 2; ++v) {
            const auto first = sample.keypoints[v].begin();
            single.keypoints[v].assign(first + 2 * begin, first + 2 * end);
        }
        single.cost.assign(sample.cost.begin() + begin, sample.cost.begin() + end);
        single.row_offset.assign(sample.row_offset.begin() + begin, sample.row_offset.begin() + end);
        single.ptr.push_back(end - begin);
        EXPECT(single.belief(kSettings, 1) == std::vector<double>(one.begin() + begin, one.begin() + end));
    }
}

TEST(vector_types_and_plain_numbers_give_the_same_bits) {
    std::mt19937_64 rng(12);
    for (const int num_rounds : {1, 2, 5}) {
        for (const bool has_rows : {false, true}) {
            ConsensusSample sample;
            for (const int count : {0, 1, 2, 3, 40, 700, 3000}) sample.add_pair(rng, count, 4);
            auto settings = kSettings;
            settings.num_rounds = num_rounds;
            if (!has_rows) sample.row_offset.clear();
            const auto own = sample.belief(settings, 1);
            const auto plain = sample.belief(settings, 1, ts::plain_consensus_belief);
            for (std::size_t k = 0; k < own.size(); ++k) {
                EXPECT(std::memcmp(&own[k], &plain[k], sizeof(double)) == 0);
            }
        }
    }
}
