"""Local slopes: how the disparity changes around every match, by the neighbours that lie on its surface."""

from __future__ import annotations

import torch
from torch import Tensor

from tensor_stereo.graphs import MatchGraphs, check_match_graphs
from tensor_stereo.types import Matches

_STEEPEST = 0.5  # px/px
_GAP_PX, _MISS_PX = 2.0, 1.0  # disparities of neighbours that start the fit, and misses that halve a say in it
_REACH_PX = 40.0  # distance at which a neighbour has half a say
_RIDGE = 40.0  # px squared; flattens slopes that too few neighbours hold
_NUM_ROUNDS = 4


@torch.no_grad()
def estimate_slopes(matches: Matches, graphs: MatchGraphs) -> Tensor:
    """How the disparity changes with x and y around every match.

    The frame is the cyclopean one, midway between both views, in which these are alike: with slope s along x the
    disparity changes by s / (1 + s / 2) per px of view 0 and by s / (1 - s / 2) per px of view 1.

    A plane through the disparity of the match is fitted to those of its neighbours in both views, by least squares with
    the weights of Geman & McClure (1987), so that neighbours across a depth edge have no say.

    Args:
        matches: B pairs of rectified views, px.
        graphs: The graphs of the same matches.

    Returns:
        (M, 2) float32 px/px, at most .5 in magnitude; 0 without neighbours. No gradient.

    Raises:
        ValueError: for graphs of another number of matches.

    >>> from tensor_stereo.graphs import build_match_graphs
    >>> left = torch.rand(99, 2, generator=torch.Generator().manual_seed(0)) * 300
    >>> right = left - torch.stack([9 + 0.2 * left[:, 1], torch.zeros(99)], 1)  # a floor
    >>> matches = Matches(left, right, torch.tensor([0, 99]))
    >>> estimate_slopes(matches, build_match_graphs(matches)).median(0).values.round(decimals=1).abs()
    tensor([0.0000, 0.2000])
    """
    check_match_graphs(matches, graphs)
    views = (graphs.adjacency0, graphs.adjacency1)
    i, j = (torch.cat([getattr(view, name) for view in views]) for name in ("row_indices", "col_indices"))
    x, y = ((matches.keypoints0.double() + matches.keypoints1.double()) / 2).unbind(1)
    disparity = matches.keypoints0[:, 0].double() - matches.keypoints1[:, 0].double()
    dx, dy, gap = (values.index_select(0, j) - values.index_select(0, i) for values in (x, y, disparity))
    length = (dx * dx + dy * dy).sqrt()
    near = 1 / (1 + (length / _REACH_PX).square())
    starts = gap.abs() <= _GAP_PX + _STEEPEST * length
    weight = starts / (1 + (gap / (1 + 0.2 * length)).square())
    slope_x = slope_y = torch.zeros_like(x)
    for _ in range(_NUM_ROUNDS):
        wx, wy = weight * near * dx, weight * near * dy
        columns = (wx * dx, wx * dy, wy * dy, wx * gap, wy * gap)
        xx, xy, yy, gx, gy = (torch.zeros_like(x).index_add(0, i, column) for column in columns)
        xx, yy = xx + _RIDGE, yy + _RIDGE
        determinant = xx * yy - xy * xy
        slope_x, slope_y = (gx * yy - gy * xy) / determinant, (gy * xx - gx * xy) / determinant
        miss = gap - slope_x.index_select(0, i) * dx - slope_y.index_select(0, i) * dy
        weight = 1 / (1 + (miss / _MISS_PX).square()).square()
    return torch.stack([slope_x, slope_y], 1).clamp(-_STEEPEST, _STEEPEST).float()
