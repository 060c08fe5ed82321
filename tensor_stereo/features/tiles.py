"""Large images in tiles, for detectors that keep a dozen copies of an image of twice its size."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor

from tensor_stereo.features.images import MAX_PIXELS

_HALO_PX = 200  # what a keypoint of scale below _MAX_SIGMA_PX sees at most, and a little more
_STEP_PX = 2  # of the grid on which the third octave lies
_MAX_SIGMA_PX = 0.8 * 4 * 2 ** (3.5 / 3)  # where the third octave ends
_HALF_BLUR_PX = 0.75**0.5  # from the blur of a camera, .5 px (Lowe 2004, section 3.3), to that of half the size


class ScaledFeatures(NamedTuple):
    """Keypoints of one image with the scale at which each was found.

    Attributes:
        keypoints: (N, 2) px.
        descriptors: (N, D).
        scores: (N,).
        sigma: (N,) px, scale of the Gaussian.
    """

    keypoints: Tensor
    descriptors: Tensor
    scores: Tensor
    sigma: Tensor


def detect_in_tiles(detect: Callable[[Tensor], ScaledFeatures], image: Tensor) -> ScaledFeatures:
    """Detect in overlapping tiles where an image is large, and in the image itself where it is not.

    A detector of difference-of-Gaussian extrema (Lowe, IJCV 60(2), 2004) holds a dozen copies of an image of twice its
    size: 3 GB for 12 megapixels. Images of more than 4 megapixels are therefore split; then memory is that of 4
    megapixels and 20 bytes for each pixel of the image. Keypoints of the first three
    octaves (scales below 7.2 px) come from tiles that overlap by more than such a keypoint can see: they are those of
    the whole image. Those of larger scale come from the image at half its size, by the same rule: they are those of the
    whole image up to a few hundredths of their scale.

    Args:
        detect: takes one (H, W) floating-point image in grey levels.
        image: (H, W) uint8 or floating point.

    Returns:
        The keypoints of all tiles, in no particular order.

    >>> nothing = ScaledFeatures(torch.zeros(0, 2), torch.zeros(0, 1), torch.zeros(0), torch.zeros(0))
    >>> detect_in_tiles(lambda image: nothing, torch.zeros(20, 30)).keypoints.shape
    torch.Size([0, 2])
    """
    image = image.float()
    if image.numel() <= MAX_PIXELS:
        return detect(image)
    found = []
    for rows, columns in itertools.product(*(list(_tiles(size)) for size in image.shape)):
        part = detect(image[rows.outer, columns.outer])
        corner = part.keypoints.new_tensor([columns.outer.start, rows.outer.start])
        place = part.keypoints + corner
        is_inside = [
            (place[:, axis] >= tile.start - 0.5) & (place[:, axis] < tile.stop - 0.5)
            for axis, tile in enumerate((columns.inner, rows.inner))
        ]
        keep = is_inside[0] & is_inside[1] & (part.sigma < _MAX_SIGMA_PX)
        found.append(ScaledFeatures(*(values[keep] for values in part._replace(keypoints=place))))
    half = detect_in_tiles(detect, _half(image))
    large = half._replace(keypoints=2 * half.keypoints, sigma=2 * half.sigma)
    keep = large.sigma >= _MAX_SIGMA_PX
    found.append(ScaledFeatures(*(values[keep] for values in large)))
    return ScaledFeatures(*(torch.cat(values) for values in zip(*found, strict=True)))


class _Tile(NamedTuple):
    """Pixels along one axis: those whose keypoints count, and those that the detector sees."""

    inner: slice
    outer: slice


def _tiles(size: int) -> Iterator[_Tile]:
    """Tiles of about equal size along one axis, whose squares are small enough to be taken whole."""
    count = math.ceil(size / (math.isqrt(MAX_PIXELS) - 2 * _HALO_PX))
    for k in range(count):
        start, stop = (min(size, _STEP_PX * math.ceil(n * size / count / _STEP_PX)) for n in (k, k + 1))
        yield _Tile(slice(start, stop), slice(max(0, start - _HALO_PX), min(size, stop + _HALO_PX)))


def _half(image: Tensor) -> Tensor:
    """Every second pixel of the image after a blur, the first at the same place."""
    blurred = gaussian_blur2d(image[None, None], (7, 7), (_HALF_BLUR_PX, _HALF_BLUR_PX), "replicate")
    half: Tensor = blurred[0, 0, ::2, ::2]
    return half
