"""Moving keypoints of view 1 to sub-pixel places by gradients: of image windows, of the filter's score, or of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

import tensor_stereo as ts
from experiments.pseudo_labels import PUTATIVES
from tensor_stereo.batching import ptr_to_batch, select_matches, split_matches
from tensor_stereo.evaluation import matches_against_gt
from tensor_stereo.features import to_gray
from tensor_stereo.pipeline import Stopwatch, match_pairs, to_gray_pairs

COSTS = {  # weights of the window cost and of 1 - score
    "photometric": (1.0, 0.0),
    "photometric + 0.1 (1 - score)": (1.0, 0.1),
    "photometric + (1 - score)": (1.0, 1.0),
    "1 - score": (0.0, 1.0),
}


@dataclass(frozen=True)
class RefinementConfig:
    """Settings of the descent."""

    steps: int = 40
    learning_rate_px: float = 0.05  # Adam's first step; falls to zero along a half cosine
    window_px: int = 11


def refine_pairs(pairs: Sequence[ts.StereoPair], config: RefinementConfig, *, set_name: str) -> list[dict]:
    """Refine the matches that start within 1 px of ground truth, by every cost, along x and along x and y.

    Returns:
        One record per cost and choice of axes with the absolute error of the disparity in px before and after; those
        whose cost has no gradient say so instead.
    """
    matches = match_pairs(to_gray_pairs([(pair.image0, pair.image1) for pair in pairs]), PUTATIVES, Stopwatch())
    correct, _ = matches_against_gt(matches, [pair.disparity_gt for pair in pairs])
    matches = select_matches(matches, correct)
    before = disparity_error(matches, pairs)
    records = []
    for axes in ("x", "xy"):
        for name, weights in COSTS.items():
            record = {"title": "refinement", "set": set_name, "axes": axes, "cost": name, "matches": len(before)}
            parts = [
                refine(pair, part, config, weights=weights, axes=axes)
                for pair, part in zip(pairs, split_matches(matches), strict=True)
            ]
            if any(part is None for part in parts):
                records.append(record | {"skipped": "the score has no gradient"})
                continue
            moved = replace(matches, keypoints1=torch.cat(parts).to(matches.keypoints1.dtype))
            after = disparity_error(moved, pairs)
            records.append(record | {
                "mean_before_px": float(before.mean()), "median_before_px": float(before.median()),
                "mean_after_px": float(after.mean()), "median_after_px": float(after.median()),
                "fraction_better": float((after < before).double().mean()),
            })  # fmt: skip
    return records


def refine(
    pair: ts.StereoPair, matches: ts.Matches, config: RefinementConfig, *, weights: tuple[float, float], axes: str
) -> Tensor | None:
    """Keypoints of view 1 (M, 2) float64 after Adam on the sum of the costs; None if the score has no gradient."""
    image0, image1 = (to_gray(image[None]).double() for image in (pair.image0, pair.image1))
    keypoints0, start = matches.keypoints0.double(), matches.keypoints1.double()
    free = start.new_tensor([1.0, 1.0 if axes == "xy" else 0.0])
    offset = torch.zeros_like(start, requires_grad=True)
    reference = sample_windows(image0, keypoints0, config.window_px)
    judge = ts.DelaunayFilter(verdict="cardinality", score="topology")
    optimizer = torch.optim.Adam([offset], lr=config.learning_rate_px)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.steps)
    for _ in range(config.steps):
        keypoints1 = start + offset * free
        cost = torch.zeros((), dtype=torch.float64)
        if weights[0]:
            windows = sample_windows(image1, keypoints1, config.window_px)
            cost = cost + weights[0] * window_cost(reference, windows).sum()
        if weights[1]:
            agreement = judge(replace(matches, keypoints0=keypoints0, keypoints1=keypoints1)).score
            if not agreement.requires_grad:
                return None
            cost = cost + weights[1] * (1 - agreement).sum()
        optimizer.zero_grad()
        cost.backward()
        optimizer.step()
        schedule.step()
    return (start + offset * free).detach()


def sample_windows(image: Tensor, keypoints: Tensor, window_px: int) -> Tensor:
    """Bilinear grey levels (M, window_px**2) of an image (1, 1, H, W) around keypoints (M, 2); gradients flow."""
    steps = torch.arange(window_px, dtype=keypoints.dtype) - window_px // 2
    rows, columns = torch.meshgrid(steps, steps, indexing="ij")
    places = keypoints[:, None] + torch.stack([columns, rows], -1).view(-1, 2)  # (M, P, 2)
    size = places.new_tensor([image.shape[3], image.shape[2]])
    grid = 2 * places / (size - 1) - 1
    return functional.grid_sample(image, grid[None], padding_mode="border", align_corners=True)[0, 0]


def window_cost(windows0: Tensor, windows1: Tensor) -> Tensor:
    """SSD (M,) of windows less their means, in units of the left window's own: gain and offset differ between views."""
    levels0, levels1 = (w - w.mean(1, keepdim=True) for w in (windows0, windows1))
    return (levels0 - levels1).square().sum(1) / levels0.square().sum(1).clamp(min=1.0)


def disparity_error(matches: ts.Matches, pairs: Sequence[ts.StereoPair]) -> Tensor:
    """|x0 - x1 - ground truth at the left keypoint's pixel|, (M,) float64 px."""
    b, (x, y) = ptr_to_batch(matches.ptr), matches.keypoints0.long().unbind(1)
    truth = torch.cat([pairs[k].disparity_gt[y[b == k], x[b == k]] for k in range(len(pairs))])
    return (matches.keypoints0[:, 0].double() - matches.keypoints1[:, 0].double() - truth).abs()
