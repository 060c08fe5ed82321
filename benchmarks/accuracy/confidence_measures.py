"""Classic measures of stereo confidence, each (H, W), higher is better (Hu & Mordohai, PAMI 34(11), 2012)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tensor_stereo.dense.matching_costs import CostCurves

Floats = NDArray[np.float32]


def left_right(disparity: Floats, disparity1: Floats) -> Floats:
    """How far the map of view 1 agrees; what it does not know counts as far off."""
    columns = np.arange(disparity.shape[1])
    partner = np.clip(np.rint(columns - np.nan_to_num(disparity)), 0, disparity.shape[1] - 1).astype(np.int64)
    return -np.nan_to_num(np.abs(np.take_along_axis(disparity1, partner, 1) - disparity), nan=1e3)


def variance(disparity: Floats, window: int) -> Floats:
    """Less the variance of the known disparities of a window."""
    known = np.isfinite(disparity).astype(np.float32)
    level = np.nan_to_num(disparity - np.nanmean(disparity))
    count, first, second = (cv2.blur(v, (window, window)) for v in (known, level, level * level))
    mean = first / np.maximum(count, 1e-6)
    return mean * mean - second / np.maximum(count, 1e-6)


def agreement(disparity: Floats, window: int) -> Floats:
    """Share of the pixels of a window whose disparity differs by at most one pixel."""
    radius = window // 2
    padded = np.pad(disparity, radius, constant_values=np.nan)
    height, width = disparity.shape
    agree = np.zeros((height, width), np.float32)
    for y in range(window):
        for x in range(window):
            agree += np.abs(padded[y : y + height, x : x + width] - disparity) <= 1
    return agree / window**2


def median_deviation(disparity: Floats, window: int) -> Floats:
    """Less the distance to the median of the window; what is unknown counts as zero there."""
    filled = np.nan_to_num(disparity)
    steps = np.clip(np.rint(filled), 0, 255).astype(np.uint8)
    return -np.abs(filled - cv2.medianBlur(steps, window).astype(np.float32))


def matching_score(curves: CostCurves, kind: int, disparity: Floats) -> Floats:
    """Less the cost at the estimate."""
    return -_at(curves, kind, disparity)


def peak_ratio(curves: CostCurves, kind: int, disparity: Floats) -> Floats:
    """Least cost of the disparities that differ by more than a pixel, over that at the estimate."""
    here = _at(curves, kind, disparity)
    rival = np.full(disparity.shape, 255, np.float32)
    nearest = np.rint(np.nan_to_num(disparity, nan=curves.first)) - curves.first
    for k, cost in enumerate(curves.costs[kind]):
        np.minimum(rival, cost, out=rival, where=np.abs(nearest - k) > 1)
    return (rival + 1) / (here + 1)


def _at(curves: CostCurves, kind: int, disparity: Floats) -> Floats:
    costs = curves.costs[kind]
    place = np.clip(np.rint(np.nan_to_num(disparity, nan=curves.first)) - curves.first, 0, len(costs) - 1)
    return np.take_along_axis(costs, place.astype(np.int64)[None], 0)[0].astype(np.float32)
