"""Refine: kept matches move to where the windows of both views fit best, to a fraction of a pixel.

Windows lie half-way along the slope of the surface in either view. Gauss-Newton steps along the epipolar line minimise
the zero-mean sum of squared differences, over pixels near the centre and like it. Believed neighbours then say how far
the minimum is to be trusted (maximum a posteriori, their planes being the prior).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.features import list_images
from tensor_stereo.graphs import MatchGraphs, build_match_graphs, check_match_graphs
from tensor_stereo.ops.samplers import Sampler
from tensor_stereo.ops.windows import NOISE_VARIANCE, RADIUS_PX, TIGHT, window_kernels
from tensor_stereo.scores.alignment.form import Alignment, align_matches, epipolar_frames, map_points, no_alignment
from tensor_stereo.scores.repair import Origin
from tensor_stereo.scores.samplers import Place, blur, find_places, look_at_pairs
from tensor_stereo.scores.slopes import estimate_slopes
from tensor_stereo.types import Matches, check_mask, check_vector

_BLUR = 1.4  # as in so many times fewer pixels; interpolation then smooths all places alike, which locks no pixel
_STEPS = 4
_STEP_PX = 0.5  # the longest
_APART_PX = 0.25  # of the samples that give the slope of the grey levels
_DAMPING = 1.0  # grey levels squared per px squared; flat windows stay
_NUM_PIXELS = 40.0  # that tell independently, of a window
_DISTRUST = 16.0  # times the variance that noise alone would give a minimum
_PRIOR_PX, _PRIOR_SLOPE, _PRIOR_REACH_PX, _PRIOR_MISS_PX = 0.1, 0.01, 25.0, 0.5
_ROWS_AT_ONCE = 512


def refine_matches(
    matches: Matches,
    images0: Tensor | Sequence[Tensor],
    images1: Tensor | Sequence[Tensor],
    kept: Tensor,
    alignment: Alignment | None = None,
    graphs: MatchGraphs | None = None,
    *,
    max_shift_px: float = 1.0,
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
        along, across = _find_shifts(views, matches, graphs, kept, alignment, max_shift_px)
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
) -> tuple[Tensor, Tensor]:
    """(M,) px of view 0 along and across the lines, 0 where a match stays."""
    aligned = align_matches(matches, alignment)
    places = find_places(matches, aligned, estimate_slopes(aligned, graphs), alignment)
    found = [torch.zeros(matches.num_matches, device=matches.ptr.device) for _ in range(3)]
    offsets = matches.ptr.tolist()
    with torch.autocast(matches.keypoints0.device.type, enabled=False):
        for b, (sharp, own) in enumerate(look_at_pairs(views, matches, places, alignment)):
            samplers = [sampler._replace(image=blur(sampler.image, _BLUR)) for sampler in sharp]
            for rows in kept[offsets[b] : offsets[b + 1]].nonzero()[:, 0].split(_ROWS_AT_ONCE):  # type: ignore[no-untyped-call]
                looks = [sampler.select(rows) for sampler in samplers]
                for whole, part in zip(found, _minimise(looks, own.select(rows), max_shift_px), strict=True):
                    whole[offsets[b] + rows] = part
    along, across, variance = found
    along = _trust_neighbors(aligned, graphs, kept, along, variance)
    limit = (max_shift_px**2 - across.square()).clamp(min=0).sqrt()
    return along.clamp(-limit, limit).double(), across.double()


def _minimise(looks: Sequence[Sampler], places: Place, max_shift_px: float) -> tuple[Tensor, Tensor, Tensor]:
    """(m,) shifts along and across the line, and the variance of the first."""
    half = places.slope / 2
    windows = looks[0].slanted(places.left, RADIUS_PX, half)
    kernel = window_kernels(windows)[..., TIGHT].reshape_as(windows)

    def differ(along: Tensor, across: Tensor) -> Tensor:
        other = looks[1].slanted(looks[1].place(places.right, along, across), RADIUS_PX, -half)
        return _centered(windows - other, kernel)

    def cost(along: Tensor, across: Tensor) -> Tensor:
        return (kernel * differ(along, across).square()).sum((1, 2))

    still = torch.zeros_like(places.across)
    across = torch.where(places.off_line.abs() <= max_shift_px, -places.off_line, 0)
    limit = (max_shift_px**2 - across.square()).clamp(min=0).sqrt()
    along, bend = still, still
    for _ in range(_STEPS):
        ahead, back = (differ(along + step, across) for step in (_APART_PX, -_APART_PX))
        slope = (back - ahead) / (2 * _APART_PX)
        bend = (kernel * slope.square()).sum((1, 2))
        step = (kernel * slope * differ(along, across)).sum((1, 2)) / (bend + _DAMPING)
        along = (along + step.clamp(-_STEP_PX, _STEP_PX)).clamp(-limit, limit)
    before, after = cost(still, still), cost(along, across)
    better = after <= before
    variance = (after + NOISE_VARIANCE) / (bend + 1e-3) / _NUM_PIXELS
    return torch.where(better, along, 0), torch.where(better, across, 0), variance


def _centered(windows: Tensor, kernel: Tensor) -> Tensor:
    return windows - (kernel * windows).sum((1, 2), keepdim=True)


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
