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
from tensor_stereo.scores.alignment.form import Alignment, epipolar_frames, map_points, turn_vectors
from tensor_stereo.scores.windows import RADIUS_PX, sample_frames, sample_slanted, sample_strips, sample_windows
from tensor_stereo.types import Matches

_LEAST_BLUR_PX = 0.2  # less is none
_WIDEST = 1.0  # of the size of view 0, how far view 1 may lie beyond it
_MARGIN = 2 * RADIUS_PX  # px around what is known
_ROWS_AT_ONCE = 256


class Place(NamedTuple):
    """Where the windows of m matches lie, and where their partners are looked for.

    Attributes:
        left: (m, 2) float32 px of view 0.
        right: (m, 2) float32 px of view 1; of the frame of view 0 in pairs that are not rectified.
        along: (m, 2) float32 unit vectors along the epipolar lines, (1, 0) in rectified pairs.
        disparity: (m,) float32 px, by how much the match lies back along its line.
        across: (m,) float32 px, how far from the keypoint in view 0 its line in view 1 lies, across it.
        slope: (m, 2) float32 px/px, of the disparity along and across the line.
    """

    left: Tensor
    right: Tensor
    along: Tensor
    disparity: Tensor
    across: Tensor
    slope: Tensor

    def select(self, rows: slice | Tensor) -> Place:
        """Those of some matches."""
        return Place(*(values[rows] for values in self))

    @property
    def off_line(self) -> Tensor:
        """(m,) px, how far the partner lies from its line, across it."""
        return turn_vectors(self.right - self.left, self.along)[:, 1] - self.across


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


class RowSampler(NamedTuple):
    """An image (H, W) that is looked at along its rows."""

    image: Tensor

    def windows(self, centers: Tensor, radius_x: int) -> Tensor:
        """(m, 15, 2 rx + 1) grey levels around centres (m, 2) px."""
        return sample_windows(self.image, centers, radius_x)

    def strips(self, start: Tensor, width: int) -> Tensor:
        """(m, 15, width) grey levels of strips from ``start`` (m, 2) px on."""
        return sample_strips(self.image, start[:, 0], start[:, 1], width)

    def slanted(self, centers: Tensor, radius_x: int, shear: Tensor) -> Tensor:
        """(m, 15, 2 rx + 1) grey levels of what a slanted surface moves there."""
        return sample_slanted(self.image, centers, radius_x, shear)

    def outside(self, start: Tensor, count: int) -> Tensor:
        """(m, count) bool, which places from ``start`` on lie left or right of the image."""
        x = start[:, :1] + torch.arange(count, device=start.device)
        return (x < 0) | (x > self.image.shape[1] - 1)

    def select(self, rows: slice | Tensor) -> RowSampler:  # noqa: ARG002  # as of other samplers
        """That of some matches."""
        return self

    def place(self, points: Tensor, along: Tensor, across: Tensor) -> Tensor:
        """(m, 2) px, points moved along and across the rows."""
        return torch.stack([points[:, 0] + along, points[:, 1] + across], 1)


class LineSampler(NamedTuple):
    """An image that is looked at along a direction of each match, and where it is known. Places are px of view 0."""

    image: Tensor  # (H, W)
    origin: Tensor  # (2,) px, where its first pixel lies
    along: Tensor  # (m, 2) unit vectors
    known: Tensor  # (H, W) bool

    def windows(self, centers: Tensor, radius_x: int) -> Tensor:
        """(m, 15, 2 rx + 1) grey levels around centres (m, 2) px, along the lines."""
        return self._sample(centers, radius_x, self._axes())

    def strips(self, start: Tensor, width: int) -> Tensor:
        """(m, 15, width) grey levels of strips along the lines from ``start`` (m, 2) px on."""
        offsets = torch.arange(width, device=start.device, dtype=torch.float32)
        return sample_frames(self.image, start - self.origin, self._axes(), offsets)

    def slanted(self, centers: Tensor, radius_x: int, shear: Tensor) -> Tensor:
        """(m, 15, 2 rx + 1) grey levels of what a slanted surface moves there."""
        u, v = self._axes().unbind(1)  # along and across
        return self._sample(centers, radius_x, torch.stack([u * (1 + shear[:, :1]), v + u * shear[:, 1:]], 1))

    def outside(self, start: Tensor, count: int) -> Tensor:
        """(m, count) bool, which places from ``start`` on along the lines are not known."""
        steps = torch.arange(count, device=start.device, dtype=torch.float32)
        points = ((start - self.origin)[:, None] + steps[:, None] * self.along[:, None]).round().long()
        size = points.new_tensor([self.known.shape[1], self.known.shape[0]])
        inside = ((points >= 0) & (points < size)).all(2)
        x, y = torch.where(inside[..., None], points, 0).unbind(2)
        return ~inside | ~self.known[y, x]

    def select(self, rows: slice | Tensor) -> LineSampler:
        """That of some matches."""
        return self._replace(along=self.along[rows])

    def place(self, points: Tensor, along: Tensor, across: Tensor) -> Tensor:
        """(m, 2) px, points moved along and across the lines."""
        u, v = self._axes().unbind(1)
        return points + along[:, None] * u + across[:, None] * v

    def _axes(self) -> Tensor:
        """(m, 2, 2) unit vectors along and across, y down."""
        x, y = self.along.unbind(1)
        return torch.stack([self.along, torch.stack([-y, x], 1)], 1)

    def _sample(self, centers: Tensor, radius_x: int, axes: Tensor) -> Tensor:
        offsets = torch.arange(-radius_x, radius_x + 1, device=centers.device, dtype=torch.float32)
        return sample_frames(self.image, centers - self.origin, axes, offsets)


