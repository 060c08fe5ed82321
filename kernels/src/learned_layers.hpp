// The weights of the learned score's network as its layers want them.
#pragma once

#include <algorithm>
#include <vector>

#include "dense_layers.hpp"

namespace tensor_stereo::learned {

constexpr int kSpace = padded(kWidth);

// The weights as the layers want them.
struct Layers {
    struct MessageRound {
        Dense<kWidth, kMessage> hear, tell;
        Dense<kEdges, kMessage> edge;
        Dense<kOdd, kMessage> odd;
        Dense<kEdgeImages, kMessage> edge_image;
        Dense<kWidth, 1> belief;
        Dense<kWidth, kWidth> mix_state, whole, out;
        Dense<kMessage, kWidth> mix_heard;
        Dense<kPlanes, kWidth> mix_plane;
        Dense<kRefinedPlanes, kWidth> mix_refined;
        Scale norm;
    };

    explicit Layers(const Weights& given)
        : enter(given.enter),
          enter_image(given.enter_image),
          enter_image_out(given.enter_image_out),
          enter_out(given.enter_out),
          head(given.head),
          head_whole(given.head_whole),
          last(given.last),
          scales(given) {
        for (int r = 0; r < kRounds; ++r) rounds.push_back(make_round(given.rounds[r], r > 1));
    }

    static MessageRound make_round(const Round& given, bool has_plane) {
        const int columns = kWidth + kMessage + (has_plane ? kPlanes : 0);
        std::vector<float> parts[3];
        const int sizes[] = {kWidth, kMessage, kPlanes};
        int first = 0;
        for (int p = 0; p < 3; ++p) {
            parts[p].resize(kWidth * sizes[p]);
            for (int o = 0; o < kWidth && first < columns; ++o) {
                std::copy_n(given.mix.weight + o * columns + first, sizes[p], parts[p].data() + o * sizes[p]);
            }
            first += sizes[p];
        }
        const std::vector<float> none(kWidth * kRefinedPlanes);
        const Linear refined{has_plane ? given.mix_refined.weight : none.data(), nullptr};
        return {Dense<kWidth, kMessage>({given.ends.weight, given.ends.bias}),
                Dense<kWidth, kMessage>({given.ends.weight + kMessage * kWidth, given.ends.bias + kMessage}),
                Dense<kEdges, kMessage>(given.edge),
                Dense<kOdd, kMessage>(given.odd),
                Dense<kEdgeImages, kMessage>(given.edge_image),
                Dense<kWidth, 1>(given.belief),
                Dense<kWidth, kWidth>({parts[0].data(), given.mix.bias}),
                Dense<kWidth, kWidth>(given.whole),
                Dense<kWidth, kWidth>(given.out),
                Dense<kMessage, kWidth>({parts[1].data(), nullptr}),
                Dense<kPlanes, kWidth>({parts[2].data(), nullptr}),
                Dense<kRefinedPlanes, kWidth>(refined),
                given.norm};
    }

    Dense<kNodes + kCosts + 2, kWidth> enter;
    Dense<kImages, kWidth> enter_image;
    Dense<kWidth, kWidth> enter_image_out, enter_out, head, head_whole;
    Dense<kWidth, kTolerances> last;
    std::vector<MessageRound> rounds;
    const Weights& scales;
};

}  // namespace tensor_stereo::learned
