"""Sparse disparities of one pair by what was asked about the matches: the hints of guided stereo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from accuracy.dense import score_filters
from accuracy.peers import score_gms
from accuracy.putatives import GrayPair, Putatives, find_putatives, to_matches
from shared.results import read_records
from tensor_stereo.configs import FilterConfig
from tensor_stereo.evaluation import errors_against_gt
from tensor_stereo.scores import LearnedScore, repair_matches, score_matches

MEDIAN = "disparity median, Delaunay"
CONDITIONS = (
    "all putatives",
    "paper R1+R2",
    "GMS",
    "left-right check",
    MEDIAN,
    "consensus",
    "learned",
    "learned + repair",
    "oracle",
)
LIKELY = 0.5


class Anchors(NamedTuple):
    """Disparities at pixels of view 0.

    Attributes:
        pixels: (N, 2) x and y.
        disparity: (N,) px.
        error_px: (N,) of the match, NaN where the truth is unknown.
    """

    pixels: NDArray[np.int64]
    disparity: NDArray[np.float64]
    error_px: NDArray[np.float64]

    def some(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Anchors:
        return Anchors(self.pixels[rows], self.disparity[rows], self.error_px[rows])

    def wrong(self, tolerance_px: float) -> NDArray[np.bool_]:
        """(N,) known to be off by more."""
        return self.error_px > tolerance_px

    def hints(self, shape: Sequence[int]) -> torch.Tensor:
        """(H, W) float32 px, NaN where there is none."""
        hints = torch.full(tuple(shape), torch.nan)
        x, y = self.pixels.T
        hints[torch.from_numpy(y), torch.from_numpy(x)] = torch.from_numpy(self.disparity).float()
        return hints


@torch.no_grad()
def find_anchors(
    pair: GrayPair, network: LearnedScore, *, gated: bool, tolerance_px: float = 1.0
) -> dict[str, Anchors]:
    """FAST corners matched by SSD, and what each condition keeps of them; GMS where OpenCV has it.

    Thresholds are those that ``accuracy/dense.py`` chose on the training scenes; a calibrated probability is taken at
    its word, .5. The oracle keeps what is known to be right within ``tolerance_px``.
    """
    given = find_putatives(pair, "fast", gated=gated)
    scores = score_filters(pair, given, network)
    kept = {
        "all putatives": np.ones(len(given.points0), bool),
        "paper R1+R2": scores["paper R1+R2"] > 0,
        "left-right check": is_mutual(given, find_putatives(turned(pair), "fast", gated=gated), pair.left.shape[1]),
        MEDIAN: scores[MEDIAN] >= median_threshold(gated=gated),
        "consensus": scores["consensus"] >= LIKELY,
        "learned": scores["learned"] >= LIKELY,
        "oracle": given.error_px <= tolerance_px,
    }
    if hasattr(cv2, "xfeatures2d"):  # of opencv-contrib
        kept["GMS"] = score_gms(given) > 0
    every = Anchors(np.rint(given.points0).astype(np.int64), (given.points0 - given.points1)[:, 0], given.error_px)
    found = {name: every.some(rows) for name, rows in kept.items()}
    found["learned + repair"] = repaired(pair, given, network)
    return {name: found[name] for name in CONDITIONS if name in found}


def repaired(pair: GrayPair, given: Putatives, network: LearnedScore) -> Anchors:
    """The kept matches, and the rejected ones that were searched again and are likely now."""
    views = [torch.from_numpy(pair.left)[None]], [torch.from_numpy(pair.right)[None]]
    matches = to_matches([given], with_cost=True)
    first = score_matches(matches, FilterConfig(), images=views, network=network)
    more = repair_matches(matches, *views, first.score >= LIKELY, first.alignment)
    anew = score_matches(more.matches, FilterConfig(), images=views, network=network)
    rows = ((anew.score >= LIKELY) & (anew.graphs.group_size > 0)).numpy()
    error = errors_against_gt(more.matches, torch.from_numpy(pair.disparity_gt)[None]).numpy()
    points0, points1 = (points.double().numpy() for points in (more.matches.keypoints0, more.matches.keypoints1))
    every = Anchors(np.rint(points0).astype(np.int64), (points0 - points1)[:, 0], error)
    return every.some(rows)


def turned(pair: GrayPair) -> GrayPair:
    """Both views exchanged and mirrored, so that disparities stay positive; without truth."""
    nothing = np.full(pair.disparity_gt.shape, np.nan)
    return GrayPair(pair.scene, *(np.ascontiguousarray(view[:, ::-1]) for view in (pair.right, pair.left)), nothing)


def is_mutual(given: Putatives, back: Putatives, width: int) -> NDArray[np.bool_]:
    """(M,) whether matching from the other view finds the same pair of points."""

    def key(points0: NDArray[np.float64], points1: NDArray[np.float64]) -> list[tuple[int, ...]]:
        return [tuple(row) for row in np.rint(np.concatenate([points0, points1], 1)).astype(int).tolist()]

    mirrored = [points * [-1, 1] + [width - 1, 0] for points in (back.points1, back.points0)]
    there = set(key(*mirrored))
    return np.array([row in there for row in key(given.points0, given.points1)])


def median_threshold(*, gated: bool) -> float:
    """Of the deviation from the neighbours' median disparity, chosen on the training scenes."""
    kind = "fast, gated" if gated else "fast"
    return next(
        float(record["threshold"])
        for record in read_records("dense")
        if record.get("putatives") == kind and record.get("filter") == MEDIAN
    )
