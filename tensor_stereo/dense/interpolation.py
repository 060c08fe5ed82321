"""Dense disparity maps from kept matches: piecewise-linear over their Delaunay triangles."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise
from numbers import Integral
from typing import NamedTuple, TypeGuard, overload

import numpy as np
import torch
from torch import Tensor

from tensor_stereo.batching import lengths_to_ptr, ptr_to_batch, select_matches
from tensor_stereo.delaunay.one_to_one import coincident_ids, keep_one_to_one
from tensor_stereo.delaunay.triangles import delaunay_triangles
from tensor_stereo.ops.segments import pair_of, to_points
from tensor_stereo.types import Matches, check_vector

_TOLERANCE_PX = 1e-6  # a pixel that near to a triangle is taken as one of its own
_AT_ONCE = 2**17  # pixels

Size = tuple[int, int]


class _Canvas(NamedTuple):
    """The rows of pixels of all maps, one map after the other, R in all."""

    maps: Tensor  # (B + 1,) offsets of the maps, in rows
    pair: Tensor  # (R,) int64
    y: Tensor  # (R,) int64 place within the map
    width: Tensor  # (R,) int64
    ptr: Tensor  # (R + 1,) offsets of the rows, in pixels


class _Surface(NamedTuple):
    """Triangles and hulls of the N anchors of all pairs, and what is asked of them time and again."""

    points: Tensor  # (N, 2) float64 px
    disparity: Tensor  # (N,) float64 px
    triangles: Tensor  # (T, 3)
    rising: Tensor  # (T, 3) the same corners, from the lowest y to the highest
    first: Tensor  # (T,) row of the canvas
    stop: Tensor  # (T,) the row after the last one
    torn: Tensor  # (T,) bool, whether the triangle is cut
    sides: Tensor  # (K, 2) of the hulls, counter-clockwise
    chains: Tensor  # (4 B + 1,) offsets of the parts of each hull that turn by 90 degrees at most
    torn_side: Tensor  # (K,) bool


class _Spans(NamedTuple):
    """Where triangles meet rows of pixels, S in all; (S,) each."""

    triangle: Tensor  # int64
    row: Tensor  # int64 row of the canvas
    column: Tensor  # int64 of the first pixel
    length: Tensor  # int64 pixels
    x: tuple[Tensor, Tensor]  # px, both ends of the row's part in the triangle
    value: tuple[Tensor, Tensor]  # px, disparities at both ends


@overload
def interpolate_disparity(
    matches: Matches,
    size: Size,
    *,
    inlier: Tensor | None = None,
    score: Tensor | None = None,
    min_score: float | None = None,
    max_step_px: float | None = None,
) -> Tensor: ...


@overload
def interpolate_disparity(
    matches: Matches,
    size: Sequence[Size],
    *,
    inlier: Tensor | None = None,
    score: Tensor | None = None,
    min_score: float | None = None,
    max_step_px: float | None = None,
) -> list[Tensor]: ...


def interpolate_disparity(
    matches: Matches,
    size: Size | Sequence[Size],
    *,
    inlier: Tensor | None = None,
    score: Tensor | None = None,
    min_score: float | None = None,
    max_step_px: float | None = None,
) -> Tensor | list[Tensor]:
    """Disparity of every pixel of view 0 from the matches that are kept, the anchors.

    Inside of the anchors' convex hull the map is linear on every triangle of their Delaunay triangulation in view 0,
    outside it has the value of the nearest point of the hull: it is continuous, passes through the anchors and never
    leaves their range. Collinear anchors have a line for a hull, a single one gives a constant map, none gives NaN.
    Where a co-circular polygon may be cut in several ways, the coordinates decide: the order of the matches changes
    nothing.

    Args:
        matches: B pairs; of anchors at one place in view 0 the one of the highest ``score``, else of the lowest
            ``cost``, else the first is taken.
        size: (H, W) of all maps, or a sequence of B sizes.
        inlier: (M,) bool, the anchors. None means all matches.
        score: (M,) in place of ``inlier``, higher is better; the anchors are the matches of at least ``min_score``. All
            anchors count alike.
        min_score: smallest score of an anchor; None means 0.5. Only with ``score``.
        max_step_px: triangles whose disparities differ by more are taken to bridge a depth edge: their pixels, and
            those outside of such sides of the hull, have the disparity of the nearest corner, and the map jumps in
            between. Fewer pixels are off by more than 2 px that way (4 px does best), but those are off by more. None:
            no triangle is cut.

    Returns:
        (B, 1, H, W) disparities in px, in the dtype of the keypoints and on their device; for a sequence of sizes a
        list of B tensors (1, H_b, W_b). Gradients flow to the disparities of the anchors and through the place of
        their keypoints in view 0; the choice of the triangles is constant. No gradient flows to the score.

    Raises:
        ValueError: if shapes or sizes are others, ``max_step_px`` is negative, both ``inlier`` and ``score`` are given,
            ``min_score`` is given without ``score``, a score, ``min_score`` or cost is NaN, a coordinate of view 0 is
            not 0 or 1e-60..1e60 in magnitude, or the disparity of an anchor is not finite.
        TypeError: if ``inlier`` is not bool or ``score`` is not floating point.

    Source: anchors of dense maps are what Bustos, Vargas & Trujillo (CIARP 2016) keep matches for.

    Example:
        >>> left = torch.tensor([[0.0, 0.0], [4.0, 0.0], [0.0, 2.0]])
        >>> matches = Matches(left, left - torch.tensor([[1.0, 0.0], [3.0, 0.0], [1.0, 0.0]]), torch.tensor([0, 3]))
        >>> interpolate_disparity(matches, (3, 5))[0, 0]
        tensor([[1.0000, 1.5000, 2.0000, 2.5000, 3.0000],
                [1.0000, 1.5000, 2.0000, 2.4000, 2.8000],
                [1.0000, 1.4000, 1.8000, 2.2000, 2.6000]])
    """
    if max_step_px is not None and not max_step_px >= 0:
        raise ValueError(f"max_step_px must be at least 0 px, got {max_step_px}")
    kept = _find_anchors(matches, inlier, score, min_score)
    common, sizes = _check_sizes(size, matches.num_pairs)
    canvas = _lay_out(sizes, matches.keypoints0.device)
    surface = _triangulate(select_matches(matches, kept), canvas, torch.inf if max_step_px is None else max_step_px)
    # Some rows at a time: what is needed beside the values, and for gradients, does not grow with the maps.
    num_rows = torch.unique_consecutive(canvas.ptr[:-1] // _AT_ONCE, return_counts=True)[1].tolist()
    pieces = (_fill_rows(surface, canvas, *rows) for rows in pairwise(accumulate(num_rows, initial=0)))
    dtype = matches.keypoints0.dtype
    values = torch.cat([surface.disparity[:0].to(dtype), *(piece.to(dtype) for piece in pieces)])
    if common:
        return values.reshape(len(sizes), 1, *common)
    maps = torch.split(values, [height * width for height, width in sizes])
    return [part.reshape(1, *shape) for part, shape in zip(maps, sizes, strict=True)]


def _check_sizes(size: Size | Sequence[Size], num_pairs: int) -> tuple[Size | None, list[Size]]:
    """The one size that was given for all, if so, and the size of every map."""
    common = (int(size[0]), int(size[1])) if _is_size(size) else None
    given: Sequence[object] = [size] * num_pairs if common else size if isinstance(size, Sequence) else [size]
    sizes = [(int(height), int(width)) for height, width in filter(_is_size, given)]
    if len(sizes) != len(given):
        raise ValueError(f"size must be (H, W) in px, both at least 1, or a sequence of these, got {size!r}")
    if len(sizes) != num_pairs:
        raise ValueError(f"size must be one (H, W), or one per pair ({num_pairs}), got {len(sizes)}")
    return common, sizes


def _is_size(size: object) -> TypeGuard[Size]:
    return isinstance(size, Sequence) and len(size) == 2 and all(_is_length(side) for side in size)


def _is_length(side: object) -> bool:
    return not isinstance(side, bool) and isinstance(side, Integral) and int(side) > 0


def _find_anchors(matches: Matches, inlier: Tensor | None, score: Tensor | None, min_score: float | None) -> Tensor:
    """(M,) bool, one match per place in view 0 among those that are kept."""
    if inlier is not None and score is not None:
        raise ValueError("inlier and score exclude each other, got both")
    if min_score is not None and (score is None or min_score != min_score):
        raise ValueError(f"min_score must be a number, and given only with score, got {min_score}")
    kept = torch.ones_like(matches.keypoints0[:, 0], dtype=torch.bool)
    priority = matches.cost
    if inlier is not None:
        check_vector("inlier", inlier, matches.num_matches)
        if inlier.dtype != torch.bool:
            raise TypeError(f"inlier must be bool, got {inlier.dtype}")
        kept = inlier
    if score is not None:
        check_vector("score", score, matches.num_matches)
        if not score.is_floating_point():
            raise TypeError(f"score must be floating point, got {score.dtype}")
        kept, priority = score >= (0.5 if min_score is None else min_score), -score
    order = None if priority is None else priority.detach().double().cpu().numpy()
    if order is not None and (nan := np.isnan(order)).any():
        raise ValueError(f"{'cost' if score is None else 'score'} must not be NaN, got NaN in row {nan.argmax()}")
    points = to_points("keypoints0", matches.keypoints0, matches.ptr)
    rows = np.flatnonzero(kept.cpu().numpy())
    unknown = rows[~np.isfinite(matches.disparity.numpy(force=True)[rows])]
    if len(unknown):
        raise ValueError(f"keypoints1 must be finite where matches are kept, got no disparity in row {unknown[0]}")
    ids = coincident_ids(points[rows], pair_of(matches.ptr)[rows])
    first = np.zeros(matches.num_matches, dtype=bool)
    first[rows] = keep_one_to_one(ids, ids, None if order is None else order[rows])
    return torch.from_numpy(first).to(kept.device)


def _lay_out(sizes: list[Size], device: torch.device) -> _Canvas:
    height, width = torch.tensor(sizes, dtype=torch.int64, device=device).reshape(-1, 2).unbind(1)
    pair, y = _ranges(height)
    return _Canvas(lengths_to_ptr(height), pair, y, width[pair], lengths_to_ptr(width[pair]))


def _triangulate(anchors: Matches, canvas: _Canvas, max_step: float) -> _Surface:
    points = anchors.keypoints0.double()
    disparity = points[:, 0] - anchors.keypoints1[:, 0].double()
    found = delaunay_triangles(points.numpy(force=True), anchors.ptr.numpy(force=True))
    triangles, sides = (torch.from_numpy(rows).to(points.device) for rows in found)
    batch = ptr_to_batch(anchors.ptr)
    pair = batch[triangles[:, 0]]
    y = points.detach()[:, 1]
    rising = triangles.gather(1, y[triangles].argsort(dim=1, stable=True))
    first, num_rows = _cover(y[rising[:, 0]], y[rising[:, 2]], canvas.maps.diff()[pair])
    first = first + canvas.maps[pair]
    sides, chains = _to_chains(points.detach(), sides, batch, anchors.num_pairs)
    torn, torn_side = (_step(disparity[corners]) > max_step for corners in (triangles, sides))
    return _Surface(points, disparity, triangles, rising, first, first + num_rows, torn, sides, chains, torn_side)


def _to_chains(points: Tensor, sides: Tensor, batch: Tensor, num_pairs: int) -> tuple[Tensor, Tensor]:
    """Sides (K, 2) in four chains per hull, each of one quadrant of directions, and the offsets of the chains.

    Collinear anchors have one chain, their path.
    """
    dx, dy = (points[sides[:, 1]] - points[sides[:, 0]]).unbind(1)
    forward = (dx > 0) | ((dx == 0) & (dy > 0))
    chain = 4 * batch[sides[:, 0]] + 2 * forward.long() + (dy > 0).long()
    place = torch.arange(len(sides), device=sides.device)  # the sides come in lexicographic order of their starts
    order = (2 * len(sides) * chain + torch.where(forward, place, -place)).argsort()
    return sides[order], lengths_to_ptr(torch.bincount(chain, minlength=4 * num_pairs))


def _fill_rows(surface: _Surface, canvas: _Canvas, start: int, stop: int) -> Tensor:
    """(P,) float64 disparities of the pixels in the rows ``start:stop`` of the canvas, NaN where a pair has no anchor.

    A pixel on an edge, which several triangles claim, goes to the last of them. The value is interpolated along the two
    sides that meet the pixel's row and then between them, so that both triangles of a side agree on it.
    """
    spans = _find_spans(surface, canvas, start, stop)
    offset = canvas.ptr[start]
    span, step = _ranges(spans.length)
    owner = torch.full((int(canvas.ptr[stop] - offset),), -1, dtype=torch.int64, device=offset.device)
    owner.scatter_reduce_(0, (canvas.ptr[spans.row] - offset + spans.column)[span] + step, span, "amax")
    values = surface.points.new_full(owner.shape, torch.nan)

    inside = (owner >= 0).nonzero()[:, 0]
    span = owner[inside]
    row, triangle = spans.row[span], spans.triangle[span]
    x = (inside + offset - canvas.ptr[row]).to(values.dtype)
    (x0, x1), (value0, value1) = spans.x, spans.value
    width = torch.where(x1 > x0, x1 - x0, 1)  # a corner has none, and one value
    share = ((x - x0[span]) / width[span]).clamp(0, 1)
    found = torch.lerp(value0[span], value1[span], share)
    torn = surface.torn[triangle].nonzero()[:, 0]
    corners = surface.triangles[triangle[torn]]  # (K, 3)
    where = torch.stack([x[torn], canvas.y[row[torn]].to(x.dtype)], 1)
    nearest = (surface.points.detach()[corners] - where[:, None]).square().sum(2).argmin(1, keepdim=True)
    found = found.index_put((torn,), surface.disparity[corners.gather(1, nearest)[:, 0]])
    values = values.index_put((inside,), found)

    outside = (owner < 0).nonzero()[:, 0]
    row = torch.searchsorted(canvas.ptr, outside + offset, right=True) - 1
    pair = canvas.pair[row]
    has_hull = surface.chains[4 * pair] < surface.chains[4 * pair + 4]
    outside, row, pair = outside[has_hull], row[has_hull], pair[has_hull]
    x, y = (place.to(values.dtype) for place in (outside + offset - canvas.ptr[row], canvas.y[row]))
    return values.index_put((outside,), _project(surface, x, y, pair))


def _find_spans(surface: _Surface, canvas: _Canvas, start: int, stop: int) -> _Spans:
    points = surface.points
    first = surface.first.clamp(min=start)
    triangle, step = _ranges((surface.stop.clamp(max=stop) - first).clamp(min=0))
    row = first[triangle] + step
    low, middle, high = surface.rising[triangle].unbind(1)
    y = canvas.y[row]
    y_low, y_middle, y_high = points.detach()[:, 1][surface.rising[triangle]].unbind(1)
    is_lower = (y_low < y_middle) & ((y < y_middle) | (y_middle == y_high))
    ends = []
    for begin, end in ((low, high), (torch.where(is_lower, low, middle), torch.where(is_lower, middle, high))):
        y_begin, y_end = points[begin, 1], points[end, 1]
        share = ((y - y_begin) / (y_end - y_begin)).clamp(0, 1)
        ends.append(
            [torch.lerp(quantity[begin], quantity[end], share) for quantity in (points[:, 0], surface.disparity)]
        )
    swapped = ends[0][0] > ends[1][0]
    x, value = (
        (torch.where(swapped, other, one), torch.where(swapped, one, other)) for one, other in zip(*ends, strict=True)
    )
    column, length = _cover(x[0].detach(), x[1].detach(), canvas.width[row])
    return _Spans(triangle, row, column, length, x, value)


def _step(disparity: Tensor) -> Tensor:
    """(...) largest difference within (..., K) disparities."""
    return disparity.detach().amax(-1) - disparity.detach().amin(-1)


def _cover(low: Tensor, high: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """First integer, and their number, within ``low..high`` and ``0..size - 1``."""
    first = (low - _TOLERANCE_PX).ceil().clamp(min=0).minimum(size).long()
    last = (high + _TOLERANCE_PX).floor().clamp(min=-1).minimum(size - 1).long()
    return first, (last - first + 1).clamp(min=0)


def _ranges(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Owner and place 0, 1, ... of every element of consecutive runs."""
    ptr = lengths_to_ptr(counts)
    owner = ptr_to_batch(ptr)
    return owner, torch.arange(len(owner), device=counts.device) - ptr[owner]


