"""Dense disparity maps from kept matches: piecewise-linear over their Delaunay triangles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeGuard, overload

import numpy as np
import torch
from torch import Tensor

from tensor_stereo.batching import lengths_to_ptr, ptr_to_batch, select_matches, to_padded
from tensor_stereo.delaunay.triangles import delaunay_triangles
from tensor_stereo.duplicates import coincident_ids, keep_one_to_one
from tensor_stereo.ops.segments import pair_of, to_points
from tensor_stereo.types import Matches, check_vector

_TOLERANCE_PX = 1e-6  # a pixel that near to a triangle is taken as one of its own
_AT_ONCE = 2**20  # pixels x edges

Size = tuple[int, int]


class _Canvas(NamedTuple):
    """The pixels of all maps, row by row, one map after the other."""

    height: Tensor  # (B,) int64
    width: Tensor  # (B,)
    ptr: Tensor  # (B + 1,) offsets of the maps


class _Spans(NamedTuple):
    """Where triangles meet rows of pixels, S in all; (S,) each."""

    triangle: Tensor  # int64
    row: Tensor  # int64
    first: Tensor  # int64 pixel of the canvas
    length: Tensor  # int64 pixels
    column: Tensor  # int64 column of the first pixel
    x: tuple[Tensor, Tensor]  # px, both ends of the row's part in the triangle
    value: tuple[Tensor, Tensor]  # px, disparities at both ends


@overload
def interpolate_disparity(
    matches: Matches,
    size: Size,
    *,
    inlier: Tensor | None = None,
    score: Tensor | None = None,
    min_score: float = 0.5,
    max_step_px: float | None = None,
) -> Tensor: ...


@overload
def interpolate_disparity(
    matches: Matches,
    size: Sequence[Size],
    *,
    inlier: Tensor | None = None,
    score: Tensor | None = None,
    min_score: float = 0.5,
    max_step_px: float | None = None,
) -> list[Tensor]: ...


def interpolate_disparity(
    matches: Matches,
    size: Size | Sequence[Size],
    *,
    inlier: Tensor | None = None,
    score: Tensor | None = None,
    min_score: float = 0.5,
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
        min_score: smallest score of an anchor.
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
            a score or cost is NaN, a coordinate of view 0 is not 0 or 1e-60..1e60 in magnitude, or the disparity of an
            anchor is not finite.
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
    anchors = select_matches(matches, kept)
    device = matches.keypoints0.device
    height, width = torch.tensor(sizes, device=device).reshape(-1, 2).unbind(1)
    canvas = _Canvas(height, width, lengths_to_ptr(height * width))
    points = anchors.keypoints0.double()
    disparity = points[:, 0] - anchors.keypoints1[:, 0].double()
    found = delaunay_triangles(points.numpy(force=True), anchors.ptr.numpy(force=True))
    triangles, boundary = (torch.from_numpy(rows).to(device) for rows in found)
    batch = ptr_to_batch(anchors.ptr)
    max_step = torch.inf if max_step_px is None else max_step_px
    values, missing = _fill_triangles(points, disparity, triangles, batch, canvas, max_step)
    outside = missing.nonzero()[:, 0]
    values = values.index_put((outside,), _project(points, disparity, boundary, batch, canvas, outside, max_step))
    values = values.to(matches.keypoints0.dtype)
    if common:
        return values.reshape(-1, 1, *size)
    maps = torch.split(values, (canvas.height * canvas.width).tolist())
    return [part.reshape(1, *shape) for part, shape in zip(maps, sizes, strict=True)]


def _check_sizes(size: Size | Sequence[Size], num_pairs: int) -> tuple[bool, list[Size]]:
    """Whether one size was given for all, and the size of every map."""
    if _is_size(size):
        return True, [size] * num_pairs
    sizes: list[Size] = list(size) if isinstance(size, Sequence) else [size]  # type: ignore[arg-type]
    if not all(_is_size(shape) for shape in sizes):
        raise ValueError(f"size must be (H, W) in px, both at least 1, or a sequence of these, got {size!r}")
    if len(sizes) != num_pairs:
        raise ValueError(f"size must be one (H, W), or one per pair ({num_pairs}), got {len(sizes)}")
    return False, sizes


def _is_size(size: object) -> TypeGuard[Size]:
    return isinstance(size, Sequence) and len(size) == 2 and all(isinstance(side, int) and side > 0 for side in size)


def _find_anchors(matches: Matches, inlier: Tensor | None, score: Tensor | None, min_score: float) -> Tensor:
    """(M,) bool, one match per place in view 0 among those that are kept."""
    if inlier is not None and score is not None:
        raise ValueError("inlier and score exclude each other, got both")
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
        kept, priority = score >= min_score, -score
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


def _fill_triangles(
    points: Tensor, disparity: Tensor, triangles: Tensor, batch: Tensor, canvas: _Canvas, max_step: float
) -> tuple[Tensor, Tensor]:
    """(P,) disparities of the pixels in triangles, NaN elsewhere, and (P,) True there.

    A pixel on an edge, which several triangles claim, goes to the last of them. The value is interpolated along the two
    sides that meet the pixel's row and then between them, so that both triangles of a side agree on it.
    """
    spans = _find_spans(points, disparity, triangles, batch, canvas)
    num_pixels = int(canvas.ptr[-1])
    span, step = _ranges(spans.length)
    owner = torch.full((num_pixels,), -1, dtype=torch.int64, device=points.device)
    owner.scatter_reduce_(0, spans.first[span] + step, span, "amax")
    pixel = (owner >= 0).nonzero()[:, 0]
    span = owner[pixel]
    column = (pixel - spans.first[span] + spans.column[span]).to(points.dtype)
    (x0, x1), (value0, value1) = spans.x, spans.value
    width = x1 - x0
    wide = width > 0
    share = ((column - x0[span]) / torch.where(wide, width, 1)[span]).clamp(0, 1)
    share = torch.where(wide[span], share, 0)
    found = torch.lerp(value0[span], value1[span], share)
    torn = (_step(disparity[triangles]) > max_step)[spans.triangle[span]].nonzero()[:, 0]
    corners = triangles[spans.triangle[span[torn]]]  # (K, 3)
    where = torch.stack([column[torn], spans.row[span[torn]].to(points.dtype)], 1)
    nearest = (points.detach()[corners] - where[:, None]).square().sum(2).argmin(1, keepdim=True)
    found = found.index_put((torn,), disparity[corners.gather(1, nearest)[:, 0]])
    return points.new_full((num_pixels,), torch.nan).index_put((pixel,), found), owner < 0


def _find_spans(points: Tensor, disparity: Tensor, triangles: Tensor, batch: Tensor, canvas: _Canvas) -> _Spans:
    order = points.detach()[:, 1][triangles].argsort(dim=1, stable=True)
    triangles = triangles.gather(1, order)  # from the lowest y to the highest
    y = points.detach()[:, 1][triangles]
    pair = batch[triangles[:, 0]]
    first_row, num_rows = _cover(y[:, 0], y[:, 2], canvas.height[pair])
    triangle, step = _ranges(num_rows)
    row = first_row[triangle] + step
    low, middle, high = triangles[triangle].unbind(1)
    y_low, y_middle, y_high = y[triangle].unbind(1)
    is_lower = (y_low < y_middle) & ((row < y_middle) | (y_middle == y_high))
    sides = (low, high), (torch.where(is_lower, low, middle), torch.where(is_lower, middle, high))
    ends = []
    for start, end in sides:
        y_start, y_end = points[start, 1], points[end, 1]
        share = ((row - y_start) / (y_end - y_start)).clamp(0, 1)
        ends.append([torch.lerp(column[start], column[end], share) for column in (points[:, 0], disparity)])
    swapped = ends[0][0] > ends[1][0]
    x, value = (
        (torch.where(swapped, other, one), torch.where(swapped, one, other)) for one, other in zip(*ends, strict=True)
    )
    pair = pair[triangle]
    column, count = _cover(x[0].detach(), x[1].detach(), canvas.width[pair])
    return _Spans(triangle, row, canvas.ptr[pair] + row * canvas.width[pair] + column, count, column, x, value)


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


def _project(
    points: Tensor,
    disparity: Tensor,
    boundary: Tensor,
    batch: Tensor,
    canvas: _Canvas,
    pixel: Tensor,
    max_step: float,
) -> Tensor:
    """(n,) disparities at the points of the hulls next to the pixels, NaN where there is no hull."""
    pair = torch.searchsorted(canvas.ptr, pixel, right=True) - 1
    place = pixel - canvas.ptr[pair]
    x, y = ((values[:, None]).to(points.dtype) for values in (place % canvas.width[pair], place // canvas.width[pair]))
    owner = batch[boundary[:, 0]]
    ptr = lengths_to_ptr(torch.bincount(owner, minlength=len(canvas.ptr) - 1))
    edges, real = to_padded(boundary[owner.argsort(stable=True)], ptr)  # (B, K, 2), (B, K)
    if not edges.numel():
        return points.new_full((len(pixel),), torch.nan)
    start, way = _sides(points.detach(), edges)  # (B, K, 2)
    nearest = []
    for part in torch.split(torch.arange(len(pixel), device=pixel.device), _AT_ONCE // edges.shape[1] + 1):
        b, here = pair[part], (x[part], y[part])
        (x0, y0), (dx, dy) = start[b].unbind(2), way[b].unbind(2)  # (n, K)
        share = _share(*here, x0, y0, dx, dy)
        distance = (x0 + share * dx - here[0]).square_() + (y0 + share * dy - here[1]).square_()
        nearest.append(distance.where(real[b], torch.inf).argmin(1))
    chosen = edges[pair, torch.cat(nearest)][:, None]  # (n, 1, 2)
    start, way = _sides(points, chosen)
    share = _share(x, y, *start.unbind(2), *way.unbind(2))
    ends = disparity[chosen]  # (n, 1, 2)
    share = torch.where(_step(ends) > max_step, share.round(), share)
    values = torch.lerp(ends[..., 0], ends[..., 1], share)[:, 0]
    return torch.where(real.any(1)[pair], values, torch.nan)


def _sides(points: Tensor, edges: Tensor) -> tuple[Tensor, Tensor]:
    """Start of each edge (..., 2), and the way to its end, (..., 2) both."""
    start = points[edges[..., 0]]
    return start, points[edges[..., 1]] - start


def _share(x: Tensor, y: Tensor, x0: Tensor, y0: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
    """(n, K) in [0, 1], where on edges (n, K) the nearest points to the pixels (n, 1) are."""
    squared = dx * dx + dy * dy
    return (((x - x0) * dx + (y - y0) * dy) / torch.where(squared > 0, squared, 1)).clamp(0, 1)
