#include <cmath>
#include <cstdint>
#include <limits>
#include <random>
#include <vector>

#include "expect.hpp"
#include "tensor_stereo/nearest_ssd.hpp"

namespace ts = tensor_stereo;

TEST(nearest_ssd_takes_the_lowest_index_of_equals) {
    const double keypoints0[] = {10, 5, 10, 9}, keypoints1[] = {8, 5, 9, 5, 9, 6.5, 3, 5};
    const float descriptors0[] = {1, 2, 7, 7}, descriptors1[] = {1, 3, 2, 2, 1, 2, 1, 2};
    const std::int64_t ptr0[] = {0, 2}, ptr1[] = {0, 4};
    float cost[2], second[2], cost1[4];
    std::int64_t index[2], index1[4];
    ts::nearest_ssd({keypoints0, descriptors0, ptr0}, {keypoints1, descriptors1, ptr1}, 1, 2, {1, 0, 5}, 1,
                    ts::Vectors::kBest, {cost, index, second, cost1, index1});
    EXPECT(cost[0] == 1 && index[0] == 0 && second[0] == 1);
    EXPECT(std::isinf(cost[1]) && index[1] == -1);
    EXPECT(index1[0] == 0 && index1[1] == 0 && index1[2] == -1 && index1[3] == -1);
}

TEST(nearest_ssd_without_gates_is_the_same_on_all_instructions_and_equals_a_wide_gate) {
    constexpr double kInfinity = std::numeric_limits<double>::infinity();
    constexpr std::int64_t kSize = 37;
    const std::int64_t ptr0[] = {0, 131, 131, 200}, ptr1[] = {0, 90, 95, 170};
    std::mt19937 random(4);
    struct Kind {
        bool is_whole;
        float least, most;
    };
    for (const auto [is_whole, least, most] : {Kind{true, -3, 3}, {true, 0, 255}, {false, -3, 3}}) {
        std::uniform_real_distribution<float> uniform(least, most);
        const bool is_rounded = is_whole;
        auto fill = [&](std::int64_t count) {
            std::vector<float> values(count * kSize);
            for (float& value : values) value = is_rounded ? std::round(uniform(random)) : uniform(random);
            return values;
        };
        const std::vector<float> descriptors0 = fill(200), descriptors1 = fill(170);
        const std::vector<double> points(400, 5);
        struct Found {
            std::vector<float> cost, second, cost1;
            std::vector<std::int64_t> index, index1;
            bool operator==(const Found&) const = default;
        };
        auto find = [&](ts::Gate gate, int num_threads, ts::Vectors vectors) {
            Found found{std::vector<float>(200), std::vector<float>(200), std::vector<float>(170),
                        std::vector<std::int64_t>(200), std::vector<std::int64_t>(170)};
            ts::nearest_ssd(
                {points.data(), descriptors0.data(), ptr0}, {points.data(), descriptors1.data(), ptr1}, 3, kSize, gate,
                num_threads, vectors,
                {found.cost.data(), found.index.data(), found.second.data(), found.cost1.data(), found.index1.data()});
            return found;
        };
        const Found expected = find({1, -kInfinity, kInfinity}, 1, ts::Vectors::kBaseline);
        for (const auto vectors :
             {ts::Vectors::kBest, ts::Vectors::kBaseline, ts::Vectors::kAvx2, ts::Vectors::kAvx512}) {
            if (!ts::has_vectors(vectors)) continue;
            for (const int num_threads : {1, 2}) {
                EXPECT(find({kInfinity, -kInfinity, kInfinity}, num_threads, vectors) == expected);
            }
        }
    }
}