Sampler = RowSampler | LineSampler


def search_line(
    look: Sampler, points: Tensor, across: Tensor, first: Tensor, count: int, *, reverse: bool
) -> tuple[Tensor, Tensor]:
    """Strips of the other view whose windows lie at some disparities of each point.

    Args:
        look: At the other view.
        points: (m, 2) px.
        across: (m,) px, how far across a point its line lies in the other view.
        first: (m,) px, the least disparity; ``count`` - 1 px more is the greatest.
        count: Number of disparities D.
        reverse: Whether disparity grows against the columns: from view 0 to view 1.

    Returns:
        (m, 15, D + 14) grey levels, and (m, D) bool, which places lie outside; both along the columns, so that reversed
        ones begin with the greatest disparity.

    >>> look = RowSampler(torch.arange(9.0).expand(5, 9))
    >>> search_line(look, torch.tensor([[4.0, 2.0]]), torch.zeros(1), torch.tensor([3.0]), 3, reverse=True)[1]
    tensor([[ True, False, False]])
    """
    begin = look.place(points, -(first + max(count - 1, 0)) if reverse else first, across)
    before = look.place(begin, torch.full_like(first, -RADIUS_PX), torch.zeros_like(across))
    return look.strips(before, count + 2 * RADIUS_PX), look.outside(begin, count)


def look_at_pairs(
    views: Sequence[Sequence[Tensor]], matches: Matches, places: Place, alignment: Alignment
) -> Iterator[tuple[tuple[Sampler, Sampler], Place]]:
    """How both views of each pair are looked at, and the places of its matches.

    Args:
        views: The B images (C, H, W) of view 0, and those of view 1, whose common change of brightness is taken out.
        matches: B pairs.
        places: Those of all matches.
        alignment: What the matches of every pair share.
    """
    for b, (start, stop) in enumerate(pairwise(matches.ptr.tolist())):
        gray = [to_gray(images[b][None])[0, 0].float().to(matches.ptr.device) for images in views]
        points = matches.keypoints0[start:stop], matches.keypoints1[start:stop]
        gray[1] = gray[1] - _brighter(gray, *points)
        own = places.select(slice(start, stop))
        if bool(alignment.rectified[b]):
            yield (RowSampler(gray[0]), RowSampler(gray[1])), own
            continue
        warped = warp_view(gray[0], gray[1], alignment.to_view0[b], points[1])
        known0 = torch.ones_like(gray[0], dtype=torch.bool)
        looks = (
            LineSampler(warped.image0, torch.zeros_like(warped.origin), own.along, known0),
            LineSampler(warped.image1, warped.origin, own.along, warped.known1),
        )
        yield looks, own


def _brighter(gray: Sequence[Tensor], points0: Tensor, points1: Tensor) -> Tensor:
    """() by how many grey levels view 1 is brighter, the median over the matches of a pair."""
    if not len(points0):
        return gray[0].new_zeros(())
    levels = []
    for image, points in zip(gray, (points0, points1), strict=True):
        smooth = functional.avg_pool2d(image[None, None], 5, 1, 2, count_include_pad=False)[0, 0]
        x, y = (
            place.round().clamp(0, size - 1).long() for place, size in zip(points.t(), smooth.t().shape, strict=True)
        )
        levels.append(smooth[y, x])
    return torch.quantile(levels[1] - levels[0], 0.5)  # the same in a mirror, unlike the lower median


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
    kernel = (kernel / kernel.sum())[None, None, None]
    padded = functional.pad(image[None, None], (radius,) * 4, mode="reflect")
    return functional.conv2d(functional.conv2d(padded, kernel), kernel.transpose(2, 3))[0, 0]
