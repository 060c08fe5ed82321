"""The alignment of every pair, from the matches that agree with their neighbours."""

from __future__ import annotations

import torch
from torch import Tensor

from tensor_stereo import ops
from tensor_stereo.configs import Backend, Rectified
from tensor_stereo.graphs import MatchGraphs, check_match_graphs
from tensor_stereo.scores.alignment.form import Alignment
from tensor_stereo.scores.alignment.pair_sums import select_rows
from tensor_stereo.scores.alignment.rows import FIT_PX, fit_alignment
from tensor_stereo.scores.alignment.views import fit_views
from tensor_stereo.types import Matches

_LEAST_VOTES = 3  # of neighbours, counted in each view
_MAX_SHIFT_PX, _MAX_DEVIATION_PX = 4.0, 1.0  # of the rows of rectified pairs; .7 and .6 are the most in published ones
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
            any two views lie on rows as well, and these rows lie at most 4 px from where they should in the mean and
            vary by at most 1 px around that (a standard deviation). A pair that fits neither is not.
        backend: As in :func:`tensor_stereo.classify_matches`.

    Returns:
        The alignment of every pair. Rows are the same where it stays below 0.1 px for all matches that agree. A pair
        does not depend on the others. No gradient.

    Raises:
        ValueError: for graphs of another number of matches.

    Example:
        >>> from tensor_stereo.graphs import build_match_graphs
        >>> left = torch.rand(200, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 400
        >>> right = left + torch.stack([torch.full((200,), -5.0), 2 + 0.01 * left[:, 0]], 1)
        >>> right[:60] = right[:60].flip(0)
        >>> matches = Matches(left, right, torch.tensor([0, 200]))
        >>> graphs = build_match_graphs(matches)
        >>> estimate_alignment(matches, graphs).coefficients.round(decimals=2)
        tensor([[2.0000, 0.0100, 0.0000, 0.0000]], dtype=torch.float64)
        >>> estimate_alignment(matches, graphs, rectified="auto").rectified
        tensor([True])
    """
    check_match_graphs(matches, graphs)
    if rectified is False:
        return fit_views(matches, graphs, backend)[0]
    limits = _ROW_PX, _DISPARITY_PX, _SLOPE, 0.0
    votes = ops.agreeing_neighbors(matches.keypoints0, matches.keypoints1, *graphs.patterns, *limits, backend)
    rows = fit_alignment(matches, votes >= _LEAST_VOTES)
    if rectified is True:
        return rows
    views, agreeing = fit_views(matches, graphs, backend)
    takes_rows = _lie_on_rows(matches, agreeing)
    return Alignment(
        *(
            torch.where(takes_rows.reshape(-1, *[1] * (one.ndim - 1)), one, other)
            for one, other in zip(rows, views, strict=True)
        )
    )


def _lie_on_rows(matches: Matches, agreeing: Tensor) -> Tensor:
    """(B,) bool, whether most of some matches lie on rows, where those of a rectified pair may be."""
    rows = fit_alignment(matches, agreeing)
    shift = rows.row_shift(matches)
    offset = matches.keypoints1[:, 1].double() - matches.keypoints0[:, 1].double()
    chosen, pairs = select_rows(matches, agreeing & ((offset - shift).abs() <= FIT_PX))
    shift = shift.index_select(0, chosen)
    count = pairs.sum(torch.ones_like(shift)).clamp(min=1)
    mean = pairs.sum(shift) / count
    variance = pairs.sum((shift - pairs.spread(mean)).square()) / count
    return rows.fitted & (mean.abs() <= _MAX_SHIFT_PX) & (variance <= _MAX_DEVIATION_PX**2)
