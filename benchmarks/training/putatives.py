"""Putative matches with truth for the training of the learned score, under many settings.

Real scenes are taken as they are under six fixed settings; all are altered at random: mirrored, resized, cropped,
blurred, with other exposure, and with rows that do not agree. Seeds follow from the variant and from the place of the
scene in the list.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

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
from training.scenes import Scene, Views, read_views

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


def find_putatives(scene: Scene, number: int) -> list[Putatives]:
    """All putatives of one scene, which is the ``number``-th."""
    views, found = read_views(scene), []
    for detector in ("sift", "fast", "gftt") if scene.fold is not None else ():
        for matching in (MatchingConfig(), GATES):
            config = replace(FIXED, detector=detector, matching=matching)
            kind = f"{detector}{' g' if matching is GATES else ''}"
            found.append(judge_matches(scene, kind, True, views, _match(views, config)))
    for variant in range(VARIANTS[scene.domain]):
        rng = np.random.default_rng([5, number, variant])
        altered = alter_views(views, rng)
        if not np.isfinite(altered.disparity0).any():
            continue
        largest_px = float(np.nanmax(altered.disparity0))
        config, backend, gated = _draw_config(rng, largest_px)
        is_moved = rng.random() < MOVED
        if is_moved:
            altered, farthest_px = _move_rows(altered, rng)
            rows = config.matching.max_row_offset_px
            if rows is not None:
                config = replace(config, matching=replace(config.matching, max_row_offset_px=rows + farthest_px))
        matches = _sample_map(altered, config, largest_px) if backend == "sgbm" else _match(altered, config)
        matches = _disturb(matches, altered, rng, gated)
        if matches.num_matches < MIN_MATCHES:
            continue
        kind = f"{config.detector}-{backend}{' g' if gated else ''}{' moved' if is_moved else ''}"
        found.append(judge_matches(scene, kind, False, altered, matches))
    return found


def judge_matches(scene: Scene, kind: str, fixed: bool, views: Views, matches: Matches) -> Putatives:
    """The matches with their errors against the truth of the views."""
    error_px = errors_against_gt(matches, [torch.from_numpy(views.disparity0.copy())])
    images = tuple(torch.from_numpy(x.copy())[None] for x in views[:2])
    return Putatives(scene.name, scene.domain, kind, fixed, scene.least_error_px, matches, images, error_px)


def alter_views(views: Views, rng: np.random.Generator) -> Views:
    """Mirror, turn over, resize, crop, and change noise, blur and exposure, each with some probability."""
    image0, image1, disparity0, disparity1 = views
    if disparity1 is not None and rng.random() < 0.4:  # mirrored views change places
        image0, image1, disparity0 = image1[:, ::-1], image0[:, ::-1], disparity1[:, ::-1]
    if rng.random() < 0.4:
        image0, image1, disparity0 = image0[::-1], image1[::-1], disparity0[::-1]
    image0, image1, disparity0 = (np.ascontiguousarray(x) for x in (image0, image1, disparity0))
    height, width = image0.shape
    if rng.random() < 0.4:
        scale = min(float(np.exp(rng.uniform(np.log(0.7), np.log(2.0)))), max(1000 / width, 0.7))
        size = round(width * scale), round(height * scale)
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        image0, image1 = (cv2.resize(x, size, interpolation=how) for x in (image0, image1))
        disparity0 = cv2.resize(disparity0, size, interpolation=cv2.INTER_NEAREST) * np.float32(size[0] / width)
        width, height = size
    if rng.random() < 0.3:
        rows, columns = int(height * rng.uniform(0.5, 1)), int(width * rng.uniform(0.6, 1))
        y, x = rng.integers(0, height - rows + 1), rng.integers(0, width - columns + 1)
        image0, image1, disparity0 = (a[y : y + rows, x : x + columns] for a in (image0, image1, disparity0))
    if rng.random() < 0.5:
        levels = [x.astype(np.float32) for x in (image0, image1)]
        if rng.random() < 0.3:
            blur_px = rng.uniform(0.3, 1.0)
            levels = [cv2.GaussianBlur(x, (0, 0), blur_px) for x in levels]
        if rng.random() < 0.2:  # the response of another sensor
            levels[1] = 255 * (levels[1] / 255) ** np.exp(rng.normal(0, 0.1))
        levels[1] = np.exp(rng.normal(0, 0.08)) * levels[1] + rng.normal(0, 5)
        noise = rng.uniform(0, 4) if rng.random() < 0.6 else 0
        noisy = [x + noise * rng.normal(0, 1, x.shape) for x in levels]
        image0, image1 = (np.clip(np.rint(x), 0, 255).astype(np.uint8) for x in noisy)
    return Views(image0, image1, disparity0, None)


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


def _draw_config(rng: np.random.Generator, largest_px: float) -> tuple[PipelineConfig, str, bool]:
    detector, backend, _ = SETTINGS[rng.choice(len(SETTINGS), p=[share for *_, share in SETTINGS])]
    count, window = int(rng.choice([500, 1000, 1500, 2000])), int(rng.choice([7, 9, 11, 11, 15]))
    gated = bool(rng.random() < 0.5)
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


def _match(views: Views, config: PipelineConfig) -> Matches:
    images = tuple(torch.from_numpy(x.copy())[None, None] for x in views[:2])
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


def _disturb(matches: Matches, views: Views, rng: np.random.Generator, gated: bool) -> Matches:
    """Leave matches out, make some wrong, move the keypoints of view 1, each with some probability."""
    left, right = matches.keypoints0.numpy(), matches.keypoints1.numpy()
    cost = np.zeros(len(left)) if matches.cost is None else matches.cost.numpy()
    height, width = views.image0.shape
    if rng.random() < 0.25:
        kept = rng.random(len(left)) < rng.uniform(0.2, 1)
        left, right, cost = left[kept], right[kept], cost[kept]
    if rng.random() < 0.2 and len(left) > 10:
        wrong = np.flatnonzero(rng.random(len(left)) < rng.uniform(0.05, 0.5))
        right = right.copy()
        if gated and rng.random() < 0.5:
            shift = rng.uniform(0, np.nanmax(views.disparity0), len(wrong))
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
