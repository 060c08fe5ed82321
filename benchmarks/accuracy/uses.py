"""What kept matches are used for: dense maps and epipolar geometry, against ground truth."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from accuracy.putatives import GrayPair
from tensor_stereo.dense import interpolate_disparity
from tensor_stereo.types import Matches

BAD_PX = 2.0
GRID_PX = 8  # of ground-truth correspondences for the epipolar distance
RANSAC_ERROR_PX, CONFIDENCE = 1.0, 0.999
FITS = {"8-point": cv2.FM_8POINT, "LMedS": cv2.FM_LMEDS, "RANSAC": cv2.FM_RANSAC}


def is_known(truth: np.ndarray) -> np.ndarray:
    return np.isfinite(truth) & (truth > 0)


def map_errors(
    pair: GrayPair, matches: Matches, kept: torch.Tensor, max_step_px: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The dense map, 0 without any anchor, and its absolute errors where the ground truth is known."""
    truth = pair.disparity_gt
    dense = interpolate_disparity(matches, truth.shape, inlier=kept, max_step_px=max_step_px)
    found = dense[0, 0].nan_to_num(0).numpy()
    return found, np.abs(found - truth)[is_known(truth)]


def epipolar_distances(pair: GrayPair, matches: Matches, kept: torch.Tensor) -> dict[str, float]:
    """Mean symmetric epipolar distance of true correspondences in px, for each way to fit; infinite if it fails."""
    height, width = pair.disparity_gt.shape
    y, x = (axis.ravel() for axis in np.mgrid[0:height:GRID_PX, 0:width:GRID_PX])
    disparity = pair.disparity_gt[y, x]
    known = is_known(disparity)
    ones = np.ones(int(known.sum()))
    truth0 = np.stack([x[known], y[known], ones], 1)
    truth1 = np.stack([x[known] - disparity[known], y[known], ones], 1)
    views = [np.ascontiguousarray(points[kept].double().numpy()) for points in (matches.keypoints0, matches.keypoints1)]
    errors = {}
    for name, method in FITS.items():
        cv2.setRNGSeed(0)
        fitted = None
        if len(views[0]) >= 8:
            fitted, _ = cv2.findFundamentalMat(*views, method, RANSAC_ERROR_PX, CONFIDENCE)
        if fitted is None or fitted.shape != (3, 3):
            errors[name] = np.inf
            continue
        line0, line1 = truth1 @ fitted, truth0 @ fitted.T
        residual = np.abs((truth1 * line1).sum(1))
        lengths = (np.linalg.norm(line[:, :2], axis=1).clip(1e-12) for line in (line0, line1))
        errors[name] = float(np.mean([(residual / length).mean() for length in lengths]))
    return errors
