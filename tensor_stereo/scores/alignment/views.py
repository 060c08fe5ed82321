"""Any two views: the map of their most common surface, and the epipolar lines that all else follows.

Links of the Delaunay graphs name a rotation and a scale, since the graphs do not change under both: of all links, those
between right matches agree on them, even if most matches are wrong. Under that similarity right matches move as their
neighbours do, and these name an affine map, then epipolar lines, then a homography.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from tensor_stereo import ops
from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.configs import Backend
from tensor_stereo.graphs import MatchGraphs
from tensor_stereo.scores.alignment.form import LEAST_AGREEING, LEAST_VOTES, Alignment, map_points, no_alignment
from tensor_stereo.scores.alignment.pair_sums import PairSums, say, select_rows
from tensor_stereo.types import Matches

_NUM_SCALES, _NUM_ANGLES = 16, 36  # bins of the scale, from a quarter to four, and of the rotation
_MAX_LOG = math.log(4.0)
_WIDTHS = ((0.3, 0.35), (0.2, 0.25))  # of log scale and angle around the fullest bins, round by round
_ROUNDS = (  # how far neighbours that agree may differ, px and px per px; scales of the fit of the affine map, px
    (2.0, 0.35, (64.0, 32.0, 16.0, 8.0)),
    (2.0, 0.25, (16.0, 8.0, 4.0)),
    (1.5, 0.2, (8.0, 4.0, 4.0)),
)
_LAST_PX, _LAST_SPREAD = 1.5, 0.2  # how far those may differ that the lines and the homography are fitted to
_MAP_SCALES_PX = (8.0, 4.0, 4.0, 4.0)  # of the homography
_LINE_SCALES_PX = (8.0, 4.0, 2.0, 1.0, 0.7)  # of affine epipolar lines, from which start
_FREE_SCALES_PX = (2.0, 1.0, 0.7, 0.7)  # lines that may meet in a point
_LINEAR_PRIOR, _PERSPECTIVE_PRIOR = 0.5, 0.15  # standard deviations, where the points are normalized
_AFFINE, _FREE = 1e6, 30.0  # observations that say that lines are parallel
_LEAST_LINES = 20  # matches that lines need
_FIT_PX, _FIT_MAP_PX = 1.5, 8.0  # most of the matches that agree must lie that near to their lines, or to the map


class Normalized(NamedTuple):
    """Points of view 0 and of view 1 taken there, from the middle of each pair and over their size."""

    left: Tensor  # (K, 2)
    right: Tensor  # (K, 2)
    size: Tensor  # (B,) px
    to_normal: Tensor  # (B, 3, 3) from px
    from_normal: Tensor  # (B, 3, 3)
    pairs: PairSums


@torch.no_grad()
def fit_views(matches: Matches, graphs: MatchGraphs, backend: Backend = "auto") -> tuple[Alignment, Tensor]:
    """Fit map and epipolar lines of every pair to the matches that agree with their neighbours.

    Scales from a quarter to four are found, and any rotation; a view in a mirror is not.

    Args:
        matches: B pairs of any two views, coordinates in px.
        graphs: The graphs of the same matches.
        backend: As in :func:`tensor_stereo.classify_matches`.

    Returns:
        The alignment of every pair, none of them rectified; and (M,) bool, the matches that agree with their neighbours
        under it. A pair does not depend on the others. No gradient.

    >>> from tensor_stereo.graphs import build_match_graphs
    >>> left = torch.rand(200, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 400
    >>> half_turn = -left + torch.tensor([500.0, 300.0])
    >>> half_turn[:100] = half_turn[:100].flip(0)
    >>> matches = Matches(left, half_turn, torch.tensor([0, 200]))
    >>> fit_views(matches, build_match_graphs(matches))[0].to_view0[0].round(decimals=2).abs()
    tensor([[  1.,   0., 500.],
            [  0.,   1., 300.],
            [  0.,   0.,   1.]], dtype=torch.float64)
    """
    left, right = matches.keypoints0.double(), matches.keypoints1.double()
    batch = ptr_to_batch(matches.ptr)
    affine = find_similarity(matches, graphs)
    for k, (near_px, spread, scales_px) in enumerate(_ROUNDS):
        agreeing = _agree(matches, map_points(affine, right, batch), graphs, near_px, spread, backend)
        rows, pairs = select_rows(matches, agreeing)
        partners = map_points(affine, right.index_select(0, rows), pairs.batch)
        if k == 0:
            affine = _shift(_median(left.index_select(0, rows) - partners, pairs)) @ affine
            partners = map_points(affine, right.index_select(0, rows), pairs.batch)
        points = normalize(left.index_select(0, rows), partners, pairs)
        affine = fit_affine(points, scales_px) @ affine
    agreeing = _agree(matches, map_points(affine, right, batch), graphs, _LAST_PX, _LAST_SPREAD, backend)
    rows, pairs = select_rows(matches, agreeing)
    points = normalize(left.index_select(0, rows), map_points(affine, right.index_select(0, rows), pairs.batch), pairs)
    lines, off_px = fit_lines(points)
    homography, miss_px = fit_homography(points, _MAP_SCALES_PX)
    # the lines hold in the frame of the affine map, and are wanted in that of the homography
    lines = torch.linalg.inv_ex(homography)[0].transpose(1, 2) @ lines
    count = pairs.sum(torch.ones_like(off_px))
    near_lines, near_map = (
        2 * pairs.sum((distance <= limit).double()) >= count
        for distance, limit in ((off_px, _FIT_PX), (miss_px, _FIT_MAP_PX))
    )
    has_lines = near_lines & (count >= _LEAST_LINES)
    fitted = (count >= LEAST_AGREEING) & (has_lines | near_map)
    none = no_alignment(matches.num_pairs, left, rectified=False)
    found = none._replace(
        to_view0=torch.where(fitted[:, None, None], homography @ affine, none.to_view0),
        lines=torch.where((fitted & has_lines)[:, None, None], lines, 0),
        fitted=fitted,
        num_agreeing=count.long(),
    )
    return found, agreeing


def find_similarity(matches: Matches, graphs: MatchGraphs) -> Tensor:
    """(B, 3, 3) the rotation and scale from view 1 to view 0 that most links of either view share.

    >>> from tensor_stereo.graphs import build_match_graphs
    >>> left = torch.rand(100, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 400
    >>> matches = Matches(left, left.flip(1) * torch.tensor([-2.0, 2.0]), torch.tensor([0, 100]))  # a quarter turn
    >>> find_similarity(matches, build_match_graphs(matches))[0, 0].round(decimals=2).abs()
    tensor([0.0000, 0.5000, 0.0000], dtype=torch.float64)
    """
    ends = []
    for graph in (graphs.adjacency0, graphs.adjacency1):
        row, col = graph.row_indices, graph.col_indices
        once = (row < col).nonzero()[:, 0]
        ends.append((row.index_select(0, once), col.index_select(0, once)))
    i, j = (torch.cat(part) for part in zip(*ends, strict=True))
    batch = ptr_to_batch(matches.ptr).index_select(0, i)
    (px, py), (qx, qy) = (
        (view.index_select(0, j) - view.index_select(0, i)).double().unbind(1)
        for view in (matches.keypoints0, matches.keypoints1)
    )
    # the complex number q / p, which is 1 over the scale of view 0 times the turn from it
    log_scale = (torch.log(qx * qx + qy * qy + 1e-12) - torch.log(px * px + py * py + 1e-12)) / 2
    angle = torch.atan2(qy * px - qx * py, qx * px + qy * py)
    usable = (log_scale.abs() < _MAX_LOG).double()
    num_pairs = matches.num_pairs
    scale_bin = ((log_scale / _MAX_LOG + 1) * (_NUM_SCALES / 2)).floor().clamp(0, _NUM_SCALES - 1).long()
    angle_bin = ((angle / math.pi + 1) * (_NUM_ANGLES / 2)).floor().clamp(0, _NUM_ANGLES - 1).long()
    place = (batch * _NUM_SCALES + scale_bin) * _NUM_ANGLES + angle_bin
    counts = usable.new_zeros(num_pairs * _NUM_SCALES * _NUM_ANGLES).index_add(0, place, usable)
    counts = counts.reshape(num_pairs, _NUM_SCALES, _NUM_ANGLES)
    counts = counts + counts.roll(1, 2) + counts.roll(-1, 2)  # angles go around
    counts = functional.pad(counts, (0, 0, 1, 1))
    best = (counts[:, :-2] + counts[:, 1:-1] + counts[:, 2:]).flatten(1).argmax(1)
    mean_log = (torch.div(best, _NUM_ANGLES, rounding_mode="floor") + 0.5) * (2 * _MAX_LOG / _NUM_SCALES) - _MAX_LOG
    mean_angle = (best % _NUM_ANGLES + 0.5) * (2 * math.pi / _NUM_ANGLES) - math.pi
    for width_log, width_angle in _WIDTHS:
        off_log = log_scale - mean_log.index_select(0, batch)
        off_angle = torch.remainder(angle - mean_angle.index_select(0, batch) + math.pi, 2 * math.pi) - math.pi
        weight = usable * say(((off_log / width_log).square() + (off_angle / width_angle).square()).sqrt())
        total, log_part, angle_part = (
            usable.new_zeros(num_pairs).index_add(0, batch, values)
            for values in (weight, weight * off_log, weight * off_angle)
        )
        mean_log = mean_log + log_part / total.clamp(min=1e-9)
        mean_angle = mean_angle + angle_part / total.clamp(min=1e-9)
    c, s = torch.exp(-mean_log) * mean_angle.cos(), torch.exp(-mean_log) * mean_angle.sin()
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    return torch.stack([c, s, zero, -s, c, zero, zero, zero, one], 1).reshape(-1, 3, 3)


def normalize(left: Tensor, right: Tensor, pairs: PairSums) -> Normalized:
    """Points from the middle and over the size of those of view 0, by pairs.

    >>> points = torch.tensor([[0.0, 0.0], [4.0, 0.0]], dtype=torch.float64)
    >>> normalize(points, points, PairSums(torch.tensor([0, 0]), torch.tensor([0, 2]))).left
    tensor([[-1.,  0.],
            [ 1.,  0.]], dtype=torch.float64)
    """
    count = pairs.sum(left.new_ones(len(left))).clamp(min=1)
    middle = pairs.sum(left) / count[:, None]
    left, right = left - pairs.spread(middle), right - pairs.spread(middle)
    size = (pairs.sum(left.square().sum(1)) / count).sqrt().clamp(min=1e-3)
    one, zero = torch.ones_like(size), torch.zeros_like(size)
    x, y = middle.unbind(1)
    to_normal = torch.stack([1 / size, zero, -x / size, zero, 1 / size, -y / size, zero, zero, one], 1)
    from_normal = torch.stack([size, zero, x, zero, size, y, zero, zero, one], 1)
    left, right = (points / pairs.spread(size)[:, None] for points in (left, right))
    return Normalized(left, right, size, to_normal.reshape(-1, 3, 3), from_normal.reshape(-1, 3, 3), pairs)


def fit_affine(points: Normalized, scales_px: tuple[float, ...]) -> Tensor:
    """(B, 3, 3) affine maps from view 1 to view 0 in px, by least squares, reweighted with the scales."""
    (x, y), (u, v), pairs = points.right.unbind(1), points.left.unbind(1), points.pairs
    basis = (x, y, torch.ones_like(x))
    targets = (u - x, v - y)
    weight = torch.ones_like(x)
    fit = x.new_zeros(len(points.size), 3, 2)
    for k, scale_px in enumerate(scales_px):
        if k:
            miss = [t - sum(pairs.spread(fit[:, m, n]) * b for m, b in enumerate(basis)) for n, t in enumerate(targets)]
            weight = say((miss[0].square() + miss[1].square()).sqrt() * pairs.spread(points.size) / scale_px)
        ridge = (scale_px / points.size / _LINEAR_PRIOR).square()
        normal = _gram(weight, basis, pairs)
        normal = normal + torch.diag_embed(torch.stack([ridge, ridge, torch.full_like(ridge, 1e-9)], 1))
        fit = torch.linalg.solve(normal, _products([weight * b for b in basis], targets, pairs))
    affine = torch.eye(3, dtype=fit.dtype, device=fit.device).expand(len(fit), 3, 3).clone()
    affine[:, :2] += fit.transpose(1, 2)
    return points.from_normal @ affine @ points.to_normal


def fit_homography(points: Normalized, scales_px: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """(B, 3, 3) homographies from view 1 to view 0 in px, as :func:`fit_affine`, and the (K,) misses in px."""
    (x, y), (u, v), pairs = points.right.unbind(1), points.left.unbind(1), points.pairs
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    found = torch.eye(3, dtype=x.dtype, device=x.device).expand(len(points.size), 3, 3)
    miss_px = zero
    for scale_px in scales_px:
        g, h = (pairs.spread(found[:, 2, k]) for k in (0, 1))
        depth = (1 + g * x + h * y).clamp(min=0.2)
        weight = say(_miss_px(found, points) / scale_px)
        equations = (
            (x, y, one, zero, zero, zero, -u * x, -u * y),
            (zero, zero, zero, x, y, one, -v * x, -v * y),
        )
        normal, target = x.new_zeros(len(found), 8, 8), x.new_zeros(len(found), 8, 1)
        for columns, t in zip(equations, (u - x, v - y), strict=True):
            scaled = [c / depth for c in columns]
            weighted = [weight * c for c in scaled]
            normal = normal + _gram(weight, scaled, pairs)
            target = target + _products(weighted, (t / depth,), pairs)
        prior = x.new_tensor([_LINEAR_PRIOR, _LINEAR_PRIOR, 1e3] * 2 + [_PERSPECTIVE_PRIOR] * 2)
        noise = (scale_px / points.size).square()[:, None]
        fit = torch.linalg.solve(normal + torch.diag_embed(noise / prior.square()), target)[..., 0]
        fit = functional.pad(fit, (0, 1)) + x.new_tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 1])
        found = fit.reshape(-1, 3, 3)
        miss_px = _miss_px(found, points)
    return points.from_normal @ found @ points.to_normal, miss_px


def fit_lines(points: Normalized) -> tuple[Tensor, Tensor]:
    """(B, 3, 3) fundamental matrices F of px, ``right' F left = 0``, and (K,) distances in px from their lines.

    Epipolar lines are parallel at first (Shapiro, Zisserman & Brady, IJCV 16, 1995), and may meet then, as far as
    matches say so against a prior. The distance is Sampson's, the fit least squares, reweighted with the scales.
    """
    pairs = points.pairs
    left, right = (functional.pad(view, (0, 1), value=1.0).unbind(1) for view in (points.left, points.right))
    products = [r * p for r in right for p in left]
    squares = torch.stack([products[k] * products[m] for k in range(9) for m in range(k, 9)], 1)
    parallel = products[0].new_tensor([1.0, 1, 0, 1, 1, 0, 0, 0, 0])  # what is zero of them
    weight = torch.full_like(products[0], 0.5)
    lines, off_px = weight.new_zeros(len(points.size), 9), weight
    rounds = [(scale, _AFFINE) for scale in _LINE_SCALES_PX] + [(scale, _FREE) for scale in _FREE_SCALES_PX]
    for scale_px, prior in rounds:
        ridge = prior * (scale_px / points.size).square()[:, None] * parallel
        moments = _symmetric(pairs.sum(weight[:, None] * squares), 9) + torch.diag_embed(ridge)
        lines = _least_eigenvector(moments)
        f = [pairs.spread(lines[:, k]) for k in range(9)]
        ahead = [f[k] * left[0] + f[k + 1] * left[1] + f[k + 2] * left[2] for k in (0, 3, 6)]
        back = [f[k] * right[0] + f[k + 3] * right[1] + f[k + 6] * right[2] for k in (0, 1)]
        gradient = (ahead[0].square() + ahead[1].square() + back[0].square() + back[1].square()).clamp(min=1e-12)
        residual = right[0] * ahead[0] + right[1] * ahead[1] + right[2] * ahead[2]
        off_px = residual.abs() / gradient.sqrt() * pairs.spread(points.size)
        weight = say(off_px / scale_px) / gradient
    fundamental = points.to_normal.transpose(1, 2) @ lines.reshape(-1, 3, 3) @ points.to_normal
    return fundamental, off_px


def _least_eigenvector(moments: Tensor) -> Tensor:
    """(B, 9) that of the least eigenvalue of positive semidefinite matrices (B, 9, 9)."""
    # The last bits depend on where a matrix lies in memory: of 16 x 16 numbers, all lie alike.
    trace = moments.diagonal(dim1=1, dim2=2).sum(1)
    beyond = functional.pad(moments.new_zeros(9), (0, 7), value=1.0) * (1 + 2 * trace[:, None])
    whole = functional.pad(moments, (0, 7, 0, 7)) + torch.diag_embed(beyond)
    vectors: Tensor = torch.linalg.eigh(whole).eigenvectors
    return vectors[:, :9, 0]


def _agree(
    matches: Matches, partners: Tensor, graphs: MatchGraphs, near_px: float, spread: float, backend: Backend
) -> Tensor:
    """(M,) bool, whether some neighbours move as a match does, under a map of view 1."""
    limits = near_px, near_px, 0.0, spread
    votes = ops.agreeing_neighbors(matches.keypoints0, partners, *graphs.patterns, *limits, backend)
    return votes >= LEAST_VOTES


def _miss_px(homography: Tensor, points: Normalized) -> Tensor:
    miss = map_points(homography, points.right, points.pairs.batch) - points.left
    return miss.square().sum(1).sqrt() * points.pairs.spread(points.size)


def _gram(weight: Tensor, columns: Sequence[Tensor], pairs: PairSums) -> Tensor:
    """(B, C, C) weighted sums of products of the columns, symmetric, over the rows of each pair."""
    size = len(columns)
    weighted = [weight * column for column in columns]
    upper = pairs.sum(torch.stack([weighted[k] * columns[m] for k in range(size) for m in range(k, size)], 1))
    return _symmetric(upper, size)


def _symmetric(upper: Tensor, size: int) -> Tensor:
    """(B, C, C) matrices of their upper triangles (B, C (C + 1) / 2), row by row."""
    place = [min(k, m) * (2 * size - min(k, m) - 1) // 2 + max(k, m) for k in range(size) for m in range(size)]
    return upper[:, place].reshape(-1, size, size)


def _products(rows: Sequence[Tensor], columns: Sequence[Tensor], pairs: PairSums) -> Tensor:
    """(B, R, C) sums of products over the rows of each pair."""
    sums = pairs.sum(torch.stack([a * b for a in rows for b in columns], 1))
    return sums.reshape(-1, len(rows), len(columns))


def _median(values: Tensor, pairs: PairSums) -> Tensor:
    """(B, C) lower medians of (K, C) values over the rows of each pair; 0 without."""
    batch = functional.pad(pairs.batch, (0, 1), value=len(pairs.ptr))  # one more, so that there is a row to point at
    place = pairs.ptr[:-1] + (pairs.ptr.diff() - 1).clamp(min=0) // 2
    found = []
    for column in functional.pad(values, (0, 0, 0, 1)).unbind(1):
        order = column.argsort(stable=True)
        order = order.index_select(0, batch.index_select(0, order).argsort(stable=True))
        found.append(column.index_select(0, order.index_select(0, place)))
    return torch.where((pairs.ptr.diff() > 0)[:, None], torch.stack(found, 1), 0)


def _shift(by: Tensor) -> Tensor:
    """(B, 3, 3) translations by (B, 2)."""
    moved = torch.eye(3, dtype=by.dtype, device=by.device).expand(len(by), 3, 3).clone()
    moved[:, :2, 2] = by
    return moved
