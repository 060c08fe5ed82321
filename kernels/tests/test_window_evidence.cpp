#include <cmath>
#include <cstdint>
#include <cstring>
#include <random>
#include <vector>

#include "expect.hpp"
#include "lanes.hpp"
#include "tensor_stereo/window_evidence.hpp"
#include "texture.hpp"

namespace ts = tensor_stereo;

namespace {

constexpr std::int64_t kCount = 21;

struct Found {
    std::vector<float> values, curve0, curve1, start, offset;
};

// A random texture, the same 6 px to the left, and matches at every place, also outside; with NaN and huge coordinates.
Found measure(ts::Vectors vectors, int num_threads, bool is_rectified) {
    std::mt19937 random(0);
    const Texture texture;
    std::vector<float> points0, points1, along, disparity, across, slope;
    for (int m = 0; m < 90; ++m) {
        const float x = static_cast<float>(random() % 100) - 12, y = static_cast<float>(random() % 60) - 9;
        points0.insert(points0.end(), {x, y});
        points1.insert(points1.end(), {m < 4 ? kStrange[m] : x - 6.25f, y});
        along.insert(along.end(), {is_rectified ? 1.0f : 0.8f, is_rectified ? 0.0f : 0.6f});
        disparity.push_back(m < 4 ? kStrange[m] : 6.25f);
        across.push_back(0.1f);
        slope.insert(slope.end(), {0.4f, -0.5f});
    }
    const auto count = static_cast<std::int64_t>(disparity.size());
    const std::int64_t ptr[] = {0, count};
    ts::EvidencePair pair;
    texture.show(pair.view);
    pair.first = -3;
    pair.count = kCount;
    pair.is_rectified = is_rectified;
    Found found;
    found.values.resize(count * ts::kEvidenceValues);
    found.curve0.resize(count * ts::kEvidenceCurves * kCount);
    found.curve1.resize(found.curve0.size());
    found.start.resize(count);
    found.offset.resize(count);
    ts::window_evidence(
        &pair, 1, {ptr, points0.data(), points1.data(), along.data(), disparity.data(), across.data(), slope.data()},
        num_threads,
        {found.values.data(),
         {found.curve0.data(), found.curve1.data()},
         found.start.data(),
         found.offset.data(),
         kCount},
        vectors);
    return found;
}

bool same(const std::vector<float>& a, const std::vector<float>& b) {
    return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(float)) == 0;
}

}  // namespace

TEST(window_evidence_has_the_same_bits_on_all_instructions_and_threads) {
    for (const bool is_rectified : {true, false}) {
        const Found expected = measure(ts::Vectors::kBaseline, 1, is_rectified);
        for (const auto vectors : {ts::Vectors::kBest, ts::Vectors::kAvx2, ts::Vectors::kAvx512}) {
            if (!ts::has_vectors(vectors)) continue;
            const Found found = measure(vectors, 2, is_rectified);
            EXPECT(same(found.values, expected.values) && same(found.curve0, expected.curve0) &&
                   same(found.curve1, expected.curve1) && same(found.offset, expected.offset));
        }
    }
}

TEST(window_evidence_of_an_exact_copy_is_lowest_at_the_match) {
    const Found found = measure(ts::Vectors::kBest, 1, true);
    long num_lowest = 0;
    for (std::size_t m = 4; m < found.offset.size(); ++m) num_lowest += std::abs(found.offset[m]) <= 1;
    EXPECT(num_lowest > 40);
    for (const float value : found.curve0) EXPECT(value >= -6 && value <= 6);
}

TEST(logarithm_and_exponential_are_exact_to_single_precision) {
    for (float x = 0.5f; x < 1e6f; x *= 1.013f) {
        const double expected = std::log(static_cast<double>(x));
        EXPECT(std::abs(ts::scalar_logarithm(x) - expected) <= 2e-7 * std::max(1.0, std::abs(expected)));
    }
    for (float x = 0; x > -80; x -= 0.037f) {
        ts::Lanes<4> lanes = ts::Lanes<4>{} + x;
        ts::exponential(lanes);
        const double expected = std::exp(static_cast<double>(x));
        EXPECT(std::abs(lanes[0] - expected) <= 3e-7 * expected);
    }
}
