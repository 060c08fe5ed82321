"""Where windows of images are taken: along the rows of rectified pairs, along epipolar lines of others."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.features import to_gray
from tensor_stereo.ops.samplers import Place
from tensor_stereo.ops.windows import RADIUS_PX
from tensor_stereo.scores.alignment.form import Alignment, epipolar_frames, map_points, turn_vectors
from tensor_stereo.types import Matches

_LEAST_BLUR_PX = 0.2  # less is none
_WIDEST = 1.0  # of the size of view 0, how far view 1 may lie beyond it
_MARGIN = 2 * RADIUS_PX  # px around what is known
_ROWS_AT_ONCE = 256


def find_places(matches: Matches, aligned: Matches, slope: Tensor, alignment: Alignment) -> Place:
    """The places of all matches, whose disparities have the (M, 2) slopes where they are aligned."""
    disparity = (aligned.keypoints0[:, 0] - aligned.keypoints1[:, 0]).float()
    right, across = matches.keypoints1, alignment.row_shift(matches)
    along = torch.tensor([1.0, 0.0], device=slope.device).expand_as(slope)
    if not bool(alignment.rectified.all()):
        batch = ptr_to_batch(matches.ptr)
        frames = epipolar_frames(matches, alignment)
        is_rectified, has_rows = (values.index_select(0, batch) for values in (alignment.rectified, alignment.has_rows))
        own_row = turn_vectors(frames.partners - matches.keypoints0.double(), frames.along)[:, 1]
        line_row = torch.where(has_rows, own_row - frames.moved[:, 1], own_row)
        across = torch.where(is_rectified, across, line_row)
        turned = turn_vectors(slope, turn_vectors(frames.along, frames.turn.index_select(0, batch)).float())
        is_rectified = is_rectified[:, None]
        right = torch.where(is_rectified, right.double(), frames.partners)
        along = torch.where(is_rectified, along, frames.along.float())
        slope = torch.where(is_rectified, slope, turned)
    return Place(matches.keypoints0.float(), right.float(), along, disparity, across.float(), slope)


class PairViews(NamedTuple):
    """The views of a pair, ready to be looked at.

    Attributes:
        image0: (H, W) grey levels, uint8; float32 where view 1 was resampled.
        image1: (H1, W1) likewise.
        brighter: By how many grey levels view 1 is brighter.
        origin: (2,) float32 px of view 0, where the first pixel of ``image1`` lies.
        known1: (H1, W1) bool, inside of view 1; None: all.
    """

    image0: Tensor
    image1: Tensor
    brighter: float
    origin: Tensor
    known1: Tensor | None


def prepare_views(views: Sequence[Sequence[Tensor]], matches: Matches, alignment: Alignment) -> Iterator[PairViews]:
    """Both views of each pair, view 1 in the frame of view 0 unless they are rectified.

    Args:
        views: The B images (C, H, W) of view 0, and those of view 1, whose common change of brightness is told.
        matches: B pairs.
        alignment: What the matches of every pair share.
    """
    device = matches.ptr.device
    for b, (start, stop) in enumerate(pairwise(matches.ptr.tolist())):
        image0, image1 = (to_gray(images[b][None])[0, 0].to(device) for images in views)
        points = matches.keypoints0[start:stop], matches.keypoints1[start:stop]
        brighter = _brighter((image0, image1), *points)
        if bool(alignment.rectified[b]):
            yield PairViews(image0, image1, brighter, torch.zeros(2, device=device), None)
            continue
        warped = warp_view(image0.float(), image1.float(), alignment.to_view0[b], points[1])
        yield PairViews(warped.image0, warped.image1, brighter, warped.origin, warped.known1)


def list_views(
    pairs: Sequence[PairViews], device: torch.device
) -> tuple[list[Tensor], list[Tensor], list[Tensor], Tensor, Tensor]:
    """The views of B pairs as the operators on windows take them."""
    nothing = torch.zeros(0, 0, dtype=torch.bool, device=device)
    return (
        [pair.image0 for pair in pairs],
        [pair.image1 for pair in pairs],
        [nothing if pair.known1 is None else pair.known1 for pair in pairs],
        torch.stack([pair.origin for pair in pairs]) if pairs else torch.zeros(0, 2, device=device),
        torch.tensor([pair.brighter for pair in pairs], dtype=torch.float32, device=device),
    )


def _brighter(gray: Sequence[Tensor], points0: Tensor, points1: Tensor) -> float:
    """By how many grey levels view 1 is brighter, the median over the matches of a pair, of 5 x 5 px each."""
    if not len(points0):
        return 0.0
    around = torch.arange(-2, 3, device=points0.device)
    levels = []
    for image, points in zip(gray, (points0, points1), strict=True):
        height, width = image.shape
        x, y = (place.round().long() for place in points.unbind(1))
        x, y = (place.clamp(0, size - 1)[:, None] + around for place, size in ((x, width), (y, height)))
        known = ((x >= 0) & (x < width))[:, None] & ((y >= 0) & (y < height))[:, :, None]
        found = image[y.clamp(0, height - 1)[:, :, None], x.clamp(0, width - 1)[:, None]].double() * known
        levels.append(found.sum((1, 2)) / known.sum((1, 2)))
    return float(torch.quantile(levels[1] - levels[0], 0.5))  # the same in a mirror, unlike the lower median


class WarpedView(NamedTuple):
    """View 1 of a pair as it looks in the frame of view 0, and view 0 as sharp as that."""

    image0: Tensor  # (H, W)
    image1: Tensor  # (H', W')
    known1: Tensor  # (H', W') bool, inside of view 1
    origin: Tensor  # (2,) px of view 0, where the first pixel of ``image1`` lies


def warp_view(image0: Tensor, image1: Tensor, to_view0: Tensor, keypoints1: Tensor) -> WarpedView:
    """Resample view 1 in the frame of view 0, low-pass filtered where it has more pixels there.

    Args:
        image0: (H, W) grey levels.
        image1: (H1, W1) grey levels.
        to_view0: (3, 3) homography from px of view 1 to px of view 0.
        keypoints1: (m, 2) px of view 1, around which the image is wanted; beyond the size of view 0 it is left out.

    >>> image = torch.rand(20, 30)
    >>> warped = warp_view(image, image, torch.eye(3, dtype=torch.float64), torch.tensor([[3.0, 4.0]]))
    >>> left, top = (-warped.origin).long().tolist()
    >>> torch.allclose(warped.image1[top : top + 20, left : left + 30], image, atol=1e-5)
    True
    """
    none = torch.zeros_like(keypoints1[:, 0], dtype=torch.int64)
    partners = map_points(to_view0[None], keypoints1.double(), none)
    rows, columns = image1.shape
    last = partners.new_tensor([columns - 1, rows - 1])
    corners = map_points(
        to_view0[None], last * partners.new_tensor([[0, 0], [0, 1], [1, 0], [1, 1]]), none.new_zeros(4)
    )
    size = partners.new_tensor([image0.shape[1], image0.shape[0]])
    low = torch.cat([partners, torch.zeros_like(size)[None]]).amin(0).clamp(min=-_WIDEST * size)
    high = torch.cat([partners, size[None]]).amax(0).clamp(max=(1 + _WIDEST) * size)
    low = torch.maximum(low, corners.amin(0)).minimum(high) - _MARGIN  # beyond its corners nothing is known
    high = torch.minimum(high, corners.amax(0)).maximum(low) + _MARGIN
    origin = low.floor()
    width, height = (high - origin).ceil().clamp(min=1).long().tolist()
    finer = _finer(to_view0, keypoints1)
    image0, image1 = blur(image0, 1 / finer), blur(image1, finer)
    m = torch.linalg.inv_ex(to_view0)[0]
    x = torch.arange(width, dtype=torch.float64, device=origin.device) + origin[0]
    parts = []
    for top in range(0, height, _ROWS_AT_ONCE):  # of a large image, coordinates take eight times its memory
        y = torch.arange(top, min(top + _ROWS_AT_ONCE, height), dtype=torch.float64, device=origin.device) + origin[1]
        u, v, depth = (m[k, 0] * x + (m[k, 1] * y + m[k, 2])[:, None] for k in range(3))
        source = torch.stack([u / depth, v / depth], 2)
        known = ((source >= 0) & (source <= last)).all(2) & (depth > 0)
        scaled = (2 * source / last.clamp(min=1) - 1).clamp(-2, 2).nan_to_num(nan=2.0).float()
        warped = functional.grid_sample(image1[None, None].float(), scaled[None], "bicubic", "border", True)
        parts.append((warped[0, 0], known))
    image1, known = (torch.cat(part) for part in zip(*parts, strict=True))
    return WarpedView(image0, image1, known, origin.float())


def _finer(to_view0: Tensor, keypoints1: Tensor) -> float:
    """How many px of view 1 a px of view 0 has, at the middle keypoint."""
    if not len(keypoints1):
        return 1.0
    x, y = keypoints1.double().median(0).values.tolist()
    depth = abs(float(to_view0[2, 0]) * x + float(to_view0[2, 1]) * y + float(to_view0[2, 2]))
    area = abs(float(torch.linalg.det(to_view0))) / max(depth, 1e-3) ** 3
    return 1 / math.sqrt(min(max(area, 1e-4), 1e4))


def blur(image: Tensor, px_per_px: float) -> Tensor:
    """The image (H, W) as sharp as if it had that many times fewer pixels a side; itself if it has not more.

    >>> image = torch.rand(9, 9)
    >>> blur(image, 0.5) is image, bool(blur(image, 2.0).std() < image.std())
    (True, True)
    """
    sigma = 0.5 * math.sqrt(max(px_per_px**2 - 1, 0.0))
    if sigma < _LEAST_BLUR_PX:
        return image
    radius = min(math.ceil(3 * sigma), min(image.shape) - 1)
    if radius < 1:
        return image
    offsets = torch.arange(-radius, radius + 1, dtype=image.dtype, device=image.device)
    kernel = torch.exp(-(offsets / sigma).square() / 2)
    weights = (kernel / kernel.sum()).tolist()
    padded = functional.pad(image[None, None], (radius,) * 4, mode="reflect")[0, 0]
    for axis in (1, 0):  # sums of shifted images; a convolution of one channel takes ten times as long
        size = padded.shape[axis] - 2 * radius
        shifted = (padded.narrow(axis, k, size) for k in range(len(weights)))
        total = next(shifted) * weights[0]
        for part, weight in zip(shifted, weights[1:], strict=True):
            total.add_(part, alpha=weight)
        padded = total
    return padded
