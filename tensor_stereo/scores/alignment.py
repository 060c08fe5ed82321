"""Alignment: what all matches of a pair share, which says nothing about one of them.

The cameras of a rectified pair are seldom calibrated to a fraction of a pixel: view 1 lies some rows higher or lower
than it should, and drifts slowly over the image. The matches that agree with their neighbours tell by how much.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from tensor_stereo import ops
from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.configs import Backend
from tensor_stereo.graphs import MatchGraphs, check_match_graphs
from tensor_stereo.types import Matches, check_mask, check_vector

_LEAST_AGREEING = 12  # matches that a fit needs
_LEAST_VOTES = 3  # of neighbours, counted in each view
_ROW_PX, _DISPARITY_PX, _SLOPE = 1.0, 2.0, 0.2  # how far two neighbours that agree may differ, the last per px of way
_MAX_OFFSET_PX, _BIN_PX = 256, 2  # the first guess of the offset is the middle of the fullest bins
_SCALES_PX = (6.0, 3.0, 1.5, 0.8, 0.5)  # of the noise, round by round
_SLOPE_PRIOR, _TILT_PRIOR = 0.02, 0.005  # standard deviations of the drift, and of that with the disparity, px/px
_LEAST_SHIFT_PX = 0.1  # what is smaller all over the pair is none
_MAX_DRIFT = 0.05  # px/px; what drifts more is not rectified
_FIT_PX = 1.5  # most of the matches that agree must lie that near to their rows


class Alignment(NamedTuple):
    """Where the rows of view 0 lie in view 1: ``y1 - y0 = a + b x0 + c y0 + e d`` for the matches that agree.

    With disparity d = x0 - x1 these are affine epipolar lines (Shapiro, Zisserman & Brady, IJCV 16, 1995), nearly along
    the rows, whichever camera is turned; e alone is a baseline that is not level.

    Attributes:
        coefficients: (B, 4) float64, a in px and b, c, e in px per px; zero where nothing was fitted.
        fitted: (B,) bool, whether at least 12 matches agree, and most of them lie within 1.5 px of rows that drift by
            at most 5 %. Where they do not, scores expect rows to be the same.
        num_agreeing: (B,) int64 matches that it was fitted to.
    """

    coefficients: Tensor
    fitted: Tensor
    num_agreeing: Tensor

    @property
    def unfit(self) -> Tensor:
        """(B,) bool, whether enough matches agree with their neighbours, but on no rows."""
        return ~self.fitted & (self.num_agreeing >= _LEAST_AGREEING)

    def select(self, start: int, stop: int) -> Alignment:
        """That of pairs ``start`` to ``stop - 1``."""
        return Alignment(*(values[start:stop] for values in self))

    def row_shift(self, matches: Matches) -> Tensor:
        """(M,) float64 px, how much lower the row of each match in view 1 is expected than in view 0; a constant."""
        a, b, c, e = self.coefficients.index_select(0, ptr_to_batch(matches.ptr)).unbind(1)
        x, y = matches.keypoints0.detach().double().unbind(1)
        return a + b * x + c * y + e * (x - matches.keypoints1[:, 0].detach().double())


def align_matches(matches: Matches, alignment: Alignment) -> Matches:
    """The matches with view 1 moved such that partners lie on one row. Gradients flow to the keypoints.

    >>> points = torch.tensor([[1.0, 2.0]])
    >>> three_rows = torch.tensor([[3.0, 0.5, 0.0, 0.0]], dtype=torch.float64)
    >>> alignment = Alignment(three_rows, torch.tensor([True]), torch.tensor([40]))
    >>> align_matches(Matches(points, points, torch.tensor([0, 1])), alignment).keypoints1
    tensor([[ 1.0000, -1.5000]], dtype=torch.float64)
    """
    shift = alignment.row_shift(matches)
    moved = matches.keypoints1.double() - torch.stack([torch.zeros_like(shift), shift], 1)
    return Matches(matches.keypoints0.double(), moved, matches.ptr, matches.cost, matches.group)


@torch.no_grad()
def estimate_alignment(matches: Matches, graphs: MatchGraphs, *, backend: Backend = "auto") -> Alignment:
    """Fit row offset and slow row drift of every pair to the matches that agree with their neighbours.

    Two neighbours agree if their row offsets and their disparities are alike, which no common shift changes. The fit is
    that of :func:`fit_alignment`.

    Args:
        matches: B pairs of views that are rectified up to the alignment, coordinates in px.
        graphs: The graphs of the same matches.
        backend: As in :func:`tensor_stereo.classify_matches`.

    Returns:
        The alignment of every pair. It is zero where it stays below 0.1 px for all matches that agree. A pair does not
        depend on the others. No gradient.

    Raises:
        ValueError: for graphs of another number of matches.

    Example:
        >>> from tensor_stereo.graphs import build_match_graphs
        >>> left = torch.rand(200, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 400
        >>> right = left + torch.stack([torch.full((200,), -5.0), 2 + 0.01 * left[:, 0]], 1)
        >>> right[:60] = right[:60].flip(0)
        >>> matches = Matches(left, right, torch.tensor([0, 200]))
        >>> estimate_alignment(matches, build_match_graphs(matches)).coefficients.round(decimals=2)
        tensor([[2.0000, 0.0100, 0.0000, 0.0000]], dtype=torch.float64)
    """
    check_match_graphs(matches, graphs)
    votes = ops.agreeing_neighbors(
        matches.keypoints0,
        matches.keypoints1,
        graphs.adjacency0.crow_indices,
        graphs.adjacency0.col_indices,
        graphs.adjacency1.crow_indices,
        graphs.adjacency1.col_indices,
        _ROW_PX,
        _DISPARITY_PX,
        _SLOPE,
        backend,
    )
    return fit_alignment(matches, votes >= _LEAST_VOTES)


@torch.no_grad()
def fit_alignment(matches: Matches, agreeing: Tensor) -> Alignment:
    """Fit row offset and slow row drift of every pair to some of its matches.

    The fit is least squares, reweighted with ever smaller tolerance until wrong matches among them have no say (the
    weights of Geman & McClure 1987).

    Args:
        matches: B pairs of views that are rectified up to the alignment, coordinates in px.
        agreeing: (M,) bool, the matches that have a say, most of which are right. Their coordinates are finite.

    Returns:
        The alignment of every pair. It is zero where it stays below 0.1 px for all matches that have a say. A pair does
        not depend on the others. No gradient.

    Raises:
        ValueError, TypeError: unless ``agreeing`` is a mask of the matches.

    >>> left = torch.rand(40, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 400
    >>> matches = Matches(left, left + torch.tensor([-5, 2]), torch.tensor([0, 40]))
    >>> fit_alignment(matches, torch.arange(40) < 20).coefficients.round(decimals=3)
    tensor([[2., -0., -0., 0.]], dtype=torch.float64)
    """
    check_vector("agreeing", agreeing, matches.num_matches)
    check_mask("agreeing", agreeing)
    rows = agreeing.nonzero()[:, 0]
    batch = ptr_to_batch(matches.ptr).index_select(0, rows)
    pairs = _Rows(batch, functional.pad(agreeing.cumsum(0), (1, 0)).index_select(0, matches.ptr))
    left, right = (view.double().index_select(0, rows) for view in (matches.keypoints0, matches.keypoints1))
    offset = right[:, 1] - left[:, 1]
    one = torch.ones_like(offset)
    count = pairs.sum(one)
    given = (left[:, 0], left[:, 1], left[:, 0] - right[:, 0])
    middle = torch.stack([pairs.sum(values) / count.clamp(min=1) for values in given], 1)  # (B, 3)
    # from the middle, so that offset and drift hardly depend on each other
    basis = [one, *(values - mean for values, mean in zip(given, middle.index_select(0, batch).unbind(1), strict=True))]
    fit = functional.pad(_fullest(offset, one, batch, matches.num_pairs)[:, None], (0, 3))  # (B, 4)
    for scale_px in _SCALES_PX:
        relative = (offset - _at(fit, basis, batch)) / scale_px
        fit = _solve(1 / (1 + relative.square()).square(), basis, offset, scale_px, pairs)
    fitted_offset = _at(fit, basis, batch)
    near = ((offset - fitted_offset).abs() <= _FIT_PX).to(one)
    is_slow = (fit[:, 1:].abs() <= _MAX_DRIFT).all(1)
    fitted = (count >= _LEAST_AGREEING) & is_slow & (2 * pairs.sum(near) >= count)
    largest = torch.zeros_like(count).scatter_reduce(0, batch, fitted_offset.abs(), "amax")
    coefficients = torch.cat([fit[:, :1] - (fit[:, 1:] * middle).sum(1, keepdim=True), fit[:, 1:]], 1)
    keep = fitted & (largest >= _LEAST_SHIFT_PX)
    return Alignment(torch.where(keep[:, None], coefficients, 0), fitted, count.long())


class _Rows(NamedTuple):
    """Which pair the rows belong to, which lie pair by pair."""

    batch: Tensor  # (K,)
    ptr: Tensor  # (B + 1,)

    def sum(self, values: Tensor) -> Tensor:
        """(B,) sums of (K,) values over the rows of each pair."""
        if torch.compiler.is_compiling():  # it knows no sums of segments
            return values.new_zeros(len(self.ptr) - 1).index_add(0, self.batch, values)
        return torch.segment_reduce(values, "sum", offsets=self.ptr)  # four times as fast


def _at(fit: Tensor, basis: list[Tensor], batch: Tensor) -> Tensor:
    a, b, c, e = (
        fit.t().contiguous().index_select(1, batch).unbind(0)
    )  # column by column, which takes a fifth of the time
    return a + b * basis[1] + c * basis[2] + e * basis[3]


def _fullest(offset: Tensor, weight: Tensor, batch: Tensor, num_pairs: int) -> Tensor:
    """(B,) middle of the three neighbouring bins of offsets that hold the most matches."""
    num_bins = 2 * _MAX_OFFSET_PX // _BIN_PX
    place = ((offset + _MAX_OFFSET_PX) / _BIN_PX).floor().clamp(1, num_bins - 2).long()
    counts = weight.new_zeros(num_pairs * num_bins).index_add(0, batch * num_bins + place, weight)
    counts = counts.reshape(num_pairs, num_bins)
    three = counts[:, :-2] + counts[:, 1:-1] + counts[:, 2:]
    return (three.argmax(1) + 1.5) * _BIN_PX - _MAX_OFFSET_PX


def _solve(weight: Tensor, basis: list[Tensor], offset: Tensor, scale_px: float, pairs: _Rows) -> Tensor:
    """(B, 4) coefficients by weighted least squares; a drift of zero counts as an observation."""
    weighted = [weight * values for values in basis]
    upper = {(k, m): pairs.sum(weighted[m] * basis[k] if k else weighted[m]) for m in range(4) for k in range(m + 1)}
    rows = [torch.stack([upper[min(k, m), max(k, m)] for m in range(4)], 1) for k in range(4)]
    normal = torch.stack(rows, 1)  # (B, 4, 4)
    target = torch.stack([pairs.sum(values * offset) for values in weighted], 1)
    slope, tilt = ((scale_px / prior) ** 2 for prior in (_SLOPE_PRIOR, _TILT_PRIOR))
    fit: Tensor = torch.linalg.solve(normal + torch.diag(normal.new_tensor([1e-9, slope, slope, tilt])), target)
    return fit
