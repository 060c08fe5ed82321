"""Refine: kept matches move to where the windows of both views fit best, to a fraction of a pixel.

Windows lie half-way along the slope of the surface in either view. Gauss-Newton steps along the epipolar line minimise
the zero-mean sum of squared differences, over pixels near the centre and like it. Believed neighbours then say how far
the minimum is to be trusted (maximum a posteriori, their planes being the prior).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tensor_stereo.batching import ptr_to_batch, select_matches
from tensor_stereo.configs import Backend
from tensor_stereo.features import list_images
from tensor_stereo.graphs import MatchGraphs, build_match_graphs, check_match_graphs
from tensor_stereo.ops._window_refine import window_refine
from tensor_stereo.scores.alignment.form import Alignment, align_matches, epipolar_frames, map_points, no_alignment
from tensor_stereo.scores.repair import Origin
from tensor_stereo.scores.samplers import blur, find_places, list_views, prepare_views
from tensor_stereo.scores.slopes import estimate_slopes
from tensor_stereo.types import Matches, check_mask, check_vector

_BLUR = 1.4  # as in so many times fewer pixels; interpolation then smooths all places alike, which locks no pixel
_DISTRUST = 16.0  # times the variance that noise alone would give a minimum
_PRIOR_PX, _PRIOR_SLOPE, _PRIOR_REACH_PX, _PRIOR_MISS_PX = 0.1, 0.01, 25.0, 0.5


def refine_matches(
    matches: Matches,
    images0: Tensor | Sequence[Tensor],
    images1: Tensor | Sequence[Tensor],
    kept: Tensor,
    alignment: Alignment | None = None,
    graphs: MatchGraphs | None = None,
    *,
    max_shift_px: float = 1.0,
    backend: Backend = "auto",
) -> Matches:
    """Move the keypoints of view 1 of kept matches to where the windows of both views fit best.

    They move along their epipolar line, the row of rectified pairs, and onto it.

    Args:
        matches: B pairs, keypoints in px of the images.
        images0: B images (C, H, W) of view 0, as :func:`tensor_stereo.scores.image_evidence.measure_images` takes them.
        images1: Their partners.
        kept: (M,) bool, the matches that move, and that are neighbours to be believed.
        alignment: What the matches of every pair share; None: rectified pairs with the same rows in both views.
        graphs: The graphs of the same matches; None: they are built.
        max_shift_px: No keypoint moves farther, in px of view 0.
        backend: A name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        The same matches, some of them elsewhere in view 1, never where their windows fit worse. A pair does not depend
        on the others. Gradients flow to the keypoints as if the shifts did not depend on them; none flow to the images.

    Raises:
        ValueError, TypeError: for images, graphs or a mask that do not fit the matches, or a ``max_shift_px`` that is
            not positive.

    >>> from tensor_stereo.datasets.synthetic.rendering import render_pair
    >>> pair = render_pair(2)
    >>> grid = torch.cartesian_prod(torch.arange(60, 340, 12), torch.arange(30, 270, 12)).double()
    >>> disparity = pair.disparity_gt[grid[:, 1].long(), grid[:, 0].long()].double()
    >>> off = torch.stack([disparity - disparity.round(), torch.zeros(len(grid))], 1)  # whole px of disparity
    >>> right = grid - torch.stack([disparity, torch.zeros(len(grid))], 1)
    >>> matches = Matches(grid, right + off, torch.tensor([0, len(grid)]))
    >>> kept = torch.ones(len(grid), dtype=torch.bool)
    >>> moved = refine_matches(matches, [pair.image0], [pair.image1], kept)
    >>> bool((moved.keypoints1 - right).abs().median(0).values[0] < 0.15 < off.abs().median(0).values[0])
    True
    """
    views = [list_images(name, x, matches.num_pairs) for name, x in (("images0", images0), ("images1", images1))]
    graphs = build_match_graphs(matches) if graphs is None else graphs
    check_match_graphs(matches, graphs)
    check_vector("kept", kept, matches.num_matches)
    check_mask("kept", kept)
    if not max_shift_px > 0:
        raise ValueError(f"max_shift_px must be positive, got {max_shift_px}")
    if alignment is None:
        alignment = no_alignment(matches.num_pairs, matches.keypoints0)
    with torch.no_grad():
        along, across = _find_shifts(views, matches, graphs, kept, alignment, max_shift_px, backend)
        frames = epipolar_frames(matches, alignment)
        x, y = torch.where(_is_rectified(matches, alignment), frames.along.new_tensor([1.0, 0.0]), frames.along).unbind(
            1
        )
        step = torch.stack([x * along - y * across, y * along + x * across], 1)
        back = torch.linalg.inv_ex(alignment.to_view0)[0]
        there = map_points(back, frames.partners + step, ptr_to_batch(matches.ptr))
        shift = torch.where(((along != 0) | (across != 0))[:, None], there - matches.keypoints1.double(), 0)
    moved = matches.keypoints1 + shift.to(matches.keypoints1.dtype)
    return Matches(matches.keypoints0, moved, matches.ptr, matches.cost, matches.group)


def _is_rectified(matches: Matches, alignment: Alignment) -> Tensor:
    return alignment.rectified.index_select(0, ptr_to_batch(matches.ptr))[:, None]


def _find_shifts(
    views: Sequence[Sequence[Tensor]],
    matches: Matches,
    graphs: MatchGraphs,
    kept: Tensor,
    alignment: Alignment,
    max_shift_px: float,
    backend: Backend,
) -> tuple[Tensor, Tensor]:
    """(M,) px of view 0 along and across the lines, 0 where a match stays."""
    aligned = align_matches(matches, alignment)
    places = find_places(matches, aligned, estimate_slopes(aligned, graphs), alignment)
    rows = kept.nonzero()[:, 0]
    own = places.select(rows)
    pairs = [
        pair._replace(image0=blur(pair.image0.float(), _BLUR), image1=blur(pair.image1.float(), _BLUR))
        for pair in prepare_views(views, matches, alignment)
    ]
    with torch.autocast(matches.keypoints0.device.type, enabled=False):
        moved = window_refine(
            *list_views(pairs, matches.ptr.device), own.left, own.right, own.along, own.off_line, own.slope,
            select_matches(matches, kept).ptr, alignment.rectified, max_shift_px, backend,
        )  # fmt: skip
    still = torch.zeros(matches.num_matches, device=matches.ptr.device)
    along, across, variance = (still.index_copy(0, rows, part) for part in moved)
    along = _trust_neighbors(aligned, graphs, kept, along, variance)
    limit = (max_shift_px**2 - across.square()).clamp(min=0).sqrt()
    return along.clamp(-limit, limit).double(), across.double()


def _trust_neighbors(aligned: Matches, graphs: MatchGraphs, kept: Tensor, along: Tensor, variance: Tensor) -> Tensor:
    """(M,) shifts along the lines, between what the images say and what the planes of believed neighbours predict."""
    measured = (aligned.keypoints0[:, 0] - aligned.keypoints1[:, 0]).float() - along
    moved = aligned.keypoints0[:, 0] - measured.double()
    right = torch.stack([moved, aligned.keypoints1[:, 1]], 1)
    slope = estimate_slopes(Matches(aligned.keypoints0, right, aligned.ptr), graphs)
    i, j = (
        torch.cat([getattr(graph, name) for graph in (graphs.adjacency0, graphs.adjacency1)])
        for name in ("row_indices", "col_indices")
    )
    heard = (kept.index_select(0, i) & kept.index_select(0, j)).nonzero()[:, 0]
    i, j = i.index_select(0, heard), j.index_select(0, heard)
    middle = (aligned.keypoints0 + right).float() / 2
    way = middle.index_select(0, i) - middle.index_select(0, j)
    predicted = measured.index_select(0, j)
    predicted = predicted + ((slope.index_select(0, i) + slope.index_select(0, j)) / 2 * way).sum(1)
    miss = predicted - measured.index_select(0, i)
    length = torch.hypot(*way.unbind(1))
    likely = 1 / (1 + (miss / _PRIOR_MISS_PX).square()).square() / (1 + (length / _PRIOR_REACH_PX).square())
    uncertain = _DISTRUST * variance.index_select(0, j) + _PRIOR_PX**2 + (_PRIOR_SLOPE * length).square()
    weight = likely / uncertain
    total, pull = (torch.zeros_like(measured).index_add(0, i, values) for values in (weight, weight * miss))
    change = pull / (1 / (_DISTRUST * variance) + total)
    return torch.where(along != 0, along - change, along)


def mark_refined(before: Matches, after: Matches, origin: Tensor) -> Tensor:
    """(M,) int8 values of :class:`tensor_stereo.scores.Origin`, with those given matches marked that have moved.

    >>> points = torch.tensor([[3.0, 4.0]])
    >>> ptr, given = torch.tensor([0, 1]), torch.zeros(1, dtype=torch.int8)
    >>> mark_refined(Matches(points, points, ptr), Matches(points, points + 0.1, ptr), given)
    tensor([1], dtype=torch.int8)
    """
    has_moved = (after.keypoints1 != before.keypoints1).any(1)
    return torch.where(has_moved & (origin == int(Origin.GIVEN)), int(Origin.REFINED), origin).to(torch.int8)
