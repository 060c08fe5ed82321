"""Good features to track with image windows."""

from __future__ import annotations

import cv2
import torch
from kornia.feature import gftt_response
from torch import Tensor
from torch.nn import functional

from tensor_stereo.configs import GFTTConfig
from tensor_stereo.features.images import join_images, map_images, strongest_first, to_gray
from tensor_stereo.features.windows import extract_windows
from tensor_stereo.types import Features

_MIN_SIZE = 4  # px: the 7 x 7 blur of the structure tensor is reflected at the border, and that needs more than 3 px


def detect_gftt(images: Tensor, config: GFTTConfig | None = None) -> Features:
    """Detect corners by the smaller eigenvalue of the structure tensor and cut a window around each.

    Source: Shi & Tomasi, "Good features to track", CVPR 1994, section 4. A pixel is kept where its response exceeds
    ``quality_level`` times the image's largest one and is the largest one nearer than ``min_distance_px`` in row and
    column (and among its 8 neighbours in any case); of equal ones the first by row, then column. The outermost pixels
    of the image are left out. ``backend="opencv"`` runs ``cv2.GFTTDetector`` instead: another window in the structure
    tensor (a 3 x 3 box), Euclidean distance, greedy selection by falling response. Both work image by image
    (convolutions of a batch have other bits than those of its images). No gradient.

    Args:
        images: (B, 1, H, W) or (B, 3, H, W), uint8 or floating point in [0, 1], as :func:`to_gray` takes them.
        config: settings; None means the defaults.

    Returns:
        Whole-pixel keypoints, strongest first, equal scores by row, then column; windows of ``config.window_px`` px.
        ``scores`` is the response: the smaller eigenvalue, with the backend's own factor. An image without texture or
        with a side below 4 px (kornia) has no keypoints.

    Raises:
        ValueError: if ``images`` has another shape, or values outside of [0, 1].
        TypeError: if ``images`` has another dtype.

    >>> image = torch.zeros(1, 1, 32, 32, dtype=torch.uint8)
    >>> image[..., 10:20, 12:22] = 200
    >>> detect_gftt(image).keypoints.tolist()
    [[12.0, 10.0], [21.0, 10.0], [12.0, 19.0], [21.0, 19.0]]
    """
    config = config or GFTTConfig()
    gray = to_gray(images)
    if config.backend == "opencv":
        detected = map_images(lambda image: _detect_opencv(image, config), gray.cpu())
    else:
        # kornia's operators bring threads of their own; a second image fills the gaps between them
        detected = map_images(lambda image: _detect_kornia(image, config), gray, max_workers=2)
    (keypoints, scores), ptr = join_images(detected, [(2,), ()], gray.device)
    return Features(keypoints, ptr, extract_windows(gray, keypoints, ptr, window_px=config.window_px), scores)


@torch.no_grad()
def _detect_kornia(image: Tensor, config: GFTTConfig) -> tuple[Tensor, Tensor]:
    """Keypoints (N, 2) and scores (N,) of one (H, W) image."""
    height, width = image.shape
    if min(height, width) < _MIN_SIZE:
        return image.new_zeros(0, 2, dtype=torch.float32), image.new_zeros(0, dtype=torch.float32)
    response = gftt_response(image[None, None].float())[0]  # (1, H, W), grey levels squared
    radius = max(config.min_distance_px - 1, 1)
    # the index of a maximum is that of the first one in its window, which settles ties
    _, first = functional.max_pool2d(response, 2 * radius + 1, stride=1, padding=radius, return_indices=True)
    pixel = torch.arange(height * width, device=image.device).view(1, height, width)
    keep = (first == pixel) & (response > config.quality_level * response.amax())
    y, x = keep[0, 1:-1, 1:-1].nonzero().unbind(1)
    keypoints = torch.stack([x + 1, y + 1], 1).float()
    scores = response[0, y + 1, x + 1]
    order = strongest_first(keypoints, scores, config.max_keypoints)
    return keypoints[order], scores[order]


def _detect_opencv(image: Tensor, config: GFTTConfig) -> tuple[Tensor, Tensor]:
    """Keypoints (N, 2) and scores (N,) of one (H, W) image on the CPU."""
    detector = cv2.GFTTDetector.create(config.max_keypoints, config.quality_level, config.min_distance_px)
    found = detector.detect(image.numpy())
    if not found:
        return torch.zeros(0, 2, dtype=torch.float32), torch.zeros(0, dtype=torch.float32)
    keypoints = torch.from_numpy(cv2.KeyPoint.convert(found))
    scores = torch.tensor([keypoint.response for keypoint in found], dtype=torch.float32)
    order = strongest_first(keypoints, scores, config.max_keypoints)
    return keypoints[order], scores[order]
