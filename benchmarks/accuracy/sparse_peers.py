"""What others do to have more, or finer, sparse matches."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from accuracy.peers import (
    LPM_COST,
    MAGSAC_CONFIDENCE,
    MAGSAC_ERROR_PX,
    MAGSAC_ITERATIONS,
    score_disparity,
    score_lpm,
)
from accuracy.putatives import Putatives
from tensor_stereo.configs import PipelineConfig
from tensor_stereo.features import detect_features
from tensor_stereo.types import Matches

LEAST_SUPPORT = 4 / 6  # of the neighbours have like flow: libviso2's four, of the six that there are on average
LINE_PX = 4.0  # COLMAP's default for guided matching
PATCH_RADIUS_PX, SEARCH_STEPS, SEARCH_PX = 7, 9, 1.0
NUM_NEIGHBORS = 6


class Result(NamedTuple):
    """Matches of one pair, each with a score; higher is more likely right."""

    matches: Matches
    score: torch.Tensor
    repaired: torch.Tensor | None = None  # (M,) bool
    is_probability: bool = False
    keep_at: float = 0.5  # the least score of kept matches

    @property
    def kept(self) -> torch.Tensor:
        """(M,) bool"""
        return self.score >= self.keep_at


def score_neighbors(matches: Matches, name: str) -> Result:
    """LPM's or libviso2's score of one pair, with the threshold of their authors."""
    points = [view.double().numpy() for view in (matches.keypoints0, matches.keypoints1)]
    nothing = np.full(len(points[0]), np.nan)
    flags = np.ones(len(points[0]), bool)
    blank = np.zeros((2, 2), np.uint8)
    given = Putatives("", *points, nothing, nothing, flags, flags, nothing, nothing, (blank, blank))
    if name == "LPM":
        return Result(matches, torch.from_numpy(score_lpm(given)), keep_at=-LPM_COST)
    return Result(matches, torch.from_numpy(score_disparity(given)["libviso2 support"]), keep_at=LEAST_SUPPORT)


def guide_matches(matches: Matches, gray: tuple[torch.Tensor, ...], config: PipelineConfig) -> Result:
    """Keypoints matched again along the epipolar lines that fit the matches, as COLMAP's guided matching does.

    The fundamental matrix is MAGSAC++'s; of the keypoints of view 1 within 4 px of the line the one with the least SSD
    is the partner, one-to-one. Their score is minus the SSD.
    """
    points0, points1 = (view.double().numpy() for view in (matches.keypoints0, matches.keypoints1))
    options = cv2.USAC_MAGSAC, MAGSAC_ERROR_PX, MAGSAC_CONFIDENCE, MAGSAC_ITERATIONS
    fundamental, _ = cv2.findFundamentalMat(points0, points1, *options)
    views = [detect_features(view, config) for view in gray]
    left, right = (view.keypoints.double() for view in views)
    first, second = (view.descriptors.float() for view in views)
    ssd = first.square().sum(1)[:, None] + second.square().sum(1)[None] - 2 * first @ second.T
    if fundamental is not None:
        lines = torch.nn.functional.pad(left, (0, 1), value=1.0) @ torch.from_numpy(fundamental).T
        away = (lines[:, :2] @ right.T + lines[:, 2:]).abs() / lines[:, :2].norm(dim=1, keepdim=True).clamp(min=1e-12)
        ssd = ssd.masked_fill(away > LINE_PX, torch.inf)
    best, partner = ssd.min(1)
    back = ssd.min(0).indices
    rows = (best.isfinite() & (back[partner] == torch.arange(len(left)))).nonzero()[:, 0]
    found = Matches(left[rows], right[partner[rows]], torch.tensor([0, len(rows)]))
    return Result(found, -best[rows].double(), keep_at=-torch.inf)


def refine_by_correlation(matches: Matches, gray: tuple[torch.Tensor, ...], kept: torch.Tensor) -> Matches:
    """Sub-pixel places by cross-correlation after reprojection of patches (Bellavia et al., arXiv 2411.09484).

    The affine map of the nearest kept matches takes the patch around a match of view 0 to view 1; the place within 1 px
    in either direction with the greatest correlation, by a parabola in x and in y, is the refined one.
    """
    rows = kept.nonzero()[:, 0].numpy()
    left, right = (view.double().numpy().copy() for view in (matches.keypoints0, matches.keypoints1))
    if len(rows) <= NUM_NEIGHBORS:
        return matches
    _, near = cKDTree(left[rows]).query(left[rows], NUM_NEIGHBORS + 1)
    images = [view[0, 0].numpy().astype(np.float32) for view in gray]
    y, x = np.mgrid[-PATCH_RADIUS_PX : PATCH_RADIUS_PX + 1, -PATCH_RADIUS_PX : PATCH_RADIUS_PX + 1].astype(np.float64)
    offsets = np.stack([x.ravel(), y.ravel()], 1)
    shifts = np.linspace(-SEARCH_PX, SEARCH_PX, SEARCH_STEPS)

    def patch(image: np.ndarray, places: np.ndarray) -> np.ndarray:
        found = cv2.remap(
            image,
            *(places[..., k].astype(np.float32) for k in (0, 1)),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        found = found.reshape(found.shape[0], -1) - found.reshape(found.shape[0], -1).mean(1, keepdims=True)
        return found / np.linalg.norm(found, axis=1, keepdims=True).clip(1e-6)

    for k, row in enumerate(rows):
        others = rows[near[k][1:]]
        way0, way1 = left[others] - left[row], right[others] - right[row]
        ridge = 1e2 * np.eye(2)
        affine = np.linalg.solve(way0.T @ way0 + ridge, way0.T @ way1 + ridge).T
        anchor = patch(images[0], (left[row] + offsets)[None])
        grid = np.stack(np.meshgrid(shifts, shifts), 2).reshape(-1, 1, 2)
        places = right[row] + grid + offsets @ affine.T
        likeness = (patch(images[1], places) @ anchor[0]).reshape(SEARCH_STEPS, SEARCH_STEPS)
        iy, ix = np.unravel_index(likeness.argmax(), likeness.shape)
        step = [_parabola(likeness[iy], ix), _parabola(likeness[:, ix], iy)]
        right[row] += [shifts[ix] + step[0] * (shifts[1] - shifts[0]), shifts[iy] + step[1] * (shifts[1] - shifts[0])]
    return Matches(matches.keypoints0, torch.from_numpy(right).to(matches.keypoints1.dtype), matches.ptr, matches.cost)


def _parabola(values: np.ndarray, k: int) -> float:
    if not 0 < k < len(values) - 1:
        return 0.0
    before, here, after = values[k - 1 : k + 2]
    bend = before - 2 * here + after
    return 0.0 if bend >= -1e-9 else float(np.clip((before - after) / (2 * bend), -0.5, 0.5))
