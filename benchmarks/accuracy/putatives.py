"""Putative matches with ground truth, the same for every score and every peer.

OpenCV and NumPy detect and match, not this library, so that no change of its detectors or its matching moves a figure.
Only SURF comes through this library, from mahotas. Learned matches come from kornia.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

import tensor_stereo as ts
from shared.learned_matchers import match_learned
from shared.scenes import GATES
from tensor_stereo.configs import PipelineConfig
from tensor_stereo.datasets import SyntheticDataset, find_pairs, read_pair
from tensor_stereo.evaluation import errors_against_gt
from tensor_stereo.features import detect_features

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Gray = NDArray[np.uint8]

DETECTORS = ("sift", "fast", "surf", "gftt")
MAX_ERROR_PX = 1.0
RATIO = 0.8  # of SIFT
WINDOW_PX = 11
NUM_SYNTHETIC = 16
GROUPS = {  # release -> group; the eight scenes are the paper's
    "middlebury-2003": "eight", "middlebury-2005": "eight",
    "middlebury-2001": "training", "middlebury-2006": "training",
    "middeval3": "training", "kitti": "kitti", "eth3d": "eth3d", "synthetic": "synthetic",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Putatives:
    """Putative matches of one pair, and what is known about them.

    Attributes:
        scene: name of the pair.
        points0: (M, 2) px of view 0, distinct.
        points1: (M, 2) px of view 1, distinct.
        cost: (M,) SSD, or 1 - confidence of learned matches; NaN for matches that were made up.
        ratio: (M,) distance over that of the second-best candidate; NaN without one.
        valid: (M,) ground truth is known.
        correct: (M,) disparity and row are off by at most :data:`MAX_ERROR_PX`.
        error_px: (M,) px, the larger one of the errors of disparity and row; NaN where the truth is unknown.
        disparity_error_px: (M,) px, that of the disparity alone, as the paper counts.
        views: grey images (H, W) of both views.
    """

    scene: str
    points0: Float
    points1: Float
    cost: Float
    ratio: Float
    valid: Bool
    correct: Bool
    error_px: Float
    disparity_error_px: Float
    views: tuple[Gray, Gray]

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the images."""
        return self.views[0].shape


@dataclass(frozen=True, eq=False)
class GrayPair:
    """Grey levels (H, W) uint8 of both views, and the disparity (H, W) of the left one in px, NaN where unknown."""

    scene: str
    left: Gray
    right: Gray
    disparity_gt: Float


def load_pairs(root: Path | None) -> dict[str, list[GrayPair]]:
    """Every pair below ``root`` and the synthetic set, by group."""
    found: dict[str, list[GrayPair]] = {group: [] for group in dict.fromkeys(GROUPS.values())}
    for files in () if root is None else find_pairs(root):
        # OpenCV's reader rounds grey levels down, a conversion of its colour image does not: keypoints differ.
        views = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in (files.image0, files.image1))
        disparity_gt = read_pair(files).disparity_gt.numpy().astype(float)
        found[_group(files.dataset)].append(GrayPair(files.scene, *views, disparity_gt))
    for pair in SyntheticDataset(NUM_SYNTHETIC):
        views = (image.float().mean(0).round().byte().numpy() for image in (pair.image0, pair.image1))
        found["synthetic"].append(GrayPair(pair.name, *views, pair.disparity_gt.numpy().astype(float)))
    return found


def _group(dataset: str) -> str:
    return next(group for prefix, group in GROUPS.items() if dataset.startswith(prefix))


def find_putatives(pair: GrayPair, detector: str, *, gated: bool) -> Putatives:
    """Nearest neighbours by SSD, one-to-one by lowest cost; SIFT with Lowe's ratio test at 0.8.

    FAST keeps the 2000 strongest at threshold 20, GFTT 1000 corners at quality .01 and distance 3 px, SIFT 2000
    features, all of them OpenCV's, and SURF 2000 of mahotas'. Windows of 11 x 11 px describe FAST and GFTT.
    """
    (points0, descriptors0), (points1, descriptors1) = (_detect(image, detector) for image in (pair.left, pair.right))
    ssd = (descriptors0**2).sum(1)[:, None] + (descriptors1**2).sum(1)[None] - 2 * descriptors0 @ descriptors1.T
    if gated:
        offset = points0[:, None] - points1[None]  # (N0, N1, 2)
        disparity, rows = offset[..., 0], np.abs(offset[..., 1])
        beyond = (disparity < GATES.min_disparity_px) | (disparity > GATES.max_disparity_px)
        ssd[(rows > GATES.max_row_offset_px) | beyond] = np.inf
    partner = ssd.argmin(1)
    two = np.partition(ssd, 1, 1)[:, :2].astype(float)
    keep = np.isfinite(two[:, 0])
    if detector == "sift":
        keep &= two[:, 0] < RATIO**2 * two[:, 1]
    rows0 = np.flatnonzero(keep)
    rows1, (best, second) = partner[rows0], two[rows0].T
    order = np.argsort(best, kind="stable")
    chosen = order[np.unique(rows1[order], return_index=True)[1]]
    points0, points1 = points0[rows0[chosen]], points1[rows1[chosen]]
    best, second = best[chosen].clip(0), second[chosen]
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(np.isfinite(second) & (second > 0), np.sqrt(best / second), np.nan)
    return _judge(pair, points0, points1, best, ratio)


