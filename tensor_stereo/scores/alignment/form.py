"""What an alignment is, and how it is taken out of matches."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.scores.alignment.pair_sums import PairSums
from tensor_stereo.types import Matches

LEAST_AGREEING = 12  # matches that a fit needs
LEAST_VOTES = 3  # of neighbours that agree with one of them, counted in each view
_NOWHERE = 1e-12  # shorter normals of lines have no direction
_LEAST_DEPTH = 1e-3  # of the denominator of a homography; what lies beyond its horizon stays finite


class Alignment(NamedTuple):
    """What the matches of each of B pairs share.

    Of a rectified pair they share the rows, ``y1 - y0 = a + b x0 + c y0 + e d`` with disparity d = x0 - x1: affine
    epipolar lines (Shapiro, Zisserman & Brady, IJCV 16, 1995), nearly along the rows, whichever camera is turned; e
    alone is a baseline that is not level. Of any two views they share a map, which takes view 1 to where its most
    common surface lies in view 0, and the epipolar lines that the rest of the displacement follows.

    Attributes:
        rectified: (B,) bool, what the pair is taken for.
        coefficients: (B, 4) float64, a in px and b, c, e in px per px; zero where nothing was fitted, and for pairs
            that are not rectified.
        to_view0: (B, 3, 3) float64 homography from px of view 1 to px of view 0; the identity for rectified pairs and
            where nothing was fitted.
        lines: (B, 3, 3) float64 fundamental matrix between px of view 0 and px of view 1 that the homography has taken
            to view 0, ``x1' F x0 = 0``; zero for rectified pairs and where no epipolar line is known.
        fitted: (B,) bool, whether at least 12 matches agree, and most of them lie within 1.5 px of rows that drift by
            at most 5 %, or of epipolar lines or the map. Where they do not, scores expect rows to be the same in
            rectified pairs, and nothing of rows in others.
        num_agreeing: (B,) int64 matches that it was fitted to.
    """

    rectified: Tensor
    coefficients: Tensor
    to_view0: Tensor
    lines: Tensor
    fitted: Tensor
    num_agreeing: Tensor

    @property
    def unfit(self) -> Tensor:
        """(B,) bool, whether enough matches agree with their neighbours, but on nothing that all share."""
        return ~self.fitted & (self.num_agreeing >= LEAST_AGREEING)

    @property
    def has_rows(self) -> Tensor:
        """(B,) bool, whether rows, or the epipolar lines in their place, are known."""
        return self.rectified | (self.lines != 0).any(2).any(1)

    def select(self, start: int, stop: int) -> Alignment:
        """That of pairs ``start`` to ``stop - 1``."""
        return Alignment(*(values[start:stop] for values in self))

    def row_shift(self, matches: Matches) -> Tensor:
        """(M,) float64 px, how much lower the row of each match in view 1 is expected than in view 0; a constant."""
        a, b, c, e = self.coefficients.index_select(0, ptr_to_batch(matches.ptr)).unbind(1)
        x, y = matches.keypoints0.detach().double().unbind(1)
        return a + b * x + c * y + e * (x - matches.keypoints1[:, 0].detach().double())


class EpipolarFrames(NamedTuple):
    """Where the M matches of views that are not rectified lie, seen along their epipolar lines.

    Attributes:
        partners: (M, 2) float64 px, view 1 taken to view 0; gradients flow to the keypoints of view 1.
        along: (M, 2) float64 unit vectors of view 0 along the line of each match, ``(1, 0)`` without lines; a constant.
            They point to the right in the mean of a pair.
        moved: (M, 2) float64 px, how far partners lie from their keypoints, along the line and off it; along columns
            and rows without lines. Gradients flow to the keypoints.
        turn: (B, 2) float64 unit vector, the mean of ``along``; a constant.
        spread: (B,) float64 in [0, 1], one less the length of the mean of ``along``: 0 where lines are parallel, and
            from about .15 on where they meet among the keypoints.
    """

    partners: Tensor
    along: Tensor
    moved: Tensor
    turn: Tensor
    spread: Tensor


def epipolar_frames(matches: Matches, alignment: Alignment) -> EpipolarFrames:
    """The epipolar frame of every match, also of rectified pairs, where it is that of the image.

    >>> points = torch.tensor([[1.0, 2.0], [5.0, 7.0]], dtype=torch.float64)
    >>> along_columns = torch.tensor([[[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]], dtype=torch.float64)
    >>> alignment = no_alignment(1, points)._replace(lines=along_columns, rectified=torch.tensor([False]))
    >>> epipolar_frames(Matches(points, points, torch.tensor([0, 2])), alignment).along.abs()
    tensor([[0., 1.],
            [0., 1.]], dtype=torch.float64)
    """
    batch = ptr_to_batch(matches.ptr)
    left = matches.keypoints0.double()
    partners = map_points(alignment.to_view0, matches.keypoints1.double(), batch)
    x, y = left.detach().unbind(1)
    lines = alignment.lines.reshape(-1, 9).t().contiguous().index_select(1, batch).unbind(0)
    normal_x, normal_y, constant = (lines[k] * x + lines[k + 1] * y + lines[k + 2] for k in (0, 3, 6))
    length = (normal_x.square() + normal_y.square()).sqrt()  # of the same bits in any batch, unlike hypot
    has_line = length > _NOWHERE
    safe = torch.where(has_line, length, 1)
    along = torch.where(has_line[:, None], torch.stack([normal_y, -normal_x], 1) / safe[:, None], _right(x)[None])
    turn = PairSums(batch, matches.ptr).sum(along)
    flip = torch.where((turn[:, 0] < 0) | ((turn[:, 0] == 0) & (turn[:, 1] < 0)), -1.0, 1.0)
    length = turn.square().sum(1, keepdim=True).sqrt()
    spread = 1 - length[:, 0] / matches.ptr.diff().clamp(min=1)
    turn = torch.where(length > _NOWHERE, turn * flip[:, None] / length.clamp(min=_NOWHERE), _right(x)[None])
    flip = flip.index_select(0, batch)
    moved = turn_vectors(partners - left, along * flip[:, None])
    u, v = partners.detach().unbind(1)
    off = torch.where(has_line, (normal_x * u + normal_y * v + constant) / safe * flip, moved[:, 1])
    moved = moved + torch.stack([torch.zeros_like(off), (off - moved[:, 1]).detach()], 1)
    return EpipolarFrames(partners, along * flip[:, None], moved, turn, spread)


def align_matches(matches: Matches, alignment: Alignment) -> Matches:
    """The matches as those of a rectified pair: partners lie on one row. Gradients flow to the keypoints.

    Rows of view 1 are moved in rectified pairs. Others are turned until epipolar lines run along the rows on average,
    and keep in view 1 what their displacement is along the line of each match, and across it.

    >>> points = torch.tensor([[1.0, 2.0]])
    >>> three_rows = torch.tensor([[3.0, 0.5, 0.0, 0.0]], dtype=torch.float64)
    >>> alignment = no_alignment(1, points)._replace(coefficients=three_rows)
    >>> align_matches(Matches(points, points, torch.tensor([0, 1])), alignment).keypoints1
    tensor([[ 1.0000, -1.5000]], dtype=torch.float64)
    """
    shift = alignment.row_shift(matches)
    left = matches.keypoints0.double()
    right = matches.keypoints1.double() - torch.stack([torch.zeros_like(shift), shift], 1)
    if torch.compiler.is_compiling() or not bool(alignment.rectified.all()):
        batch = ptr_to_batch(matches.ptr)
        frames = epipolar_frames(matches, alignment)
        is_rectified = alignment.rectified.index_select(0, batch)[:, None]
        turned = turn_vectors(left, frames.turn.index_select(0, batch))
        left, right = torch.where(is_rectified, left, turned), torch.where(is_rectified, right, turned + frames.moved)
    return Matches(left, right, matches.ptr, matches.cost, matches.group)


def no_alignment(num_pairs: int, like: Tensor, *, rectified: bool = True) -> Alignment:
    """That of pairs of which nothing is known, on the device of a tensor.

    >>> no_alignment(2, torch.zeros(1)).has_rows
    tensor([True, True])
    """
    zero = torch.zeros(num_pairs, 4, dtype=torch.float64, device=like.device)
    identity = torch.eye(3, dtype=torch.float64, device=like.device).expand(num_pairs, 3, 3)
    none = torch.zeros(num_pairs, dtype=torch.bool, device=like.device)
    return Alignment(none | rectified, zero, identity, torch.zeros_like(identity), none, none.long())


def alignment_kind(matches: Matches, alignment: Alignment) -> Tensor:
    """(M,) int64, what the pair of each match is: 0 rectified, 1 not, with epipolar lines, 2 without.

    >>> points = torch.zeros(1, 2)
    >>> alignment_kind(Matches(points, points, torch.tensor([0, 1])), no_alignment(1, points, rectified=False))
    tensor([2])
    """
    kind = torch.where(alignment.rectified, 0, torch.where(alignment.has_rows, 1, 2))
    return kind.index_select(0, ptr_to_batch(matches.ptr))


def map_points(homography: Tensor, points: Tensor, batch: Tensor) -> Tensor:
    """(M, 2) points under the homography (B, 3, 3) of their pair; gradients flow to the points.

    >>> twice = torch.diag(torch.tensor([2.0, 2.0, 1.0], dtype=torch.float64))[None]
    >>> map_points(twice, torch.tensor([[1.0, 3.0]], dtype=torch.float64), torch.tensor([0]))
    tensor([[2., 6.]], dtype=torch.float64)
    """
    m = homography.reshape(-1, 9).t().contiguous().index_select(1, batch).unbind(0)
    x, y = points.unbind(1)
    depth = (m[6] * x + m[7] * y + m[8]).clamp(min=_LEAST_DEPTH)
    return torch.stack([(m[0] * x + m[1] * y + m[2]) / depth, (m[3] * x + m[4] * y + m[5]) / depth], 1)


def turn_vectors(vectors: Tensor, along: Tensor) -> Tensor:
    """(M, 2) coordinates of vectors along unit vectors and across them, a quarter turn from x to y.

    >>> turn_vectors(torch.tensor([[3.0, 4.0]]), torch.tensor([[0.0, 1.0]]))
    tensor([[ 4., -3.]])
    """
    x, y = vectors.unbind(1)
    c, s = along.unbind(1)
    return torch.stack([c * x + s * y, c * y - s * x], 1)


def _right(like: Tensor) -> Tensor:
    return like.new_tensor([1.0, 0.0])
