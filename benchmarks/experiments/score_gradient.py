"""What the gradient of a score is worth: keypoints of view 1 are moved by it, beside a comparison of image windows.

    python benchmarks/experiments/score_gradient.py

Matches that are right within 1 px start with noise; Adam lowers the distance of their image windows plus a weight times
1 - score. Weights are chosen on scenes of Middlebury 2006, figures are those of the paper's eight; the spread is that
over five draws of the noise.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

import tensor_stereo as ts
from tensor_stereo.batching import select_matches
from tensor_stereo.configs import FASTConfig, MatchingConfig, PipelineConfig
from tensor_stereo.evaluation import errors_against_gt
from tensor_stereo.features import to_gray
from tensor_stereo.pipeline import Stopwatch, match_pairs, to_gray_pairs
from tensor_stereo.types import Matches, StereoPair

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from accuracy.putatives import GrayPair, load_pairs
from shared.harness import Suite

PUTATIVES = PipelineConfig(
    detector="fast",
    fast=FASTConfig(threshold=10),
    matching=MatchingConfig(max_row_offset_px=1, min_disparity_px=0, max_disparity_px=78),
)
SEEDS = range(5)
NOISE_PX = (0.3, 1.0)  # standard deviation in x and y of the start
WEIGHTS = (0.1, 0.3, 1.0)
SCORES = ("topology", "consensus", "learned", "learned, all tolerances")
WINDOWS = "windows"
_TOLERANCE_PX = 1.0


@dataclass(frozen=True)
class DescentConfig:
    """Settings of the descent."""

    steps: int = 40
    learning_rate_px: float = 0.05  # Adam's first step; falls to zero along a half cosine
    window_px: int = 11


class Cost(NamedTuple):
    """Weights of the window distance and of 1 - score."""

    windows: float
    score: float
    name: str = ""  # of the score


def list_costs(weights: Sequence[float] = WEIGHTS) -> list[Cost]:
    """The windows alone, with each score at each weight, and each score alone."""
    both = [Cost(1.0, weight, name) for name in SCORES for weight in weights]
    return [Cost(1.0, 0.0), *both, *(Cost(0.0, 1.0, name) for name in SCORES)]


def find_matches(pair: StereoPair) -> Matches:
    """Those of the putative matches that are right within 1 px, and all that are wrong: scores see both."""
    assert pair.disparity_gt is not None
    matches = match_pairs(to_gray_pairs([(pair.image0, pair.image1)]), PUTATIVES, Stopwatch())
    known = errors_against_gt(matches, pair.disparity_gt[None]).isfinite()
    return select_matches(matches, known)


def descend(pair: StereoPair, matches: Matches, start: Tensor, cost: Cost, config: DescentConfig) -> Tensor:
    """Keypoints of view 1 (M, 2) float64 after Adam on the sum of the costs.

    Args:
        pair: its images.
        matches: M matches of one pair.
        start: (M, 2) where the keypoints of view 1 begin.
        cost: what is lowered.
        config: how.
    """
    image0, image1 = (to_gray(image[None]).double() for image in (pair.image0, pair.image1))
    keypoints0, offset = matches.keypoints0.double(), torch.zeros_like(start, requires_grad=True)
    reference = sample_windows(image0, keypoints0, config.window_px)
    judge = make_judge(cost.name) if cost.score else None
    optimizer = torch.optim.Adam([offset], lr=config.learning_rate_px)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.steps)
    for _ in range(config.steps):
        total = torch.zeros((), dtype=torch.float64)
        if cost.windows:
            windows = sample_windows(image1, start + offset, config.window_px)
            total = total + cost.windows * window_distance(reference, windows).sum()
        if judge is not None:
            moved = replace(matches, keypoints0=keypoints0, keypoints1=start + offset)
            images = {"images0": [pair.image0], "images1": [pair.image1]} if "learned" in cost.name else {}
            output = judge(moved, **images)
            score = output.cumulative if cost.name == SCORES[-1] else output.score
            total = total + cost.score * (1 - score).reshape(len(start), -1).mean(1).sum()
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        schedule.step()
    return (start + offset).detach()


def make_judge(name: str) -> ts.DelaunayFilter:
    if name == "topology":
        return ts.DelaunayFilter(verdict="cardinality", score="topology")
    return ts.DelaunayFilter(score="consensus" if name == "consensus" else "learned")


def sample_windows(image: Tensor, keypoints: Tensor, window_px: int) -> Tensor:
    """Bilinear grey levels (M, window_px**2) of an image (1, 1, H, W) around keypoints (M, 2); gradients flow."""
    steps = torch.arange(window_px, dtype=keypoints.dtype) - window_px // 2
    rows, columns = torch.meshgrid(steps, steps, indexing="ij")
    places = keypoints[:, None] + torch.stack([columns, rows], -1).view(-1, 2)  # (M, P, 2)
    size = places.new_tensor([image.shape[3], image.shape[2]])
    grid = 2 * places / (size - 1) - 1
    return functional.grid_sample(image, grid[None], padding_mode="border", align_corners=True)[0, 0]


def window_distance(windows0: Tensor, windows1: Tensor) -> Tensor:
    """SSD (M,) of windows less their means, in units of the left window's own: gain and offset differ between views."""
    levels0, levels1 = (w - w.mean(1, keepdim=True) for w in (windows0, windows1))
    return (levels0 - levels1).square().sum(1) / levels0.square().sum(1).clamp(min=1.0)


