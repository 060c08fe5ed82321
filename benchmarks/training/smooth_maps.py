"""Disparity maps whose errors are smooth, of other kinds than semi-global matching's, and truth with such errors."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]
Floats = NDArray[np.float32]

_GUIDE_RADIUS, _GUIDE_EDGE = 9, 6.5  # px; grey levels below which an edge of the guide does not count
_LEAST_SEGMENT = 60  # pixels that a plane needs
_FIT_ROUNDS, _FIT_PX = 5, 2.0  # of the plane of a segment: rounds, and residual of half the weight


def guided(costs: Floats, image: Gray) -> Floats:
    """Costs (K, H, W) averaged where the image is even (Hosni et al., PAMI 35(2), 2013, with He et al.'s filter)."""
    size = (2 * _GUIDE_RADIUS + 1,) * 2
    guide = image.astype(np.float32)
    mean = cv2.blur(guide, size)
    variance = cv2.blur(guide * guide, size) - mean * mean + _GUIDE_EDGE**2
    found = np.empty_like(costs)
    for k, cost in enumerate(costs):
        level = cv2.blur(cost, size)
        slope = (cv2.blur(cost * guide, size) - mean * level) / variance
        found[k] = cv2.blur(slope, size) * guide + cv2.blur(level - slope * mean, size)
    return found


def filled(disparity: Floats, disparity1: Floats) -> Floats:
    """A local method's usual end: what the other view contradicts takes the lower neighbour of its row; a median."""
    columns = np.arange(disparity.shape[1])
    partner = np.clip(np.rint(columns - disparity), 0, disparity.shape[1] - 1).astype(np.int64)
    agrees = np.abs(np.take_along_axis(disparity1, partner, 1) - disparity) <= 1
    return np.asarray(cv2.medianBlur(fill_rows(np.where(agrees, disparity, np.nan).astype(np.float32)), 5))


def fill_rows(disparity: Floats) -> Floats:
    """Unknown pixels take the lower of the known values to their left and right, the row above where there is none.

    >>> fill_rows(np.array([[np.nan, 3, np.nan, 2]], np.float32))
    array([[3., 3., 2., 2.]], dtype=float32)
    """
    known = np.isfinite(disparity)
    width = disparity.shape[1]
    columns = np.arange(width)
    before = np.maximum.accumulate(np.where(known, columns, -1), 1)
    after = np.minimum.accumulate(np.where(known, columns, width)[:, ::-1], 1)[:, ::-1]
    sides = [
        np.where(
            (at >= 0) & (at < len(columns)), np.take_along_axis(disparity, at.clip(0, len(columns) - 1), 1), np.inf
        )
        for at in (before, after)
    ]
    found = np.minimum(*sides)
    lone = ~np.isfinite(found[:, 0])  # rows without any
    if lone.all():
        return np.zeros_like(disparity)
    nearest = np.flatnonzero(~lone)[np.abs(np.flatnonzero(~lone)[:, None] - np.arange(len(lone))).argmin(0)]
    return found[nearest].astype(np.float32)


def planes(disparity: Floats, image: Gray) -> Floats:
    """A plane for every even segment of the image, by weights that spare outliers (after Klaus et al., ICPR 2006)."""
    even = cv2.bilateralFilter(image, 9, 18, 5) // 8
    segment, count = np.zeros(image.shape, np.int64), 0
    for level in range(32):
        number, label = cv2.connectedComponents((even == level).astype(np.uint8), connectivity=4)
        segment[label > 0] = label[label > 0] + count
        count += number
    y, x = (axis.astype(np.float64).ravel() / 100 for axis in np.indices(image.shape))
    rows, target, at = np.stack([x, y, np.ones_like(x)]), disparity.ravel().astype(np.float64), segment.ravel()
    weight, fitted = np.ones_like(target), target
    for _ in range(_FIT_ROUNDS):
        moments = np.stack([np.bincount(at, weight * a * b, count + 1) for a in rows for b in (*rows, target)])
        moments = moments.reshape(3, 4, -1).transpose(2, 0, 1)
        plane = np.linalg.solve(moments[:, :, :3] + 1e-3 * np.eye(3), moments[:, :, 3:])[..., 0]
        fitted = (plane[at] * rows.T).sum(1)
        weight = 1 / (1 + ((target - fitted) / _FIT_PX) ** 2)
    large = np.bincount(at, minlength=count + 1)[at] >= _LEAST_SEGMENT
    low, high = np.quantile(target, [0.01, 0.99])
    found = np.where(large, fitted.clip(low, high), cv2.medianBlur(disparity, 5).ravel())
    return found.reshape(image.shape).astype(np.float32)


def altered(truth: Floats, image: Gray, rng: np.random.Generator) -> Floats:
    """Truth with the errors of networks: objects grown or shrunk, regions that drift, bridged holes, little noise."""
    found = fill_rows(truth)
    size = 2 * int(rng.integers(1, 9)) + 1
    for grow in (cv2.dilate, cv2.erode):
        changed = grow(found, np.ones((size, size), np.uint8))
        found = np.where(_patches(found.shape, rng, rng.uniform(20, 60)) > rng.uniform(0.2, 1.2), changed, found)
    contrast = cv2.blur(np.abs(cv2.Laplacian(image, cv2.CV_32F)), (9, 9))
    even = contrast < np.quantile(contrast, rng.uniform(0.1, 0.6))
    for strength in (rng.uniform(0.3, 2), rng.uniform(2, 12)):
        where = _patches(found.shape, rng, rng.uniform(15, 60)) > np.where(even, 0.6, 1.8)
        drift = strength * _patches(found.shape, rng, rng.uniform(15, 80))
        found = found + drift * cv2.GaussianBlur(where.astype(np.float32), (0, 0), rng.uniform(1, 6))
    hole = _patches(found.shape, rng, rng.uniform(10, 30)) > rng.uniform(1.2, 2)
    blurred, weight = (cv2.GaussianBlur(v.astype(np.float32), (0, 0), 15) for v in (np.where(hole, 0, found), ~hole))
    found = np.where(hole & (weight > 0.01), blurred / np.maximum(weight, 0.01), found)
    found = found + rng.uniform(0.02, 0.4) * _patches(found.shape, rng, rng.uniform(0.6, 3))
    return np.maximum(found, 0).astype(np.float32)


def _patches(shape: tuple[int, ...], rng: np.random.Generator, size_px: float) -> Floats:
    """Smooth noise of deviation 1."""
    coarse = tuple(max(int(np.ceil(2 * length / size_px)), 2) for length in shape)
    noise = rng.standard_normal(coarse).astype(np.float32)
    return np.asarray(cv2.resize(noise, shape[::-1], interpolation=cv2.INTER_CUBIC)) / np.float32(0.75)
