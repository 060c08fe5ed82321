"""Local image evidence for putative matches: does another place on the row explain the window better?

Windows around both keypoints of a match are held against the row of the other view, or against the epipolar line of
views that are not rectified, over a range of disparities that follows from the matches themselves, and near the match
once more along the slope of its surface. The measure is the
logarithm of the zero-mean sum of squared differences: but for a constant, the negative log-likelihood per degree of
freedom of Gaussian noise of unknown variance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from tensor_stereo.features import list_images
from tensor_stereo.graphs import MatchGraphs, check_match_graphs
from tensor_stereo.scores.alignment.form import Alignment, align_matches, no_alignment
from tensor_stereo.scores.samplers import Place, Sampler, find_places, look_at_pairs, search_line
from tensor_stereo.scores.slopes import estimate_slopes
from tensor_stereo.scores.windows import (
    LIKE,
    MIDDLE,
    NUM_HALVES,
    NUM_WHOLE,
    RADIUS_PX,
    TIGHT,
    compare_windows,
    lowest_place,
    window_kernels,
)
from tensor_stereo.types import Matches

MAX_DISPARITIES = 256  # of one pair's search range
_NEAR_PX = 3  # disparities on either side of the match that are looked at one by one
_SAME_PX = 2  # a rival is farther from the match than that
_DISC_PX = 4  # radius of the disc that is searched where no rows are known
_DISC_PLACES = 2 * _DISC_PX + 1
_NOWHERE = 20.0  # log SSD of a place outside of the image
_TIE = 1e-3  # log SSDs that near are alike; rounding must not choose between them
_MAX_LOG = 6.0  # log ratios of SSDs are cut there
_ROWS_AT_ONCE = 192  # matches whose windows stay in the cache
_SLANTED = (MIDDLE, LIKE)  # the windows that are also compared along the slope of the surface
_CURVES = (LIKE, TIGHT)  # those whose curve along the row is kept, for the disparities of the neighbours
NUM_CURVES = len(_CURVES)
_NUM_PLACES = 2 * _NEAR_PX + 1
NUM_VALUES = 2 * (NUM_WHOLE * (_NUM_PLACES + 7) + 2 * NUM_HALVES + 1 + len(_SLANTED) * (_NUM_PLACES + 3)) + 2


class ImageEvidence(NamedTuple):
    """What the images say about M matches.

    Windows have 15 x 15 px: 5 x 5 and 11 x 11 boxes, pixels like the centre, in a wide and in a tight window, and four
    halves of 11 x 11.

    Attributes:
        values: (M, :data:`NUM_VALUES`) float32. For the windows of view 0, then of view 1: log SSD at the 7 places
            around the match, less its minimum; log SSD and correlation at the match; by how much the best rival on the
            row is worse in both; share of rivals that are about as good or better; log distance of a better rival; log
            SSD of half windows, and by how much it is above its minimum; log variance and gradient; for windows along
            the slope of the surface log SSD at the 7 places, less its minimum, by how much it is lower than without
            slope, correlation, and where it is lowest. At last the difference of the grey levels, and how far the
            disparity lies outside of the search range.
        curve0: (M, 2, D) float32, log SSD of two windows in view 0 along the row of view 1, less that of the match,
            over pixels like the centre, in a wide and in a tight window, between -6 and 6; column k stands for
            disparity ``first + k`` px.
        curve1: (M, 2, D) float32, the same for the windows in view 1 along the row of view 0.
        first: (M,) float32 px.
        num_columns: (M,) int64 columns that the pair has; 0 without images.
        offset: (M,) float32 px, from the disparity of the match to the one nearby, at most 4 px away, that the windows
            of both views favour, to parts of a px.
    """

    values: Tensor
    curve0: Tensor
    curve1: Tensor
    first: Tensor
    num_columns: Tensor
    offset: Tensor


@torch.no_grad()
def measure_images(
    images0: Tensor | Sequence[Tensor],
    images1: Tensor | Sequence[Tensor],
    matches: Matches,
    graphs: MatchGraphs,
    alignment: Alignment | None = None,
) -> ImageEvidence:
    """Hold the windows of every match against each other and against the rows that they lie in.

    Args:
        images0: B images (C, H, W) of view 0, uint8 or floating point in [0, 1], C = 1 or 3 (RGB), of any sizes; or a
            batch (B, C, H, W).
        images1: their partners.
        matches: B pairs, keypoints in px of these images; outside of them the border is repeated.
        graphs: of the same matches; they tell which disparities to search.
        alignment: What the matches of every pair share; None: rectified pairs with the same rows in both views. View 1
            of pairs that are not rectified is seen in the frame of view 0, in px of view 0, and searched along epipolar
            lines; where there are none, up to 4 px around the match.

    Returns:
        One row per match, on the device of the keypoints; it does not depend on the other pairs. No gradient.

    Raises:
        ValueError: if the numbers of images and pairs, or of matches and nodes, differ.

    Example:
        >>> from tensor_stereo.graphs import build_match_graphs
        >>> image = torch.arange(1200, dtype=torch.uint8).reshape(1, 30, 40)
        >>> points = torch.tensor([[9.0, 9.0], [20.0, 9.0], [9.0, 20.0]])
        >>> matches = Matches(points, points, torch.tensor([0, 3]))
        >>> measure_images([image], [image], matches, build_match_graphs(matches)).curve0.shape
        torch.Size([3, 2, 9])
    """
    views = [
        list_images(name, images, matches.num_pairs) for name, images in (("images0", images0), ("images1", images1))
    ]
    check_match_graphs(matches, graphs)
    if alignment is None:
        alignment = no_alignment(matches.num_pairs, matches.keypoints0)
    aligned = align_matches(matches, alignment)
    places = find_places(matches, aligned, estimate_slopes(aligned, graphs), alignment)
    has_rows = alignment.has_rows.tolist()
    ranges = [
        (first, count if known else min(count, _DISC_PLACES))
        for (first, count), known in zip(search_ranges(aligned, graphs), has_rows, strict=True)
    ]
    width = max((count for _, count in ranges), default=0)
    parts = [_empty(matches.keypoints0, width)]
    with torch.autocast(matches.keypoints0.device.type, enabled=False):
        for b, (samplers, own) in enumerate(look_at_pairs(views, matches, places, alignment)):
            for row in range(0, len(own.left), _ROWS_AT_ONCE):
                rows = slice(row, row + _ROWS_AT_ONCE)
                looks = [sampler.select(rows) for sampler in samplers]
                parts.append(_measure_both(looks, own.select(rows), *ranges[b], width, has_rows=has_rows[b]))
    values, curve0, curve1, offset, first = (torch.cat(part) for part in zip(*parts, strict=True))
    counts = torch.tensor([count for _, count in ranges], dtype=torch.int64, device=matches.ptr.device)
    return ImageEvidence(values, curve0, curve1, first, counts.repeat_interleave(matches.ptr.diff()), offset)


def search_ranges(matches: Matches, graphs: MatchGraphs) -> list[tuple[int, int]]:
    """First disparity and number of disparities to search in each pair, in whole px.

    They cover what at least three neighbours on their rows support, in either view, but for 1 % at both ends, and 15 %
    of that span on either side. Of wider spans the :data:`MAX_DISPARITIES` with the most matches are searched.

    >>> from tensor_stereo.graphs import build_match_graphs
    >>> points = torch.tensor([[9.0, 9.0], [20.0, 9.0], [9.0, 20.0]])
    >>> matches = Matches(points, points - torch.tensor([30.0, 0.0]), torch.tensor([0, 3]))
    >>> search_ranges(matches, build_match_graphs(matches))
    [(26, 9)]
    """
    disparity = matches.disparity
    on_row = (matches.keypoints0[:, 1] - matches.keypoints1[:, 1]).abs() <= 1.5
    votes = torch.zeros_like(disparity)
    for adjacency in (graphs.adjacency0, graphs.adjacency1):
        i, j = adjacency.row_indices, adjacency.col_indices
        agrees = ((disparity[i] - disparity[j]).abs() <= 2) & on_row[i] & on_row[j]
        votes.index_add_(0, i, agrees.to(votes.dtype))
    ranges = []
    for start, stop in pairwise(matches.ptr.tolist()):
        values = disparity[start:stop].double()
        supported = values[votes[start:stop] >= 3]
        believed = supported if len(supported) >= 8 else values
        if not len(believed):
            ranges.append((0, 0))
            continue
        low, high = torch.quantile(believed, believed.new_tensor([0.01, 0.99])).tolist()
        margin = max(4.0, 0.15 * (high - low))
        first, last = math.floor(low - margin), math.ceil(high + margin)
        if last - first >= MAX_DISPARITIES:
            ordered = believed.sort().values
            begin = ordered.floor() - _NEAR_PX
            within = torch.searchsorted(ordered, begin + MAX_DISPARITIES - _NEAR_PX)
            within = within - torch.arange(len(ordered), device=ordered.device)
            first = int(begin[within.argmax()])
            last = first + MAX_DISPARITIES - 1
        ranges.append((first, last - first + 1))
    return ranges


def _empty(like: Tensor, width: int) -> tuple[Tensor, ...]:
    none = torch.zeros(0, dtype=torch.float32, device=like.device)
    curve = none.reshape(0, NUM_CURVES, width)
    return none.reshape(0, NUM_VALUES), curve, curve, none, none


class _Found(NamedTuple):
    """What the windows of one view say about m matches."""

    columns: list[Tensor]
    curve: Tensor  # (m, 2, D)
    offset: Tensor  # (m,)


def _measure_both(
    looks: Sequence[Sampler], places: Place, first: int, count: int, width: int, *, has_rows: bool
) -> tuple[Tensor, ...]:
    """Values, both curves, the offset and the first disparity of m matches of one pair."""
    points = places.left, places.right
    start = places.disparity.round() - _DISC_PX if not has_rows else torch.full_like(places.disparity, first)
    own = (places.disparity - start).round()  # column of the match
    windows = [look.windows(view, RADIUS_PX) for look, view in zip(looks, points, strict=True)]
    slope = places.slope
    shears = -slope / (1 + slope[:, :1] / 2), slope / (1 - slope[:, :1] / 2)
    # a rectified partner lies on the row of the window itself, but for the alignment
    across = places.across, -places.across
    found = [
        _measure_one(
            looks[1 - v], windows[v], points[v], across[v], points[1 - v], shears[v], start, own, count,
            reverse=not v, has_rows=has_rows,
        )
        for v in (0, 1)
    ]  # fmt: skip
    levels = [window[:, 4:-4, 4:-4].mean((1, 2)) for window in windows]
    brighter = (levels[0] - levels[1]).abs() / 16
    beyond = torch.log1p((-own).clamp(min=0) + (own - count + 1).clamp(min=0)).clamp(max=5)
    values = torch.cat([*found[0].columns, *found[1].columns, brighter[:, None], beyond[:, None]], 1)
    curves = (functional.pad(one.curve, (0, width - count)) for one in found)
    return values, *curves, (found[0].offset + found[1].offset) / 2, start


def _measure_one(
    other: Sampler,
    windows: Tensor,
    points: Tensor,
    across: Tensor,
    partners: Tensor,
    shear: Tensor,
    first: Tensor,
    own: Tensor,
    count: int,
    *,
    reverse: bool,
    has_rows: bool,
) -> _Found:
    """What the windows of one view say; ``reverse``: disparity grows against the columns of the other view."""
    kernels = window_kernels(windows)
    whole = slice(0, NUM_WHOLE)

    def compare(strips: Tensor, kernels: Tensor, *, has_tight: bool = True) -> tuple[Tensor, Tensor, Tensor]:
        cost, likeness, variance = compare_windows(windows, strips, kernels, has_tight=has_tight)
        return (cost.flip(1), likeness.flip(1), variance) if reverse else (cost, likeness, variance)

    cost, likeness, variance = compare(other.windows(partners, RADIUS_PX + _NEAR_PX), kernels)
    mid, lowest = cost[:, _NEAR_PX], cost.amin(1)
    slanted = other.slanted(partners, RADIUS_PX + _NEAR_PX, shear)
    along, along_likeness, _ = compare(slanted, kernels[..., list(_SLANTED)], has_tight=False)
    offset = lowest_place(along) * (1 + shear[:, :1])  # whose places are that far apart
    rows = [0] if has_rows else list(range(-_DISC_PX, _DISC_PX + 1))
    searched = []
    for row in rows:
        strips, outside = search_line(other, points, across + row, first, count, reverse=reverse)
        far, far_likeness, _ = compare(strips, kernels[..., whole])
        searched.append((far, far_likeness, outside.flip(1) if reverse else outside))
    far, far_likeness, outside = (torch.cat(part, 1) for part in zip(*searched, strict=True))
    place = torch.arange(count, device=own.device).repeat(len(rows))
    below = torch.tensor(rows, device=own.device).repeat_interleave(count)
    away = torch.hypot(place - own[:, None], below.float())
    outside = (outside | ((away > _DISC_PX) & (not has_rows)))[..., None]
    far, far_likeness = far.masked_fill(outside, _NOWHERE), far_likeness.masked_fill(outside, -1.0)
    same = (away <= _SAME_PX)[..., None]
    alone = (same | outside).all(1)
    others = far.masked_fill(same, _NOWHERE)
    away = away[..., None].expand_as(others)  # of equal rivals the nearest counts
    rival = others.amin(1)
    nearest = away.masked_fill(others > rival[:, None] + _TIE, 100).amin(1)
    here, here_likeness = mid[:, whole], likeness[:, _NEAR_PX, whole]
    margin = (rival - here).clamp(-_MAX_LOG, _MAX_LOG).masked_fill(alone, 0)
    margin_likeness = (here_likeness - far_likeness.masked_fill(same, -1.0).amax(1)).masked_fill(alone, 0)
    columns = [
        (cost - lowest[:, None])[..., whole].flatten(1),
        here,
        here_likeness,
        margin,
        margin_likeness,
        (~same & (far < here[:, None] + 0.3)).float().mean(1),
        torch.log1p(nearest.clamp(max=100)).masked_fill(margin >= -_TIE, 0),
        mid[:, NUM_WHOLE:],
        (mid - lowest)[:, NUM_WHOLE:],
        variance[:, whole],
        torch.log1p(windows.diff(dim=2)[:, 3:-3, 3:-3].square().mean((1, 2)))[:, None],
        (along - along.amin(1, keepdim=True)).flatten(1),
        along[:, _NEAR_PX] - mid[:, list(_SLANTED)],
        along_likeness[:, _NEAR_PX],
        offset,
    ]
    curve = (far[:, below == 0] - here[:, None])[..., list(_CURVES)].clamp(-_MAX_LOG, _MAX_LOG)
    return _Found(columns, curve.transpose(1, 2), offset.mean(1))
