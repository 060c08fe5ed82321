"""How the views of a pair are looked at, along rows or along the epipolar lines of matches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tensor_stereo.ops.windows import RADIUS_PX, sample_frames, sample_slanted, sample_strips, sample_windows


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
        x, y = (self.right - self.left).unbind(1)
        return self.along[:, 0] * y - self.along[:, 1] * x - self.across


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


class Views(NamedTuple):
    """The images of B pairs; see :class:`tensor_stereo.scores.samplers.PairViews`."""

    images0: Sequence[Tensor]
    images1: Sequence[Tensor]
    known1: Sequence[Tensor]  # empty where a pair is rectified
    origin: Tensor  # (B, 2)
    brighter: Tensor  # (B,)

    def to_numpy(self) -> tuple[Any, ...]:
        """The same for the kernels."""
        images = ([image.contiguous().numpy(force=True) for image in part] for part in self[:3])
        return *images, *(values.float().contiguous().numpy(force=True) for values in self[3:])

    def look(self, b: int, along: Tensor, *, rectified: bool) -> tuple[Sampler, Sampler]:
        """How both views of a pair are looked at."""
        image0, image1 = self.images0[b].float(), self.images1[b].float() - self.brighter[b]
        if rectified:
            return RowSampler(image0), RowSampler(image1)
        known0 = torch.ones_like(image0, dtype=torch.bool)
        none = torch.zeros_like(self.origin[b])
        return LineSampler(image0, none, along, known0), LineSampler(image1, self.origin[b], along, self.known1[b])

    def look_in_parts(
        self, along: Tensor, ptr: Tensor, rectified: Tensor, rows_at_once: int
    ) -> Iterator[tuple[int, slice, list[Sampler]]]:
        """The pair, the rows and how both views are looked at, for some rows of one pair at a time."""
        for b, (start, stop) in enumerate(pairwise(ptr.tolist())):
            samplers = self.look(b, along[start:stop], rectified=bool(rectified[b]))
            for row in range(start, stop, rows_at_once):
                rows = slice(row, min(row + rows_at_once, stop))
                yield b, rows, [sampler.select(slice(row - start, rows.stop - start)) for sampler in samplers]
