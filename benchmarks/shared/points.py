"""Made-up keypoints of matches, the same in every run."""

from __future__ import annotations

import numpy as np
import torch

import tensor_stereo as ts


def random_points(kind: str, count: int, seed: int = 0) -> np.ndarray:
    """``count`` distinct points on a 640 x 480 image: uniform float64, or integer pixels."""
    rng = np.random.default_rng([seed, count])
    if kind == "float":
        return rng.random((count, 2)) * [640, 480]
    width = max(640, int(np.sqrt(8 * count)))
    cells = rng.choice(width * width * 3 // 4, size=count, replace=False)
    return np.stack([cells % width, cells // width], 1).astype(np.float64)


def matched_points(kind: str, count: int, seed: int = 0, wrong: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Points of both views: a match that is wrong with probability ``wrong`` has a random point in view 1."""
    left = random_points(kind, count, seed)
    rng = np.random.default_rng([seed, count, 1])
    disparity = 20 + 30 * np.sin(left[:, 0] / 200) * np.cos(left[:, 1] / 150)
    right = left - np.stack([disparity, np.zeros(count)], 1)
    if kind == "integer":
        right = np.round(right)
    bad = rng.random(count) < wrong
    right[bad] = random_points(kind, count, seed + 1)[bad]
    return left, right


def matched_batch(kind: str, pairs: int, count: int) -> ts.Matches:
    """A batch of ``pairs`` pairs of :func:`matched_points`, always the same ones."""
    views = zip(*(matched_points(kind, count, 10 * b) for b in range(pairs)), strict=True)
    left, right = (torch.from_numpy(np.concatenate(view)) for view in views)
    return ts.Matches(left, right, torch.arange(pairs + 1) * count)
