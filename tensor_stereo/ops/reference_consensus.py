"""The consensus of matches in plain torch: the definition of what the compiled kernel computes."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

_MAX_COST = 1e300  # so that sums of them stay finite
_COST_FLOOR = 1e-2  # of the mean cost; keeps the logarithm of a perfect match finite
_SPREAD_FLOOR = 0.1  # of the logarithm of the cost: alike costs are no evidence
_MAX_EVIDENCE = 8.0  # log-odds


class _Votes(NamedTuple):
    """One vote per direction of each edge of either view, E in all; (E,) each. Lengths are in tolerances."""

    voter: Tensor  # int64
    match: Tensor  # int64
    x: Tensor  # from the match to the voter, halfway between the views
    y: Tensor
    du: Tensor  # displacement of the voter minus that of the match
    dv: Tensor
    weight: Tensor  # of the vote, by distance
    likeness: Tensor  # of the two displacements, in (0, 1]; weighs the voter where the match fits its plane


class _Planes(NamedTuple):
    """The displacement around every match, relative to its own; (M,) each."""

    u: Tensor  # tolerances
    v: Tensor
    ux: Tensor  # px/px
    uy: Tensor
    vx: Tensor
    vy: Tensor


def consensus_belief(
    keypoints0: Tensor,
    keypoints1: Tensor,
    ptr: Tensor,
    cost: Tensor | None,
    row_offset: Tensor | None,
    found1: Tensor | None,
    crow0: Tensor,
    cols0: Tensor,
    crow1: Tensor,
    cols1: Tensor,
    tolerance_px: float,
    whole_tolerance_px: float,
    row_tolerance_px: float,
    whole_row_tolerance_px: float,
    slope: float,
    reach: float,
    doubt: float,
    cost_weight: float,
    num_rounds: int,
) -> Tensor:
    """Beliefs in matches after some rounds, with autograd; see :func:`tensor_stereo.ops.consensus_belief`.

    Example:
        >>> points, ptr, crow = torch.tensor([[0.0, 0.0], [9.0, 0.0]]), torch.tensor([0, 2]), torch.tensor([0, 1, 2])
        >>> graphs = (crow, torch.tensor([1, 0])) * 2
        >>> consensus_belief(points, points, ptr, None, None, None, *graphs, 0.6, 1.0, 0.25, 1.5, 0.2, 2.0, 1.0, 0.5, 1)
        tensor([0.4444, 0.4444], dtype=torch.float64)
    """
    views = keypoints0.double(), keypoints1.double()
    pair = torch.repeat_interleave(
        torch.arange(ptr.shape[0] - 1, device=ptr.device), ptr.diff(), output_size=keypoints0.shape[0]
    )
    count = ptr.diff().clamp(min=1)
    found = (views[0], views[1] if found1 is None else found1.double())
    whole = _whole_pixels(found, row_offset, pair, count)
    evidence = torch.zeros_like(whole)
    if row_offset is not None:
        tolerance = row_tolerance_px + (whole_row_tolerance_px - row_tolerance_px) * whole
        evidence = evidence - torch.log1p((row_offset / tolerance).square())
    if cost is not None:
        evidence = evidence - cost_weight * _standardized_cost(cost.double(), pair, count)
    prior_odds = evidence.clamp(-_MAX_EVIDENCE, _MAX_EVIDENCE).exp()
    tolerance = tolerance_px + (whole_tolerance_px - tolerance_px) * whole
    votes = _collect_votes(views, ((crow0, cols0), (crow1, cols1)), tolerance, reach)
    belief = prior_odds / (1 + prior_odds)
    for _ in range(num_rounds):
        support = _support(votes, belief, slope, doubt)
        belief = support * prior_odds / (support * prior_odds + 1 - support)
    return belief


@torch.no_grad()
def _whole_pixels(views: tuple[Tensor, Tensor], row_offset: Tensor | None, pair: Tensor, count: Tensor) -> Tensor:
    """(M,) how far the keypoints of the pair of each match lie on a grid of one pixel: 1 exactly, 0 anywhere.

    The length of the mean of exp(2 pi i x), for both coordinates in both views; no shift changes it. Rows of view 1
    count as they are or without what all matches share, whichever is nearer to a grid: a rig drifts before keypoints
    are found on whole pixels, somebody may have moved them afterwards.
    """

    def length(values: Tensor) -> Tensor:
        phase = 2 * math.pi * (values - values.round())
        return torch.hypot(*(_mean(part, pair, count) for part in (phase.cos(), phase.sin())))

    x0, y0, x1, y1 = (values for keypoints in views for values in keypoints.T.contiguous())
    last = length(y1) if row_offset is None else torch.maximum(length(y1), length(y0 - row_offset))
    return (length(x0) * length(y0) * length(x1) * last).index_select(0, pair)


def _standardized_cost(cost: Tensor, pair: Tensor, count: Tensor) -> Tensor:
    """(M,) logarithm of the cost, in standard deviations from the mean of its pair.

    In a pair with negative costs, costs count from the lowest one; in a pair with infinite costs, they are no evidence.
    """
    usable = (_mean((cost.abs() <= _MAX_COST).to(cost), pair, count) == 1).index_select(0, pair)
    cost = torch.where(usable, cost, 0)
    lowest = cost.new_zeros(count.shape).scatter_reduce(0, pair, cost, "amin", include_self=False)
    lowest = torch.where(lowest < 0, lowest, 0)
    cost = cost - lowest.index_select(0, pair)
    mean = _mean(cost, pair, count)
    floor = torch.where(mean > 0, _COST_FLOOR * mean, 1).index_select(0, pair)  # any; so that gradients stay finite
    level = torch.log(cost + floor + torch.finfo(cost.dtype).tiny)
    centered = level - _mean(level, pair, count).index_select(0, pair)
    return centered / (_mean(centered.square(), pair, count) + _SPREAD_FLOOR**2).sqrt().index_select(0, pair)


def _mean(values: Tensor, pair: Tensor, count: Tensor) -> Tensor:
    """(B,) mean of the values of each pair."""
    return _sum_at(pair, values, count.shape[0]) / count


def _collect_votes(
    views: tuple[Tensor, Tensor], patterns: tuple[tuple[Tensor, Tensor], ...], tolerance: Tensor, reach: float
) -> _Votes:
    (crow0, _), (crow1, _) = patterns
    # rows and views of the votes without a look at how many there are, which compilers do not know
    entries = [torch.ones_like(cols).cumsum(0) - 1 for _, cols in patterns]
    match = torch.cat(
        [torch.bucketize(entry, crow[1:], right=True) for entry, (crow, _) in zip(entries, patterns, strict=True)]
    )
    voter = torch.cat([cols for _, cols in patterns])
    is_first = torch.cat(
        [torch.full_like(cols, view == 0, dtype=torch.bool) for view, (_, cols) in enumerate(patterns)]
    )
    x0, y0, x1, y1 = (
        values.index_select(0, voter) - values.index_select(0, match)
        for keypoints in views
        for values in (keypoints / tolerance[:, None]).T.contiguous()
    )
    squared = torch.where(is_first, x0 * x0 + y0 * y0, x1 * x1 + y1 * y1)
    degree = (crow0.diff() + crow1.diff()).clamp(min=1)
    typical = _sum_at(match, squared, tolerance.shape[0]) / degree
    weight = 1 / (1 + squared / (reach**2 * typical).index_select(0, match))
    du, dv = x1 - x0, y1 - y0
    likeness = 1 / (1 + du * du + dv * dv)  # Cauchy's
    return _Votes(voter, match, (x0 + x1) / 2, (y0 + y1) / 2, du, dv, weight, likeness)


def _support(votes: _Votes, belief: Tensor, slope: float, doubt: float) -> Tensor:
    """(M,) share of the believed neighbours whose planes predict the match, in [0, 1)."""
    num_matches = belief.shape[0]
    trust = belief.index_select(0, votes.voter) * votes.weight
    planes = _fit_planes(votes, trust, num_matches, slope)
    u, v, ux, uy, vx, vy = (values.index_select(0, votes.voter) for values in planes)
    # The voter's plane at the match, minus the displacement of the match.
    miss_u = votes.du + u - ux * votes.x - uy * votes.y
    miss_v = votes.dv + v - vx * votes.x - vy * votes.y
    agreement = torch.exp((miss_u * miss_u + miss_v * miss_v) / -2)
    agreed, total = (_sum_at(votes.match, values, num_matches) for values in (trust * agreement, trust))
    return agreed / (total + doubt)


def _fit_planes(votes: _Votes, trust: Tensor, num_matches: int, slope: float) -> _Planes:
    """Weighted least squares over the neighbours of every match.

    The match itself counts as one neighbour, and a slope of zero as an observation whose standard deviation is the
    expected slope: with few neighbours the plane is flat and passes through the match.
    """
    weight = trust * votes.likeness
    wx, wy = weight * votes.x, weight * votes.y
    columns = (weight, wx, wy, wx * votes.x, wx * votes.y, wy * votes.y)
    one, sx, sy, sxx, sxy, syy = (_sum_at(votes.match, column, num_matches) for column in columns)
    ridge = slope**-2
    one, sxx, syy = one + 1, sxx + ridge, syy + ridge
    # The inverse of the symmetric matrix, positive definite by what was added, by its cofactors.
    c00, c01, c02 = sxx * syy - sxy * sxy, sxy * sy - sx * syy, sx * sxy - sxx * sy
    c11, c12, c22 = one * syy - sy * sy, sx * sy - one * sxy, one * sxx - sx * sx
    determinant = one * c00 + sx * c01 + sy * c02
    solved = []
    for difference in (votes.du, votes.dv):
        r0, rx, ry = (_sum_at(votes.match, column * difference, num_matches) for column in (weight, wx, wy))
        solved.append([c00 * r0 + c01 * rx + c02 * ry, c01 * r0 + c11 * rx + c12 * ry, c02 * r0 + c12 * rx + c22 * ry])
    (u, ux, uy), (v, vx, vy) = ([part / determinant for part in parts] for parts in solved)
    return _Planes(u, v, ux, uy, vx, vy)


def _sum_at(rows: Tensor, values: Tensor, num_rows: int) -> Tensor:
    """(num_rows,) sums of the values of each row; columns one by one, which torch adds ten times faster than rows."""
    return values.new_zeros(num_rows).index_add(0, rows, values)
