"""Rows of rectified pairs: offset and slow drift, fitted to matches of which most are right.

The cameras of a rectified pair are seldom calibrated to a fraction of a pixel: view 1 lies some rows higher or lower
than it should, and drifts slowly over the image.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from tensor_stereo.scores.alignment.form import LEAST_AGREEING, Alignment, no_alignment
from tensor_stereo.scores.alignment.pair_sums import PairSums, say, select_rows
from tensor_stereo.types import Matches, check_mask, check_vector

_MAX_OFFSET_PX, _BIN_PX = 256, 2  # the first guess of the offset is the middle of the fullest bins
_SCALES_PX = (6.0, 3.0, 1.5, 0.8, 0.5)  # of the noise, round by round
_SLOPE_PRIOR, _TILT_PRIOR = 0.02, 0.005  # standard deviations of the drift, and of that with the disparity, px/px
_LEAST_SHIFT_PX = 0.1  # what is smaller all over the pair is none
_MAX_DRIFT = 0.05  # px/px; what drifts more is not rectified
FIT_PX = 1.5  # most of the matches that agree must lie that near to their rows


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
    rows, pairs = select_rows(matches, agreeing)
    batch = pairs.batch
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
        fit = _solve(say((offset - _at(fit, basis, batch)) / scale_px), basis, offset, scale_px, pairs)
    fitted_offset = _at(fit, basis, batch)
    near = ((offset - fitted_offset).abs() <= FIT_PX).to(one)
    is_slow = (fit[:, 1:].abs() <= _MAX_DRIFT).all(1)
    fitted = (count >= LEAST_AGREEING) & is_slow & (2 * pairs.sum(near) >= count)
    largest = torch.zeros_like(count).scatter_reduce(0, batch, fitted_offset.abs(), "amax")
    coefficients = torch.cat([fit[:, :1] - (fit[:, 1:] * middle).sum(1, keepdim=True), fit[:, 1:]], 1)
    keep = fitted & (largest >= _LEAST_SHIFT_PX)
    return no_alignment(matches.num_pairs, offset)._replace(
        coefficients=torch.where(keep[:, None], coefficients, 0), fitted=fitted, num_agreeing=count.long()
    )


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


def _solve(weight: Tensor, basis: list[Tensor], offset: Tensor, scale_px: float, pairs: PairSums) -> Tensor:
    """(B, 4) coefficients by weighted least squares; a drift of zero counts as an observation."""
    weighted = [weight * values for values in basis]
    upper = {(k, m): pairs.sum(weighted[m] * basis[k] if k else weighted[m]) for m in range(4) for k in range(m + 1)}
    rows = [torch.stack([upper[min(k, m), max(k, m)] for m in range(4)], 1) for k in range(4)]
    normal = torch.stack(rows, 1)  # (B, 4, 4)
    target = torch.stack([pairs.sum(values * offset) for values in weighted], 1)
    slope, tilt = ((scale_px / prior) ** 2 for prior in (_SLOPE_PRIOR, _TILT_PRIOR))
    fit: Tensor = torch.linalg.solve(normal + torch.diag(normal.new_tensor([1e-9, slope, slope, tilt])), target)
    return fit
