#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <vector>

#include "expect.hpp"
#include "tensor_stereo/window_refine.hpp"
#include "tensor_stereo/window_search.hpp"
#include "texture.hpp"

namespace ts = tensor_stereo;

namespace {

constexpr int kCount = 60;

// Places all over the image, some outside, and four that are no pixels.
std::vector<float> places(float shift) {
    std::vector<float> points;
    for (int m = 0; m < kCount; ++m) {
        points.push_back(m < 4 ? kStrange[m] : static_cast<float>(m * 37 % 76) - 3 - shift);
        points.push_back(static_cast<float>(m * 13 % 46) - 3);
    }
    return points;
}

std::vector<float> directions(bool is_rectified) {
    std::vector<float> along;
    for (int m = 0; m < kCount; ++m) {
        along.push_back(is_rectified ? 1.0f : 0.8f);
        along.push_back(is_rectified ? 0.0f : 0.6f);
    }
    return along;
}

template <class T>
bool same(const std::vector<T>& a, const std::vector<T>& b) {
    return std::memcmp(a.data(), b.data(), a.size() * sizeof(T)) == 0;
}

std::vector<float> search(ts::Vectors vectors, bool is_rectified) {
    const Texture texture;
    ts::SearchPair pair;
    texture.show(pair.view);
    pair.first = -20;
    pair.count = 300;  // more than one strip
    pair.is_rectified = is_rectified;
    const auto points = places(0), along = directions(is_rectified);
    const std::vector<float> across(kCount, 0.0f);
    std::vector<float> predicted, disparity(kCount);
    for (int m = 0; m < kCount; ++m) predicted.insert(predicted.end(), {5.0f, 270.0f});
    const std::int64_t ptr[] = {0, kCount};
    const std::unique_ptr<bool[]> found(new bool[kCount]);
    ts::window_search(&pair, 1, {ptr, points.data(), along.data(), across.data(), predicted.data(), 2}, 3, 2,
                      disparity.data(), found.get(), vectors);
    return disparity;
}

struct Moved {
    std::vector<float> along = std::vector<float>(kCount), across = along, variance = along;
};

Moved refine(ts::Vectors vectors, bool is_rectified, float slope) {
    const Texture texture;
    ts::RefinePair pair;
    texture.show(pair.view);
    pair.is_rectified = is_rectified;
    const auto left = places(0), right = places(5.7f), along = directions(is_rectified);
    const std::vector<float> off_line(kCount, 0.0f), slopes(2 * kCount, slope);
    const std::int64_t ptr[] = {0, kCount};
    Moved moved;
    ts::window_refine(&pair, 1, {ptr, left.data(), right.data(), along.data(), off_line.data(), slopes.data()}, 1, 2,
                      {moved.along.data(), moved.across.data(), moved.variance.data()}, vectors);
    return moved;
}

}  // namespace

TEST(window_search_finds_an_exact_copy_with_the_same_bits_everywhere) {
    const auto expected = search(ts::Vectors::kBaseline, true), turned = search(ts::Vectors::kBaseline, false);
    int num_right = 0;
    const auto points = places(0);
    for (int m = 4; m < kCount; ++m) num_right += std::abs(expected[m] - Texture::kShift) < 0.5;
    EXPECT(num_right > 40);
    for (const auto vectors : {ts::Vectors::kBest, ts::Vectors::kAvx2, ts::Vectors::kAvx512}) {
        if (!ts::has_vectors(vectors)) continue;
        EXPECT(same(search(vectors, true), expected) && same(search(vectors, false), turned));
    }
}

TEST(window_refine_moves_to_an_exact_copy_with_the_same_bits_everywhere) {
    for (const bool is_rectified : {true, false}) {
        for (const float slope : {0.0f, 0.5f}) {
            const Moved expected = refine(ts::Vectors::kBaseline, is_rectified, slope);
            for (int m = 4; m < kCount; ++m) EXPECT(std::abs(expected.along[m]) <= 1);
            for (const auto vectors : {ts::Vectors::kBest, ts::Vectors::kAvx2, ts::Vectors::kAvx512}) {
                if (!ts::has_vectors(vectors)) continue;
                const Moved found = refine(vectors, is_rectified, slope);
                EXPECT(same(found.along, expected.along) && same(found.variance, expected.variance));
            }
        }
    }
    const Moved level = refine(ts::Vectors::kBest, true, 0);
    int num_near = 0;
    for (int m = 4; m < kCount; ++m) num_near += std::abs(level.along[m] + 0.3f) < 0.15f;  // from 5.7 px to 6
    EXPECT(num_near > 30);
}
