"""FAST corners with image windows."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from tensor_stereo.configs import FASTConfig
from tensor_stereo.features.images import join_images, strongest_first, to_gray
from tensor_stereo.features.windows import extract_windows
from tensor_stereo.types import Features

# The 16 pixels of the circle around a corner, clockwise from the top, as (dx, dy) (Rosten & Drummond 2006, figure 1).
_QUADRANT = [(0, -3), (1, -3), (2, -2), (3, -1)]
_CIRCLE = [
    *_QUADRANT,
    *((-y, x) for x, y in _QUADRANT),
    *((-x, -y) for x, y in _QUADRANT),
    *((y, -x) for x, y in _QUADRANT),
]


def detect_fast(images: Tensor, config: FASTConfig | None = None) -> Features:
    """Detect corners by the accelerated segment test and cut a window around each.

    A pixel is a corner where 9 contiguous pixels of the circle of 16 around it are all brighter, or all darker, than
    itself by more than ``threshold`` (Rosten & Drummond, "Machine learning for high-speed corner detection", ECCV
    2006, section 2). The detector is OpenCV's; it takes one image at a time. Its suppression keeps
    strict maxima among 8 neighbours: of two equal neighbours it keeps neither. No gradient.

    Args:
        images: (B, 1, H, W) or (B, 3, H, W), uint8 or floating point in [0, 1], as :func:`to_gray` takes them.
        config: settings; None means the defaults.

    Returns:
        Whole-pixel keypoints, strongest first, equal scores by row, then column; windows of ``config.window_px`` px.
        ``scores`` is the largest threshold at which the pixel would still be a corner, in grey levels, with or
        without suppression. An image without texture or smaller than 7 x 7 px has no keypoints.

    Raises:
        ValueError: if ``images`` has another shape, or values outside of [0, 1].
        TypeError: if ``images`` has another dtype.

    >>> image = torch.zeros(1, 1, 32, 32, dtype=torch.uint8)
    >>> image[..., 10, 20], image[..., 25, 5] = 200, 250
    >>> features = detect_fast(image)
    >>> features.keypoints.tolist(), features.scores.tolist()
    ([[5.0, 25.0], [20.0, 10.0]], [249.0, 199.0])
    """
    config = config or FASTConfig()
    gray = to_gray(images)
    detected = [_detect(image, config) for image in gray.cpu()[:, 0]]  # a pool of threads would fight with torch's own
    (keypoints, scores), ptr = join_images(detected, [(2,), ()], gray.device)
    return Features(keypoints, ptr, extract_windows(gray, keypoints, ptr, window_px=config.window_px), scores)


def _detect(image: Tensor, config: FASTConfig) -> tuple[Tensor, Tensor]:
    """Keypoints (N, 2) and scores (N,) of one (H, W) image on the CPU."""
    detector = cv2.FastFeatureDetector.create(config.threshold, config.nonmax_suppression)
    found = detector.detect(image.numpy())
    if not found:
        return torch.zeros(0, 2, dtype=torch.float32), torch.zeros(0, dtype=torch.float32)
    keypoints = torch.from_numpy(cv2.KeyPoint.convert(found))
    if config.nonmax_suppression:
        scores = torch.from_numpy(np.array([keypoint.response for keypoint in found], np.float32))
    else:
        scores = corner_score(image, keypoints.to(torch.int64))
    order = strongest_first(keypoints, scores, config.max_keypoints)
    return keypoints[order], scores[order]


def corner_score(image: Tensor, pixels: Tensor) -> Tensor:
    """Largest threshold at which each pixel passes the segment test.

    OpenCV computes the same number, but only when it suppresses non-maxima.

    Args:
        image: (H, W) uint8.
        pixels: (N, 2) int64 (x, y), at least 3 px from the border.

    Returns:
        (N,) float32 grey levels; -1 where the pixel is a corner at no threshold.

    >>> image = torch.zeros(7, 7, dtype=torch.uint8)
    >>> image[3, 3] = 100
    >>> corner_score(image, torch.tensor([[3, 3]]))
    tensor([99.])
    """
    x, y = pixels.unbind(1)
    dx, dy = torch.tensor(_CIRCLE, device=image.device).unbind(1)
    levels = image.to(torch.int16)
    difference = levels[y[:, None] + dy, x[:, None] + dx] - levels[y, x][:, None]  # (N, 16)
    brighter, darker = (_weakest_of_arcs(d).amax(1) for d in (difference, -difference))
    return torch.maximum(brighter, darker).clamp(min=0).to(torch.float32) - 1


def _weakest_of_arcs(values: Tensor) -> Tensor:
    """(N, 16) minimum of each run of 9 along the circle: runs of 2, 4, 8, and one more."""
    least = values
    for length in (1, 2, 4):
        least = torch.minimum(least, least.roll(-length, 1))
    return torch.minimum(least, values.roll(-8, 1))