def find_learned_putatives(pair: GrayPair, *, folder: Path | None = None) -> Putatives:
    """The matches of ALIKED and LightGlue, which :func:`match_learned` may keep in ``folder``; they have no ratio."""
    points0, points1, confidence = match_learned(pair.left, pair.right, folder=folder)
    return _judge(pair, points0, points1, 1 - confidence, np.full(len(confidence), np.nan))


def draw_random_partners(given: Putatives, share: float, seed: int) -> Putatives:
    """Keep the correct matches alone, and give a share of them a partner drawn uniformly from the image.

    These count as wrong, wherever the partner lies. No match keeps its cost.
    """
    part = _select(given, given.valid & given.correct)
    rng = np.random.default_rng(seed)
    count = len(part.points0)
    wrong = rng.permutation(count) < round(share * count)
    points1, cost, ratio = part.points1.copy(), part.cost.copy(), part.ratio.copy()
    height, width = part.size
    points1[wrong] = rng.random((int(wrong.sum()), 2)) * [width - 1, height - 1]
    cost[:], ratio[:] = np.nan, np.nan
    return replace(part, points1=points1, cost=cost, ratio=ratio, correct=~wrong)


def jitter_keypoints(given: Putatives, sigma_px: float, seed: int) -> Putatives:
    """Move both keypoints of every match by Gaussian noise; a correct match stays correct however far it moves."""
    rng = np.random.default_rng(seed)
    points0, points1 = (p + sigma_px * rng.standard_normal(p.shape) for p in (given.points0, given.points1))
    return replace(given, points0=points0, points1=points1)


def to_matches(found: list[Putatives], *, with_cost: bool = False) -> ts.Matches:
    """All pairs as one ragged batch of float64 keypoints."""
    points0, points1 = (torch.from_numpy(np.concatenate([getattr(p, f"points{v}") for p in found])) for v in (0, 1))
    counts = [len(p.points0) for p in found]
    cost = torch.from_numpy(np.concatenate([p.cost for p in found])) if with_cost else None
    return ts.Matches(points0, points1, torch.tensor([0, *counts]).cumsum(0), cost)


def to_images(found: list[Putatives]) -> list[list[torch.Tensor]]:
    """(1, H, W) uint8 of all pairs, by view."""
    return [[torch.from_numpy(one.views[view])[None] for one in found] for view in (0, 1)]


def _judge(pair: GrayPair, points0: Float, points1: Float, cost: Float, ratio: Float) -> Putatives:
    """The matches of distinct keypoints, with their errors."""
    for view in (0, 1):  # keypoints of several orientations
        distinct = np.unique((points0, points1)[view].round(3), axis=0, return_index=True)[1]
        points0, points1, cost, ratio = points0[distinct], points1[distinct], cost[distinct], ratio[distinct]
    matches = ts.Matches(*map(torch.from_numpy, (points0, points1)), torch.tensor([0, len(points0)]))
    error = errors_against_gt(matches, torch.from_numpy(pair.disparity_gt)[None]).numpy()
    x, y = np.rint(points0).astype(int).T
    truth = pair.disparity_gt[y.clip(0, pair.left.shape[0] - 1), x.clip(0, pair.left.shape[1] - 1)]
    off = np.where(np.isfinite(truth), np.abs(points0[:, 0] - points1[:, 0] - truth), np.nan)
    valid, correct = ~np.isnan(error), error <= MAX_ERROR_PX
    return Putatives(pair.scene, points0, points1, cost, ratio, valid, correct, error, off, (pair.left, pair.right))


def _select(given: Putatives, rows: Bool) -> Putatives:
    names = ("points0", "points1", "cost", "ratio", "valid", "correct", "error_px", "disparity_error_px")
    return replace(given, **{name: getattr(given, name)[rows] for name in names})


def _detect(image: Gray, detector: str) -> tuple[Float, NDArray[np.float32]]:
    if detector == "sift":
        found, descriptors = cv2.SIFT_create(2000).detectAndCompute(image, None)
        return np.array([k.pt for k in found], float), descriptors
    if detector == "surf":
        features = detect_features(torch.from_numpy(image)[None, None], PipelineConfig(detector="surf"))
        return features.keypoints.double().numpy(), features.descriptors.numpy()
    maker = cv2.FastFeatureDetector.create(20) if detector == "fast" else cv2.GFTTDetector.create(1000, 0.01, 3)
    found = maker.detect(image)
    if detector == "fast":
        found = sorted(found, key=lambda k: -k.response)[:2000]
    points, half = np.array([k.pt for k in found], float), WINDOW_PX // 2
    padded = cv2.copyMakeBorder(image, half, half, half, half, cv2.BORDER_REFLECT).astype(np.float32)
    x, y = np.round(points).astype(int).T
    windows = np.lib.stride_tricks.sliding_window_view(padded, (WINDOW_PX, WINDOW_PX))[y, x]
    return points, windows.reshape(len(points), -1)