def measure(pair: StereoPair, cost: Cost, noise_px: float, seed: int, config: DescentConfig) -> dict[str, float]:
    """Errors of the disparity of the right matches before and after, and the share that ends beyond 1 px."""
    assert pair.disparity_gt is not None
    matches = find_matches(pair)
    truth = pair.disparity_gt[None]
    right = errors_against_gt(matches, truth) <= _TOLERANCE_PX
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(matches.keypoints1.shape, generator=generator, dtype=torch.float64) * noise_px
    start = matches.keypoints1.double() + noise
    end = descend(pair, matches, start, cost, config)
    before, after = (disparity_error(matches, points, pair)[right] for points in (start, end))
    return {
        "matches": float(len(before)),
        "before_px": float(before.mean()),
        "after_px": float(after.mean()),
        "median_after_px": float(after.median()),
        "bad_before": float((before > _TOLERANCE_PX).double().mean()),
        "bad_after": float((after > _TOLERANCE_PX).double().mean()),
    }


def disparity_error(matches: Matches, keypoints1: Tensor, pair: StereoPair) -> Tensor:
    """|x0 - x1 - ground truth at the left keypoint's pixel|, (M,) float64 px."""
    assert pair.disparity_gt is not None
    x, y = matches.keypoints0.round().long().unbind(1)
    return (matches.keypoints0[:, 0].double() - keypoints1[:, 0] - pair.disparity_gt[y, x].double()).abs()


def run(pairs: Sequence[StereoPair], task: tuple[Cost, float, int]) -> dict[str, float]:
    """Means over the pairs of one cost, noise and seed."""
    torch.set_num_threads(1)
    rows = [measure(pair, *task, DescentConfig()) for pair in pairs]
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def to_pair(pair: GrayPair) -> StereoPair:
    views = (torch.from_numpy(view)[None] for view in (pair.left, pair.right))
    return StereoPair(pair.scene, *views, torch.from_numpy(pair.disparity_gt).float())


def main() -> None:
    suite = Suite("score_gradient")
    groups = load_pairs(suite.options.data)
    training = [to_pair(pair) for pair in groups["training"]][::4]
    eight = [to_pair(pair) for pair in groups["eight"]]
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        for noise_px in NOISE_PX:
            tried = [(cost, noise_px, 0) for cost in list_costs()]
            found = pool.map(partial(run, training), tried, chunksize=1)
            chosen = [Cost(1.0, 0.0)]
            for name in SCORES:
                of_score = [
                    (row["after_px"], cost) for row, (cost, *_) in zip(found, tried, strict=True) if cost.name == name
                ]
                chosen += [min((error, cost) for error, cost in of_score if cost.windows)[1], Cost(0.0, 1.0, name)]
            for row, (cost, *_) in zip(found, tried, strict=True):
                suite.records.append({"set": "training", "noise_px": noise_px, **cost._asdict(), **row})
            tasks = [(cost, noise_px, seed) for cost in chosen for seed in SEEDS]
            judged = pool.map(partial(run, eight), tasks, chunksize=1)
            base = np.array([row["after_px"] for row in judged[: len(SEEDS)]])
            for k, cost in enumerate(chosen):
                rows = judged[k * len(SEEDS) : (k + 1) * len(SEEDS)]
                after = np.array([row["after_px"] for row in rows])
                mean = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
                gain = base - after
                record = {"set": "eight", "noise_px": noise_px, **cost._asdict(), **mean}
                record |= {"spread_px": float(after.std(ddof=1)), "gain_px": float(gain.mean())}
                record["gain_spread_px"] = float(gain.std(ddof=1))
                suite.records.append(record)
                text = "  ".join(
                    f"{key} {record[key]:.4f}"
                    for key in ("before_px", "after_px", "gain_px", "gain_spread_px", "bad_before", "bad_after")
                )
                print(
                    f"noise {noise_px} px, windows {cost.windows:g} + {cost.score:g} {cost.name:24} {text}", flush=True
                )
    suite.write()


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
