"""Matches between images and their warps by a homography, with just the share of wrong ones that is asked for.

View 0 is the left image of a pair, view 1 the same image from another viewpoint, with an exposure and noise of its own.
The truth is exact. Everything follows from the name of the scene.
"""

from __future__ import annotations

import zlib
from fractions import Fraction
from typing import NamedTuple

import cv2
import numpy as np
import torch

import tensor_stereo as ts
from accuracy.putatives import MAX_ERROR_PX, RATIO, Float, GrayPair, Putatives
from shared.homographies import Gray, Viewpoint, local_scale, transform
from tensor_stereo.evaluation import errors_to_partners

_FEATURES, _LEAST_CONTRAST = 2000, 0.01  # of SIFT; a quarter of OpenCV's threshold, for enough wrong candidates


def load_homography_pairs(pairs: list[GrayPair], share_wrong: float) -> list[Putatives]:
    """Putatives of every pair's left image and its warp, of which just ``share_wrong`` are wrong.

    The correct ones pass Lowe's ratio test at .8. The wrong ones are candidates that a matcher really found: first the
    nearest neighbours over all keypoints, the most distinct by ratio first, then those among the keypoints that are
    left, and so on. Where they do not suffice for all correct ones, some of these are left out at random. Errors are in
    px of view 0, and a match is wrong from just above 1 px on. Wrong ones cost far more than correct ones.
    """
    return [_find(pair, Fraction(share_wrong).limit_denominator(1000)) for pair in pairs]


def draw_viewpoint(rng: np.random.Generator) -> Viewpoint:
    """A moderate one, with perspective."""
    return Viewpoint(
        turn_deg=rng.uniform(-45, 45),
        scale=float(np.exp(rng.uniform(np.log(0.6), np.log(1.6)))),
        tilt_deg=rng.uniform(10, 35),
        tilt_axis_deg=rng.uniform(0, 360),
        shift=tuple(rng.uniform(-0.1, 0.1, 2)),
    )


class _Candidates(NamedTuple):
    """Matches as :class:`Putatives` hold them; points are distinct."""

    points0: Float
    points1: Float
    cost: Float
    ratio: Float


def _find(pair: GrayPair, share_wrong: Fraction) -> Putatives:
    rng = np.random.default_rng([20, zlib.crc32(pair.scene.encode())])
    viewpoint = draw_viewpoint(rng)
    views = pair.left, _expose(viewpoint.show(pair.left), rng)
    found = _find_candidates(*views)
    error = _measure(found, viewpoint.homography(pair.left.shape))
    correct = rng.permutation(np.flatnonzero((error <= MAX_ERROR_PX) & (found.ratio < RATIO)))
    wrong = np.flatnonzero(error > MAX_ERROR_PX)
    num_wrong, whole = share_wrong.as_integer_ratio()
    times = min(len(correct) // (whole - num_wrong), len(wrong) // num_wrong)
    rows = np.concatenate([correct[: times * (whole - num_wrong)], wrong[: times * num_wrong]])
    rows = rng.permutation(rows)
    error, valid = error[rows], np.ones(len(rows), bool)
    return Putatives(pair.scene, *(x[rows] for x in found), valid, error <= MAX_ERROR_PX, error, error, views)


def _expose(image: Gray, rng: np.random.Generator) -> Gray:
    levels = np.exp(rng.normal(0, 0.08)) * image + rng.normal(0, 5) + rng.normal(0, 2, image.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def _find_candidates(*views: Gray) -> _Candidates:
    """Nearest neighbours of SIFT, one-to-one by lowest cost, then those of what is left; by ratio within each round."""
    sift = cv2.SIFT_create(_FEATURES, contrastThreshold=_LEAST_CONTRAST, enable_precise_upscale=True)
    detected = [sift.detectAndCompute(view, None) for view in views]
    points = [np.array([keypoint.pt for keypoint in keypoints]) for keypoints, _ in detected]
    places = [np.unique(p.round(3), axis=0, return_inverse=True)[1] for p in points]  # one for several orientations
    first, second = (descriptors for _, descriptors in detected)
    ssd = ((first**2).sum(1)[:, None] + (second**2).sum(1)[None] - 2 * first @ second.T).astype(float).clip(0)
    rounds = []
    left = [np.arange(len(p)) for p in points]
    while min(map(len, left)) >= 2:  # a ratio needs two candidates
        part = ssd[np.ix_(*left)]
        partner = part.argmin(1)
        best, runner_up = np.partition(part, 1, 1)[:, :2].T
        rows = left[0], left[1][partner]
        order = np.argsort(best, kind="stable")
        for view in (0, 1):
            order = order[np.sort(np.unique(places[view][rows[view][order]], return_index=True)[1])]
        ratio = np.sqrt(best / np.maximum(runner_up, 1e-9))
        order = order[np.argsort(ratio[order], kind="stable")]
        rows = tuple(r[order] for r in rows)
        rounds.append((points[0][rows[0]], points[1][rows[1]], best[order], ratio[order]))
        left = [a[~np.isin(p[a], p[r])] for a, p, r in zip(left, places, rows, strict=True)]
    return _Candidates(*map(np.concatenate, zip(*rounds, strict=True)))


def _measure(found: _Candidates, matrix: Float) -> Float:
    points = found.points0, found.points1, transform(matrix, found.points0), local_scale(matrix, found.points0)
    points0, points1, partners, scale = map(torch.from_numpy, points)
    matches = ts.Matches(points0, points1, torch.tensor([0, len(points0)]))
    return errors_to_partners(matches, partners, scale).numpy()
