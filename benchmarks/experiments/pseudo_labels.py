"""Pseudo-labels for a disparity network: putative matches of unlabelled pairs, each with the weight of a condition."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

import tensor_stereo as ts
from tensor_stereo.batching import split, to_padded
from tensor_stereo.configs import FASTConfig, MatchingConfig, PipelineConfig
from tensor_stereo.evaluation import matches_against_gt
from tensor_stereo.pipeline import Stopwatch, match_pairs, to_gray_pairs

CONDITIONS = ("none", "hard", "soft", "median", "oracle")
PUTATIVES = PipelineConfig(
    detector="fast",
    fast=FASTConfig(threshold=10),  # twice the labels of 20 on the training scenes, as many of them correct
    matching=MatchingConfig(max_row_offset_px=1, min_disparity_px=0, max_disparity_px=78),
)
MEDIAN_THRESHOLDS_PX = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)


@dataclass(frozen=True, eq=False)
class PseudoLabels:
    """Putative matches of all training pairs, and the weight of each under every condition.

    Attributes:
        matches: M matches of B pairs, whole pixels.
        weights: for each condition, the weights (M,) float32 of the matches in the loss, in [0, 1].
        correct: (M,) bool, correct against ground truth; the report and the oracle use it.
        valid: (M,) bool, ground truth is known.
        median_threshold_px: largest deviation that the median condition accepts.
    """

    matches: ts.Matches
    weights: dict[str, Tensor]
    correct: Tensor
    valid: Tensor
    median_threshold_px: float

    def of_condition(self, condition: str) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Per pair: pixels (n, 2) int64 (x, y), disparity (n,) in px and weight (n,), without those of weight 0."""
        parts = []
        columns = self.matches.keypoints0.long(), self.matches.disparity, self.weights[condition]
        for pixels, disparity, weight in zip(*(split(c, self.matches.ptr) for c in columns), strict=True):
            kept = weight > 0
            parts.append((pixels[kept], disparity[kept], weight[kept]))
        return parts

    def summary(self, condition: str) -> dict[str, float]:
        """Number of labels, sum of their weights, and the share of correct ones among those with ground truth."""
        weight, known = self.weights[condition].double(), self.valid.double()
        used = (weight > 0).double()
        return {
            "labels_per_pair": float(used.sum()) / self.matches.num_pairs,
            "weight_per_pair": float(weight.sum()) / self.matches.num_pairs,
            "fraction_correct": float((used * self.correct).sum() / (used * known).sum()),
            "weighted_fraction_correct": float((weight * self.correct).sum() / (weight * known).sum()),
        }


def make_pseudo_labels(pairs: Sequence[ts.StereoPair]) -> PseudoLabels:
    """Match every pair once and weigh its matches under every condition.

    Ground truth serves the oracle, and chooses the threshold of the median: a favour that only the peer gets.
    """
    gray = to_gray_pairs([(pair.image0, pair.image1) for pair in pairs])
    matches = match_pairs(gray, PUTATIVES, Stopwatch())
    correct, valid = matches_against_gt(matches, [pair.disparity_gt for pair in pairs])
    verdict = ts.DelaunayFilter(verdict="cardinality", score="topology")(matches)
    deviation = median_deviation(matches)
    threshold = choose_threshold(deviation, correct, valid)
    weights = {
        "none": torch.ones_like(correct),
        "hard": verdict.inlier,
        "soft": verdict.score.detach(),
        "median": deviation <= threshold,
        "oracle": correct,
    }
    return PseudoLabels(matches, {k: w.float() for k, w in weights.items()}, correct, valid, threshold)


def median_deviation(matches: ts.Matches) -> Tensor:
    """|disparity - median disparity of the Delaunay neighbours in view 0|, (M,) px; NaN without neighbours."""
    graph = ts.build_graphs(matches.keypoints0, matches.ptr)
    disparity = matches.disparity.double()
    of_neighbors, _ = to_padded(disparity[graph.col_indices], graph.crow_indices, fill=torch.nan)  # (M, max degree)
    return (disparity - of_neighbors.nanquantile(0.5, dim=1)).abs()


def choose_threshold(deviation: Tensor, correct: Tensor, valid: Tensor) -> float:
    """The candidate with the best F1 of "correct" over the matches with ground truth."""
    scores = {}
    for threshold in MEDIAN_THRESHOLDS_PX:
        kept = (deviation <= threshold) & valid
        scores[threshold] = 2 * int((kept & correct).sum()) / (int(kept.sum()) + int(correct.sum()))
    return max(scores, key=scores.__getitem__)
