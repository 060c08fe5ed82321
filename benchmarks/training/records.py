"""Putative matches with evidence and truth for the training of the learned score, under many settings.

Real scenes: Middlebury 2001, 2006 and MiddEval3 (quarter size), each as it is under six fixed settings, and altered at
random; rendered scenes of many sizes, altered at random. Seeds follow from scene and variant alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
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
    SyntheticConfig,
)
from tensor_stereo.datasets import find_pairs, read_disparity_png, read_pair
from tensor_stereo.datasets.synthetic.rendering import render_scene
from tensor_stereo.evaluation import matches_against_gt
from tensor_stereo.features import to_gray
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.pipeline import Stopwatch, match_pairs
from tensor_stereo.scores import ImageEvidence, measure_images
from tensor_stereo.types import Matches

RELEASES = ("middlebury-2001", "middlebury-2006", "middeval3")
NUM_SYNTHETIC, VARIANTS_REAL, VARIANTS_SYNTHETIC = 100, 30, 4
MAX_ERROR_PX = 1.0
MAX_MATCHES, MIN_MATCHES = 1800, 30
FIXED = PipelineConfig(sift=SIFTConfig(backend="opencv"), gftt=GFTTConfig(backend="opencv"))
SETTINGS: tuple[tuple[Detector, str, float], ...] = (
    ("sift", "opencv", 0.20),
    ("fast", "opencv", 0.28),
    ("gftt", "opencv", 0.22),
    ("sift", "kornia", 0.08),
    ("gftt", "kornia", 0.14),
    ("surf", "mahotas", 0.08),
)  # detector, implementation, share of the variants


class Views(NamedTuple):
    """Grey images (H, W) uint8 and disparities (H, W) float32 px, NaN where unknown; None if not published."""

    image0: NDArray[np.uint8]
    image1: NDArray[np.uint8]
    disparity0: NDArray[np.float32]
    disparity1: NDArray[np.float32] | None


@dataclass(frozen=True)
class Record:
    """The matches of one pair under one setting."""

    scene: str
    detector: str
    gated: bool
    fixed: bool  # one of the six settings that cross-validation looks at
    matches: Matches
    evidence: ImageEvidence
    valid: Tensor  # (M,) bool
    correct: Tensor  # (M,) bool


def read_scenes(root: Path) -> dict[str, Views]:
    scenes = {}
    for files in find_pairs(root):
        if files.dataset not in RELEASES:
            continue
        pair = read_pair(files)
        gray0, gray1 = (to_gray(image[None])[0, 0].numpy() for image in (pair.image0, pair.image1))
        twin = {"disp1.png": "disp5.png", "disp2.png": "disp6.png"}.get(files.disparity_gt.name)
        disparity1 = None if twin is None else read_disparity_png(files.disparity_gt.with_name(twin), files.gt_scale)
        scenes[pair.name] = Views(gray0, gray1, pair.disparity_gt.numpy(), disparity1)
    return scenes


def render_views(number: int) -> Views:
    rng = np.random.default_rng([77, number])
    width = int(rng.choice([400, 450, 520, 640, 800]))
    nearest = float(rng.uniform(2, 14))
    config = SyntheticConfig(
        width_px=width,
        height_px=int(width * rng.uniform(0.7, 0.85)),
        min_disparity_px=nearest,
        max_disparity_px=nearest + float(rng.uniform(0.06, 0.24)) * width,
        noise_levels=float(rng.uniform(0.5, 4)),
        gain=float(rng.uniform(0.85, 1.15)),
        offset_levels=float(rng.uniform(-8, 8)),
    )
    scene = render_scene((77, number), config)
    return Views(
        scene.image0[0].numpy(), scene.image1[0].numpy(), scene.disparity0.numpy(), scene.disparity1.numpy()
    )  # fmt: skip


def alter(views: Views, rng: np.random.Generator) -> Views:
    """Mirror, turn over, resize, crop, and change noise, blur and exposure, each with some probability."""
    image0, image1, disparity0, disparity1 = views
    if disparity1 is not None and rng.random() < 0.4:  # mirrored views change places
        image0, image1, disparity0 = image1[:, ::-1], image0[:, ::-1], disparity1[:, ::-1]
    if rng.random() < 0.4:
        image0, image1, disparity0 = image0[::-1], image1[::-1], disparity0[::-1]
    image0, image1, disparity0 = (np.ascontiguousarray(x) for x in (image0, image1, disparity0))
    height, width = image0.shape
    if rng.random() < 0.4:
        scale = min(float(np.exp(rng.uniform(np.log(0.7), np.log(2.0)))), 1000 / width)
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
        levels[1] = np.exp(rng.normal(0, 0.08)) * levels[1] + rng.normal(0, 5)
        noise = rng.uniform(0, 4) if rng.random() < 0.6 else 0
        noisy = [x + noise * rng.normal(0, 1, x.shape) for x in levels]
        image0, image1 = (np.clip(np.rint(x), 0, 255).astype(np.uint8) for x in noisy)
    return Views(image0, image1, disparity0, None)


def draw_config(rng: np.random.Generator, largest_px: float) -> tuple[PipelineConfig, str, bool]:
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
    return config, f"{detector}-{backend}", gated


def find_matches(views: Views, config: PipelineConfig) -> Matches:
    images = tuple(torch.from_numpy(x.copy())[None, None] for x in views[:2])
    found = match_pairs([images], config, Stopwatch())
    return replace(found, keypoints0=found.keypoints0.double(), keypoints1=found.keypoints1.double())


def disturb(matches: Matches, views: Views, rng: np.random.Generator, gated: bool) -> Matches:
    """Leave matches out, make some wrong, move the keypoints of view 1 by parts of a px, each with some probability."""
    left, right, cost = (x.numpy() for x in (matches.keypoints0, matches.keypoints1, matches.cost))
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
    if rng.random() < 0.15:
        right = (right + rng.normal(0, rng.uniform(0.1, 0.5), right.shape)).clip(0, [width - 1, height - 1])
    if len(left) > MAX_MATCHES:
        kept = np.sort(rng.permutation(len(left))[:MAX_MATCHES])
        left, right, cost = left[kept], right[kept], cost[kept]
    left, right, cost = (torch.from_numpy(np.ascontiguousarray(x)) for x in (left, right, cost))
    return Matches(left, right, torch.tensor([0, len(left)]), cost=cost)


def make_record(scene: str, detector: str, gated: bool, fixed: bool, views: Views, matches: Matches) -> Record:
    images = [torch.from_numpy(x.copy())[None] for x in views[:2]]
    evidence = measure_images(images[:1], images[1:], matches, build_match_graphs(matches))
    disparity_gt = torch.from_numpy(views.disparity0.copy())[None]
    correct, valid = matches_against_gt(matches, disparity_gt, max_error_px=MAX_ERROR_PX)
    return Record(scene, detector, gated, fixed, matches, evidence, valid, correct)


def make_records(scene: str, number: int, views: Views, *, real: bool) -> list[Record]:
    """All records of one scene."""
    records = []
    for detector in ("sift", "fast", "gftt") if real else ():
        for matching in (MatchingConfig(), GATES):
            config = replace(FIXED, detector=detector, matching=matching)
            matches = find_matches(views, config)
            records.append(make_record(scene, detector, matching is GATES, True, views, matches))
    for variant in range(VARIANTS_REAL if real else VARIANTS_SYNTHETIC):
        rng = np.random.default_rng([5, number + 1000 * (not real), variant])
        altered = alter(views, rng)
        if not np.isfinite(altered.disparity0).any():
            continue
        config, name, gated = draw_config(rng, float(np.nanmax(altered.disparity0)))
        matches = disturb(find_matches(altered, config), altered, rng, gated)
        if matches.num_matches >= MIN_MATCHES:
            records.append(make_record(scene, name, gated, False, altered, matches))
    return records
