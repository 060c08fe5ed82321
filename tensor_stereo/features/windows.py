"""Image windows as descriptors: what the sum of squared differences compares for detectors without descriptors."""

from __future__ import annotations

import torch
from torch import Tensor

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.types import check_points, check_ptr


@torch.no_grad()
def extract_windows(images: Tensor, keypoints: Tensor, ptr: Tensor, *, window_px: int = 11) -> Tensor:
    """Cut a square window of grey levels around the nearest pixel of every keypoint.

    Beyond the border the image is mirrored with its outermost pixels repeated (``cba|abc``, ``cv2.BORDER_REFLECT``),
    as often as the window asks, so that images smaller than the window have windows too. No gradient.

    Args:
        images: (B, 1, H, W) uint8.
        keypoints: (N, 2) floating point, (x, y) in px, inside their image.
        ptr: (B + 1,) int64 offsets of the images.
        window_px: side of the window, odd.

    Returns:
        (N, window_px**2) float32 whole grey levels 0..255, row by row. Sums of squared differences of two windows are
        exact in float32, in any order of summation, up to 2**24: always for ``window_px`` <= 15.

    Raises:
        ValueError: if shapes disagree, ``window_px`` is even or less than 1, or a keypoint lies outside its image.
        TypeError: if a dtype does not fit.

    >>> image = torch.arange(9, dtype=torch.uint8).view(1, 1, 3, 3)
    >>> extract_windows(image, torch.zeros(1, 2), torch.tensor([0, 1]), window_px=3)
    tensor([[0., 0., 1., 0., 0., 1., 3., 3., 4.]])
    """
    check_window_px("window_px", window_px)
    check_points("keypoints", keypoints)
    check_ptr("ptr", ptr, len(keypoints))
    if images.ndim != 4 or images.shape[1] != 1 or len(images) != len(ptr) - 1:
        raise ValueError(f"images must have shape ({len(ptr) - 1}, 1, H, W), got {tuple(images.shape)}")
    if images.dtype != torch.uint8:
        raise TypeError(f"images must be uint8, got {images.dtype}")
    if len(keypoints) == 0:
        return torch.zeros(0, window_px**2, dtype=torch.float32, device=images.device)
    height, width = images.shape[2:]
    nearest = keypoints.round()
    size = nearest.new_tensor([width, height])
    if not bool(((nearest >= 0) & (nearest < size)).all()):
        raise ValueError(f"keypoints must lie inside the images of {width} x {height} px")
    x, y = nearest.to(torch.int64).unbind(1)

    radius = window_px // 2
    padded = _mirror(_mirror(images[:, 0], 1, radius), 2, radius)
    stride = width + 2 * radius
    first = (ptr_to_batch(ptr) * (height + 2 * radius) + y) * stride + x  # its top left pixel
    num_windows = padded.numel() - 2 * radius * (stride + 1)
    windows = padded.as_strided((num_windows, window_px, window_px), (1, stride, 1))
    return windows.index_select(0, first).flatten(1).to(torch.float32)


def _mirror(images: Tensor, axis: int, radius: int) -> Tensor:
    """The images with ``radius`` more pixels at both ends of an axis, those of a mirror that stands at the border."""
    while radius > 0:
        step = min(radius, images.shape[axis])
        left, right = images.narrow(axis, 0, step), images.narrow(axis, images.shape[axis] - step, step)
        images = torch.cat([left.flip(axis), images, right.flip(axis)], axis)
        radius -= step
    return images.contiguous()


def check_window_px(name: str, window_px: int) -> None:
    """Raise unless the side of a window is odd and positive.

    >>> check_window_px("FASTConfig.window_px", 11)
    """
    if window_px < 1 or window_px % 2 == 0:
        raise ValueError(f"{name} must be odd and positive, got {window_px}")
