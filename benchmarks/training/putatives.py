"""Putative matches with truth for the training of the learned score, under many settings.

Real scenes are taken as they are under six fixed settings; all are altered at random: mirrored, resized, cropped,
blurred, with other exposure, and with rows that do not agree. Seeds follow from the variant and from the place of the
scene in the list.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from shared.scenes import GATES
from tensor_stereo.configs import (
    Detector,
    FASTConfig,
    GFTTConfig,
    MatchingConfig,
    PipelineConfig,
    SIFTConfig,
    SURFConfig,
)
from tensor_stereo.evaluation.truth import errors_against_gt
from tensor_stereo.features import detect_features
from tensor_stereo.pipeline import Stopwatch, match_pairs
from tensor_stereo.types import Matches
from training.alterations import alter
from training.scenes import Gray, Scene, Views, read_views

VARIANTS = {"middlebury": 30, "eth3d": 30, "kitti": 8, "rendered": 12, "synthetic": 4}
MAX_MATCHES, MIN_MATCHES = 1800, 30
MOVED = 0.35  # share of the variants whose rows do not agree
FIXED = PipelineConfig(sift=SIFTConfig(backend="opencv"), gftt=GFTTConfig(backend="opencv"))
SETTINGS: tuple[tuple[Detector, str, float], ...] = (
    ("sift", "opencv", 0.18),
    ("fast", "opencv", 0.25),
    ("gftt", "opencv", 0.20),
    ("sift", "kornia", 0.08),
    ("gftt", "kornia", 0.12),
    ("surf", "mahotas", 0.07),
    ("fast", "sgbm", 0.10),
)  # detector, implementation or matcher, share of the variants


@dataclass(frozen=True)
class Putatives:
    """The matches of one pair under one setting, with the images that they were found in.

    ``error_px`` is the larger of the errors of disparity and row, NaN where the truth is unknown; labels of tolerances
    below ``least_error_px`` are not to be trusted.
    """

    scene: str
    domain: str
    kind: str
    fixed: bool  # one of the six settings that cross-validation looks at
    least_error_px: float
    matches: Matches
    images: tuple[Tensor, Tensor]  # (1, H, W) uint8
    error_px: Tensor  # (M,)
    repaired: Tensor | None = None  # (M,) bool, None: none is


class Found(NamedTuple):
    """Matches under one setting, with the views that they were found in."""

    kind: str
    fixed: bool
    views: Views
    matches: Matches


def find_putatives(scene: Scene, number: int) -> list[Putatives]:
    """All putatives of one scene, which is the ``number``-th."""
    return [judge_matches(scene, *found) for found in find_matches(scene, number)]


def find_matches(scene: Scene, number: int, num_altered: int | None = None) -> Iterator[Found]:
    """The matches of one scene, and of ``num_altered`` variants of it; None: of all."""
    views = read_views(scene)
    for detector in ("sift", "fast", "gftt") if scene.fold is not None else ():
        for matching in (MatchingConfig(), GATES):
            config = replace(FIXED, detector=detector, matching=matching)
            kind = f"{detector}{' g' if matching is GATES else ''}"
            yield Found(kind, True, views, match(*views[:2], config))
    for variant in range(VARIANTS[scene.domain] if num_altered is None else num_altered):
        rng = np.random.default_rng([5, number, variant])
        altered = alter(views, rng)
        if not np.isfinite(altered.disparity0).any():
            continue
        largest_px = float(np.nanmax(altered.disparity0))
        config, backend, gated = draw_config(rng, largest_px)
        is_moved = rng.random() < MOVED
        if is_moved:
            altered, farthest_px = _move_rows(altered, rng)
            rows = config.matching.max_row_offset_px
            if rows is not None:
                config = replace(config, matching=replace(config.matching, max_row_offset_px=rows + farthest_px))
        matches = _sample_map(altered, config, largest_px) if backend == "sgbm" else match(*altered[:2], config)
        matches = disturb(matches, altered.image1.shape, rng, largest_px if gated else None)
        if matches.num_matches < MIN_MATCHES:
            continue
        kind = f"{config.detector}-{backend}{' g' if gated else ''}{' moved' if is_moved else ''}"
        yield Found(kind, False, altered, matches)


def judge_matches(scene: Scene, kind: str, fixed: bool, views: Views, matches: Matches) -> Putatives:
    """The matches with their errors against the truth of the views."""
    error_px = errors_against_gt(matches, [torch.from_numpy(views.disparity0.copy())])
    images = tuple(torch.from_numpy(x.copy())[None] for x in views[:2])
    return Putatives(scene.name, scene.domain, kind, fixed, scene.least_error_px, matches, images, error_px)


def _move_rows(views: Views, rng: np.random.Generator) -> tuple[Views, float]:
    """View 1 with other rows, y + a + b x + c y, as of a rig that is not quite calibrated; and the largest shift."""
    height, width = views.image1.shape
    a = rng.uniform(-8, 8) if rng.random() < 0.4 else rng.normal(0, 1)
    b, c = rng.uniform(-0.02, 0.02, 2) if rng.random() < 0.4 else (0.0, 0.0)
    center = a + b * width / 2 + c * height / 2
    a += np.clip(center, -8, 8) - center
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    before = ((y - a - b * x) / (1 + c)).astype(np.float32)
    moved = cv2.remap(views.image1, x, before, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return views._replace(image1=moved), float(np.abs(y - before).max())


def draw_config(
    rng: np.random.Generator, largest_px: float | None, settings: Sequence[tuple[Detector, str, float]] = SETTINGS
) -> tuple[PipelineConfig, str, bool]:
    """Random settings of detector and matcher; implementation or matcher; whether rows and disparities are gated.

    Gates let disparities up to ``largest_px`` through; None: there are none, as for views that are not rectified.
    """
    detector, backend, _ = settings[rng.choice(len(settings), p=[share for *_, share in settings])]
    count, window = int(rng.choice([500, 1000, 1500, 2000])), int(rng.choice([7, 9, 11, 11, 15]))
    gated = bool(rng.random() < 0.5) and largest_px is not None
    matching = MatchingConfig(mutual=bool(rng.random() < 0.2))
    if gated:
        farthest = float(max(largest_px + 2, rng.choice([64, 128, 128, 192, 256])))
        rows = float(rng.choice([0, 1, 1, 1, 2, 3]))
        matching = replace(matching, max_row_offset_px=rows, min_disparity_px=0.0, max_disparity_px=farthest)
    config = PipelineConfig(
        detector=detector,
        matching=matching,
        fast=FASTConfig(int(rng.choice([10, 15, 20, 20, 30])), max_keypoints=count, window_px=window),
        gftt=GFTTConfig(
            backend="kornia" if backend == "kornia" else "opencv",
            quality_level=float(rng.choice([0.005, 0.01, 0.01, 0.03])),
            min_distance_px=int(rng.choice([2, 3, 3, 5])),
            max_keypoints=count,
            window_px=window,
        ),
        sift=SIFTConfig(
            backend="kornia" if backend == "kornia" else "opencv",
            max_keypoints=count,
            max_ratio=float(rng.choice([0.7, 0.8, 0.8, 0.9, 0.95])),
        ),
        surf=SURFConfig(max_keypoints=min(count, 1000)),
    )
    return config, backend, gated


def match(image0: Gray, image1: Gray, config: PipelineConfig) -> Matches:
    """Putative matches of two grey images (H, W), of any sizes; float64 keypoints."""
    images = tuple(torch.from_numpy(x.copy())[None, None] for x in (image0, image1))
    found = match_pairs([images], config, Stopwatch())
    return replace(found, keypoints0=found.keypoints0.double(), keypoints1=found.keypoints1.double())


def _sample_map(views: Views, config: PipelineConfig, largest_px: float) -> Matches:
    """The disparities of OpenCV's semi-global matching at keypoints; they have no cost."""
    span = min(16 * (int(largest_px * 1.2) // 16 + 1), 384)
    matcher = cv2.StereoSGBM.create(
        0, span, 5, P1=200, P2=800, disp12MaxDiff=1, uniquenessRatio=5, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY
    )
    disparity = matcher.compute(*views[:2]).astype(np.float64) / 16
    points = detect_features(torch.from_numpy(views.image0.copy())[None, None], config).keypoints.double()
    x, y = points.round().long().T
    found = torch.from_numpy(disparity)[y, x]
    points, found = points[found >= 0], found[found >= 0]
    right = points - torch.stack([found, torch.zeros_like(found)], 1)
    return Matches(points, right, torch.tensor([0, len(points)]))


def disturb(
    matches: Matches, size: tuple[int, ...], rng: np.random.Generator, largest_px: float | None = None
) -> Matches:
    """Leave matches out, make some wrong, move the keypoints of view 1, each with some probability.

    ``size`` is (height, width) of view 1. Wrong partners come from other matches, or lie on the row of the keypoint of
    view 0 at a disparity of at most ``largest_px`` unless that is None.
    """
    left, right = matches.keypoints0.numpy(), matches.keypoints1.numpy()
    cost = np.zeros(len(left)) if matches.cost is None else matches.cost.numpy()
    height, width = size
    if rng.random() < 0.25:
        kept = rng.random(len(left)) < rng.uniform(0.2, 1)
        left, right, cost = left[kept], right[kept], cost[kept]
    if rng.random() < 0.2 and len(left) > 10:
        wrong = np.flatnonzero(rng.random(len(left)) < rng.uniform(0.05, 0.5))
        right = right.copy()
        if largest_px is not None and rng.random() < 0.5:
            shift = rng.uniform(0, largest_px, len(wrong))
            right[wrong] = np.stack([left[wrong, 0] - shift, right[wrong, 1]], 1)
        else:
            right[wrong] = right[rng.permutation(wrong)]
        inside = right[:, 0] >= 0
        left, right, cost = left[inside], right[inside], cost[inside]
    if rng.random() < 0.2:
        sigma_px = np.exp(rng.uniform(np.log(0.1), np.log(2)))
        right = (right + rng.normal(0, sigma_px, right.shape)).clip(0, [width - 1, height - 1])
    if len(left) > MAX_MATCHES:
        kept = np.sort(rng.permutation(len(left))[:MAX_MATCHES])
        left, right, cost = left[kept], right[kept], cost[kept]
    left, right, cost = (torch.from_numpy(np.ascontiguousarray(x)) for x in (left, right, cost))
    return Matches(left, right, torch.tensor([0, len(left)]), cost=None if matches.cost is None else cost)