def _project(surface: _Surface, x: Tensor, y: Tensor, pair: Tensor) -> Tensor:
    """(n,) disparities at the points of the hulls next to pixels outside of them."""
    ends = surface.points[surface.sides].flatten(1)  # (K, 4)
    side = _next_side(ends.detach(), surface.chains, x, y, pair)
    share = _foot(x, y, ends.index_select(0, side))[0]
    share = torch.where(surface.torn_side[side], share.round(), share)
    start, end = surface.disparity[surface.sides[side]].unbind(1)
    return torch.lerp(start, end, share)


def _next_side(ends: Tensor, chains: Tensor, x: Tensor, y: Tensor, pair: Tensor) -> Tensor:
    """(n,) int64 side of the pair's hull that is nearest to each pixel outside of it.

    A chain turns by 90 degrees at most: a pixel is past the end of every side before the nearest one and of none from
    there on, so bisection finds that one. Which chain has it shows when each has named its candidate.
    """
    last = chains[4 * pair + 4] - 1
    best = chains[4 * pair]
    best_x, best_y = _foot(x, y, ends.index_select(0, best))[1:]
    for quadrant, longest in enumerate(chains.diff().reshape(-1, 4).amax(0).tolist()):
        side, stop = chains[4 * pair + quadrant], chains[4 * pair + quadrant + 1]
        for step in (2**k for k in reversed(range(longest.bit_length()))):
            x0, y0, x1, y1 = ends.index_select(0, (side + (step - 1)).minimum(last)).unbind(1)
            is_past = (x - x1) * (x1 - x0) + (y - y1) * (y1 - y0) >= 0
            side = side + step * (is_past & (side + step < stop))
        side = side.minimum(last)  # an empty chain at the end has none of its own
        foot_x, foot_y = _foot(x, y, ends.index_select(0, side))[1:]
        # |p - best|^2 - |p - foot|^2 in a form that tells feet apart which all but coincide
        gain = (foot_x - best_x) * (2 * x - foot_x - best_x) + (foot_y - best_y) * (2 * y - foot_y - best_y)
        is_nearer = gain > 0
        best = torch.where(is_nearer, side, best)
        best_x, best_y = torch.where(is_nearer, foot_x, best_x), torch.where(is_nearer, foot_y, best_y)
    return best


def _foot(x: Tensor, y: Tensor, ends: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Share in 0..1 at which the segments (n, 4) have their points nearest to the pixels, and these; (n,) each."""
    x0, y0, x1, y1 = ends.unbind(1)
    dx, dy = x1 - x0, y1 - y0
    squared = dx * dx + dy * dy
    share = (((x - x0) * dx + (y - y0) * dy) / torch.where(squared > 0, squared, 1)).clamp(0, 1)
    return share, x0 + share * dx, y0 + share * dy
