"""The alignment of every pair, from the matches that agree with their neighbours."""

from __future__ import annotations

import torch
from torch import Tensor

from tensor_stereo import ops
from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.configs import Backend, Rectified
from tensor_stereo.graphs import MatchGraphs, check_match_graphs
from tensor_stereo.scores.alignment.form import LEAST_VOTES, Alignment
from tensor_stereo.scores.alignment.pair_sums import PairSums, select_rows
from tensor_stereo.scores.alignment.rows import FIT_PX, fit_alignment
from tensor_stereo.scores.alignment.views import fit_views
from tensor_stereo.types import Matches

_MAX_SHIFT_PX, _MAX_DEVIATION_PX = 4.0, 1.0  # of the rows of rectified pairs; .7 and .6 are the most in published ones
_WIDE_PX = 64.0  # off their rows lie as many as chance leaves anywhere
_LEAST_CROWD, _CROWDED = 4, 4  # so many, and so many times as by chance, lie on rows
_ROW_PX, _DISPARITY_PX, _SLOPE = 1.0, 2.0, 0.2  # how far two neighbours that agree may differ, the last per px of way


@torch.no_grad()
def estimate_alignment(
    matches: Matches, graphs: MatchGraphs, *, rectified: Rectified = True, backend: Backend = "auto"
) -> Alignment:
    """Fit what the matches of every pair share to those that agree with their neighbours.

    Two neighbours of a rectified pair agree if their row offsets and their disparities are alike, which no common shift
    changes; the fit is that of :func:`fit_alignment`. Of any two views they agree if their displacements are alike
    after the map that their pair shares, and that is :func:`tensor_stereo.scores.alignment.views.fit_views`.

    Args:
        matches: B pairs, coordinates in px.
        graphs: The graphs of the same matches.
        rectified: What the pairs are. ``auto`` takes a pair for rectified if most of the matches that agree on a map of
            any two views lie on rows as well, these rows lie at most 4 px from where they should in the mean and vary
            by at most 1 px around that (a standard deviation), and at least half as many agree as neighbours in a
            rectified pair. Where no map is found, it counts whether more of all matches lie within 4 px of their rows
            than chance would leave there.
        backend: As in :func:`tensor_stereo.classify_matches`.

    Returns:
        The alignment of every pair. Rows are the same where it stays below 0.1 px for all matches that agree. A pair
        does not depend on the others. No gradient.

    Raises:
        ValueError: for graphs of another number of matches.

    Example:
        >>> from tensor_stereo.graphs import build_match_graphs
        >>> left = torch.rand(200, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 400
        >>> right = left + torch.stack([torch.full((200,), -5.0), 2 + 0.002 * left[:, 0]], 1)
        >>> right[:60] = right[:60].flip(0)
        >>> matches = Matches(left, right, torch.tensor([0, 200]))
        >>> graphs = build_match_graphs(matches)
        >>> estimate_alignment(matches, graphs).coefficients.round(decimals=2).abs()
        tensor([[2., 0., 0., 0.]], dtype=torch.float64)
        >>> estimate_alignment(matches, graphs, rectified="auto").rectified
        tensor([True])
    """
    check_match_graphs(matches, graphs)
    if rectified is False:
        return fit_views(matches, graphs, backend)[0]
    limits = _ROW_PX, _DISPARITY_PX, _SLOPE, 0.0
    votes = ops.agreeing_neighbors(matches.keypoints0, matches.keypoints1, *graphs.patterns, *limits, backend)
    rows = fit_alignment(matches, votes >= LEAST_VOTES)
    if rectified is True:
        return rows
    views, agreeing = fit_views(matches, graphs, backend)
    wider = fit_alignment(matches, agreeing)  # to what agrees under wider limits
    on_rows = wider.fitted & _are_steady(matches, wider, agreeing) & (2 * rows.num_agreeing >= views.num_agreeing)
    takes_rows = torch.where(views.fitted, on_rows, _crowd_on_rows(matches))
    return _choose(takes_rows, _choose(rows.fitted, rows, wider), views)


def _choose(first: Tensor, one: Alignment, other: Alignment) -> Alignment:
    """One alignment for the pairs where a (B,) mask holds, another elsewhere."""
    return Alignment(
        *(torch.where(first.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(one, other, strict=True))
    )


def _are_steady(matches: Matches, rows: Alignment, agreeing: Tensor) -> Tensor:
    """(B,) bool, whether rows lie where those of a rectified pair may, at the matches that agree and lie on them."""
    shift = rows.row_shift(matches)
    chosen, pairs = select_rows(matches, agreeing & ((_row_offset(matches) - shift).abs() <= FIT_PX))
    shift = shift.index_select(0, chosen)
    count = pairs.sum(torch.ones_like(shift)).clamp(min=1)
    mean = pairs.sum(shift) / count
    variance = pairs.sum((shift - pairs.spread(mean)).square()) / count
    return (mean.abs() <= _MAX_SHIFT_PX) & (variance <= _MAX_DEVIATION_PX**2)


def _crowd_on_rows(matches: Matches) -> Tensor:
    """(B,) bool, whether more matches of all lie near their rows than chance would leave there."""
    offset = _row_offset(matches).abs()
    pairs = PairSums(ptr_to_batch(matches.ptr), matches.ptr)
    near, wide = (pairs.sum((offset <= limit).double()) for limit in (_MAX_SHIFT_PX, _WIDE_PX))
    by_chance = (wide - near) * (_MAX_SHIFT_PX / (_WIDE_PX - _MAX_SHIFT_PX))
    return near >= _LEAST_CROWD + _CROWDED * by_chance


def _row_offset(matches: Matches) -> Tensor:
    return matches.keypoints1[:, 1].double() - matches.keypoints0[:, 1].double()
