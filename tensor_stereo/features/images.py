"""Images as every detector reads them, and what detectors share: the loop over images, the order of keypoints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch
from kornia.color import rgb_to_grayscale
from torch import Tensor

from tensor_stereo.batching import lengths_to_ptr
from tensor_stereo.types import check_tensor

MAX_PIXELS = 2**22  # of an image that is no large one
S = TypeVar("S")
T = TypeVar("T")


def list_images(name: str, images: Tensor | Sequence[Tensor], num_pairs: int) -> list[Tensor]:
    """The images of one view of B pairs, one by one.

    Args:
        name: Name of the argument, for errors.
        images: (B, C, H, W), or B images (C, H, W) of any sizes; for one pair also (C, H, W).
        num_pairs: B.

    Returns:
        B images (C, H, W).

    Raises:
        TypeError: if an image is no tensor.
        ValueError: for other shapes, or another number of images.

    >>> [image.shape for image in list_images("images0", torch.zeros(3, 8, 9), 1)]
    [torch.Size([3, 8, 9])]
    """
    if isinstance(images, list | tuple):
        found = list(images)
    else:
        check_tensor(name, images)
        batch = torch.as_tensor(images)
        found = list(batch) if batch.ndim == 4 else [batch]
    for b, image in enumerate(found):
        check_tensor(f"{name}[{b}]", image)
        if image.ndim != 3 or image.shape[0] not in (1, 3):
            shape = tuple(image.shape)
            raise ValueError(f"{name} must be images (C, H, W) with C = 1 or 3, or a batch (B, C, H, W), got {shape}")
    if len(found) != num_pairs:
        raise ValueError(f"{name} must hold one image per pair ({num_pairs}), got {len(found)}")
    return found


@torch.no_grad()
def to_gray(images: Tensor) -> Tensor:
    """Convert images to one channel of whole grey levels.

    Colour becomes luma, 0.299 R + 0.587 G + 0.114 B (ITU-R BT.601, as in kornia and OpenCV), once and here, and is
    rounded to whole levels, half to even: windows of integers have sums of squares that float32 holds exactly. A
    ``uint8`` image of one channel is returned as it is. No gradient.

    Args:
        images: (B, C, H, W), C = 1 or 3 (RGB), uint8 in 0..255 or floating point in [0, 1]. B may be 0.

    Returns:
        (B, 1, H, W) uint8 on the device of ``images``.

    Raises:
        ValueError: if ``images`` has another shape, no pixel, or floating-point values outside [0, 1] or NaN.
        TypeError: if ``images`` is neither uint8 nor floating point.

    >>> to_gray(torch.tensor([1.0, 0.0, 0.0]).view(1, 3, 1, 1)).item()
    76
    """
    shape = tuple(images.shape)
    if len(shape) != 4 or shape[1] not in (1, 3):
        raise ValueError(f"images must have shape (B, 1, H, W) or (B, 3, H, W), got {shape}")
    if shape[2] == 0 or shape[3] == 0:
        raise ValueError(f"images must have at least one pixel, got shape {shape}")
    if images.dtype == torch.uint8:
        return images if shape[1] == 1 else _round_luma(images.float())
    if not images.is_floating_point():
        raise TypeError(f"images must be uint8 or floating point, got {images.dtype}")
    if images.numel() and not bool(((images >= 0) & (images <= 1)).all()):  # NaN fails both
        low, high = (value.item() for value in images.aminmax())
        raise ValueError(f"floating-point images must lie in [0, 1] without NaN, got values from {low:g} to {high:g}")
    return _round_luma(images.float() * 255)


def _round_luma(levels: Tensor) -> Tensor:
    """Float levels 0..255 (B, 1 or 3, H, W) -> (B, 1, H, W) uint8."""
    luma = rgb_to_grayscale(levels) if levels.shape[1] == 3 else levels
    return luma.round().to(torch.uint8)


def map_images(function: Callable[[Tensor], T], images: Tensor, *, max_workers: int | None = None) -> list[T]:
    """Apply a detector that takes one image to every image of a batch, in a pool of threads.

    For detectors that cannot take a batch, or that return other bits for a batch than for each of its images. The
    results are in the order of the images and equal to those of a plain loop.

    Args:
        function: takes one (H, W) uint8 image; must be free of side effects.
        images: (B, 1, H, W) uint8.
        max_workers: number of threads, at most ``torch.get_num_threads()`` (the default). No more than 4 megapixels are
            worked on at a time, or one image, since a detector may need some hundred bytes for each pixel.

    >>> map_images(lambda image: int(image.sum()), torch.ones(2, 1, 3, 4, dtype=torch.uint8))
    [12, 12]
    """
    at_once = max(1, MAX_PIXELS // (images.shape[-2] * images.shape[-1]))
    return map_threads(function, images[:, 0].unbind(), max_workers=min(at_once, max_workers or at_once))


def map_threads(function: Callable[[S], T], items: Sequence[S], *, max_workers: int | None = None) -> list[T]:
    """Apply a function that is free of side effects to every item, as :func:`map_images` does to every image.

    >>> map_threads(len, ["a", "", "bc"])
    [1, 0, 2]
    """
    workers = min(len(items), torch.get_num_threads(), max_workers or len(items))
    if workers <= 1:
        return [function(item) for item in items]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(function, items))


def strongest_first(keypoints: Tensor, scores: Tensor, max_keypoints: int) -> Tensor:
    """Order the keypoints of one image by falling score and keep the first ``max_keypoints``.

    Equal scores are ordered by row, then column, then by their place in the input, so that the selection depends on
    neither the detector's own order nor the sorting algorithm.

    Args:
        keypoints: (N, 2) (x, y) in px.
        scores: (N,) detector response, higher is stronger.
        max_keypoints: number to keep at most.

    Returns:
        (min(N, max_keypoints),) int64 row indices.

    >>> strongest_first(torch.tensor([[5.0, 1.0], [2.0, 1.0], [9.0, 0.0]]), torch.tensor([1.0, 1.0, 3.0]), 2)
    tensor([2, 1])
    """
    step_x, step_y = keypoints.diff(dim=0).unbind(1)
    if bool(((step_y > 0) | ((step_y == 0) & (step_x >= 0))).all()):  # as most detectors return them
        return torch.argsort(scores, stable=True, descending=True)[:max_keypoints]
    order = torch.argsort(keypoints[:, 0], stable=True)
    order = order[torch.argsort(keypoints[order, 1], stable=True)]
    order = order[torch.argsort(scores[order], stable=True, descending=True)]
    return order[:max_keypoints]


def join_images(
    parts: Sequence[tuple[Tensor, ...]], shapes: Sequence[tuple[int, ...]], device: torch.device
) -> tuple[list[Tensor], Tensor]:
    """Concatenate what a detector found in each image.

    Args:
        parts: per image, a tuple of tensors with one row per keypoint.
        shapes: shape of one row of each of these tensors, for a batch without images.
        device: where the result lives.

    Returns:
        one float32 tensor per entry of ``shapes``, and ptr (B + 1,) int64.

    >>> (keypoints, scores), ptr = join_images([(torch.ones(2, 2), torch.ones(2))], [(2,), ()], torch.device("cpu"))
    >>> keypoints.shape, scores.shape, ptr
    (torch.Size([2, 2]), torch.Size([2]), tensor([0, 2]))
    """
    columns = [
        torch.cat(
            [
                torch.zeros(0, *shape, dtype=torch.float32, device=device),
                *(part[k].to(device, torch.float32) for part in parts),
            ]
        )
        for k, shape in enumerate(shapes)
    ]
    return columns, lengths_to_ptr(torch.tensor([len(part[0]) for part in parts], dtype=torch.int64, device=device))
