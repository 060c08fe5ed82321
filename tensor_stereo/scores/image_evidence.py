"""Local image evidence for putative matches: does another place on the row explain the window better?

Windows around both keypoints of a match are held against the row of the other view, over a range of disparities that
follows from the matches themselves. The measure is the logarithm of the zero-mean sum of squared differences: but for a
constant, the negative log-likelihood per degree of freedom of Gaussian noise of unknown variance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from tensor_stereo.features import list_images, to_gray
from tensor_stereo.graphs import MatchGraphs, check_match_graphs
from tensor_stereo.scores.alignment import Alignment, align_matches
from tensor_stereo.types import Matches

MAX_DISPARITIES = 256  # of one pair's search range
_RADIUS_PX = 7  # of the largest window
_NEAR_PX = 3  # disparities on either side of the match that are looked at one by one
_SAME_PX = 2  # a rival is farther from the match than that
_NOISE_VARIANCE = 2.0  # grey levels squared; keeps windows without texture from deciding
_NOWHERE = 20.0  # log SSD of a place outside of the image
_TIE = 1e-3  # log SSDs that near are alike; rounding must not choose between them
_MAX_LOG = 6.0  # log ratios of SSDs are cut there
_LIKENESS_LEVELS, _LIKENESS_PX2 = 12.0, 40.0  # fall-off of the weights of pixels unlike the centre
_ROWS_AT_ONCE = 192  # matches whose windows stay in the cache
_WHOLE, _HALF = 3, 4  # whole windows, which are also held against the row, and half windows
NUM_VALUES = 2 * (_WHOLE * (2 * _NEAR_PX + 1 + 7) + 2 * _HALF + 1) + 2


class ImageEvidence(NamedTuple):
    """What the images say about M matches.

    Windows have 15 x 15 px: 5 x 5 and 11 x 11 boxes, pixels like the centre, and four halves of 11 x 11.

    Attributes:
        values: (M, :data:`NUM_VALUES`) float32. For the windows of view 0, then of view 1: log SSD at the 7 places
            around the match, less its minimum; log SSD and correlation at the match; by how much the best rival on the
            row is worse in both; share of rivals that are about as good or better; log distance of a better rival; log
            SSD of half windows, and by how much it is above its minimum; log variance and gradient. At last the
            difference of the grey levels, and how far the disparity lies outside of the search range.
        curve0: (M, D) float32, log SSD of the window in view 0 along the row of view 1, less that of the match, over
            pixels like the centre, between -6 and 6; column k stands for disparity ``first + k`` px.
        curve1: (M, D) float32, the same for the window in view 1 along the row of view 0.
        first: (M,) float32 px.
        num_columns: (M,) int64 columns that the pair has; 0 without images.
    """

    values: Tensor
    curve0: Tensor
    curve1: Tensor
    first: Tensor
    num_columns: Tensor


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
        alignment: Where the rows of view 0 lie in view 1; None: they are the same.

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
        torch.Size([3, 9])
    """
    views = [
        list_images(name, images, matches.num_pairs) for name, images in (("images0", images0), ("images1", images1))
    ]
    check_match_graphs(matches, graphs)
    ranges = search_ranges(matches if alignment is None else align_matches(matches, alignment), graphs)
    row_shift = matches.keypoints0.new_zeros(matches.num_matches).float()
    if alignment is not None:
        row_shift = alignment.row_shift(matches.keypoints0, matches.ptr).float()
    width = max((count for _, count in ranges), default=0)
    parts = [_empty(matches.keypoints0, width)]
    with torch.autocast(matches.keypoints0.device.type, enabled=False):
        for b, (start, stop) in enumerate(pairwise(matches.ptr.tolist())):
            gray = [to_gray(images[b][None])[0, 0].float() for images in views]
            for row in range(start, stop, _ROWS_AT_ONCE):
                rows = slice(row, min(row + _ROWS_AT_ONCE, stop))
                points = [keypoints[rows].float() for keypoints in (matches.keypoints0, matches.keypoints1)]
                parts.append(_measure_both(gray, points, row_shift[rows], *ranges[b], width))
    values, curve0, curve1 = (torch.cat(part) for part in zip(*parts, strict=True))
    spread = torch.tensor(ranges, dtype=torch.int64, device=matches.ptr.device).reshape(-1, 2)
    first, count = spread.repeat_interleave(matches.ptr.diff(), 0).unbind(1)
    return ImageEvidence(values, curve0, curve1, first.float(), count)


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
            within = torch.searchsorted(ordered, begin + MAX_DISPARITIES - _NEAR_PX) - torch.arange(len(ordered))
            first = int(begin[within.argmax()])
            last = first + MAX_DISPARITIES - 1
        ranges.append((first, last - first + 1))
    return ranges


def _empty(like: Tensor, width: int) -> tuple[Tensor, ...]:
    none = torch.zeros(0, dtype=torch.float32, device=like.device)
    return none.reshape(0, NUM_VALUES), none.reshape(0, width), none.reshape(0, width)


def _measure_both(
    gray: Sequence[Tensor], points: Sequence[Tensor], row_shift: Tensor, first: int, count: int, width: int
) -> tuple[Tensor, ...]:
    """Values and both curves of m matches of one pair."""
    own = (points[0][:, 0] - points[1][:, 0] - first).round()  # column of the match
    columns, curves, levels = [], [], []
    for view in (0, 1):
        windows = _sample(gray[view], points[view], _RADIUS_PX)
        row = points[view][:, 1] + (-row_shift if view else row_shift)  # in the other view
        side, curve = _measure_one(
            gray[1 - view], windows, points[view], row, points[1 - view], own, first, count, view
        )
        columns += side
        curves.append(torch.nn.functional.pad(curve, (0, width - count)))
        levels.append(windows[:, 4:-4, 4:-4].mean((1, 2)))
    brighter = (levels[0] - levels[1]).abs() / 16
    beyond = torch.log1p((-own).clamp(min=0) + (own - count + 1).clamp(min=0)).clamp(max=5)
    return torch.cat([*columns, brighter[:, None], beyond[:, None]], 1), *curves


def _measure_one(
    other: Tensor,
    windows: Tensor,
    points: Tensor,
    row: Tensor,
    partners: Tensor,
    own: Tensor,
    first: int,
    count: int,
    view: int,
) -> tuple[list[Tensor], Tensor]:
    """Values of the windows of one view, held against the image of the other, and their curve."""
    kernels = _window_kernels(windows)
    near = _sample(other, partners, _RADIUS_PX + _NEAR_PX)
    cost, likeness, variance = _compare(windows, near, kernels)
    if not view:  # disparity grows against the columns of view 1
        cost, likeness = cost.flip(1), likeness.flip(1)
    mid, lowest = cost[:, _NEAR_PX], cost.amin(1)
    # the row of the window itself, but for the alignment: there lies a rectified partner
    toward = 1 if view else -1  # way of growing disparity in the other view
    x = points[:, :1] + toward * (first + torch.arange(count, device=points.device))  # (m, D)
    left = x.amin(1) if count else points[:, 0]
    strip = _sample_strip(other, left - _RADIUS_PX, row, count + 2 * _RADIUS_PX)
    far, far_likeness, _ = _compare(windows, strip, kernels[..., :_WHOLE])
    if not view:
        far, far_likeness = far.flip(1), far_likeness.flip(1)
    outside = ((x < 0) | (x > other.shape[1] - 1))[..., None]
    far, far_likeness = far.masked_fill(outside, _NOWHERE), far_likeness.masked_fill(outside, -1.0)
    place = torch.arange(count, device=own.device)
    same = ((place - own[:, None]).abs() <= _SAME_PX)[..., None]
    alone = (same | outside).all(1)
    others = far.masked_fill(same, _NOWHERE)
    rival = others.amin(1)
    away = (place - own[:, None]).abs()[..., None].expand_as(others)  # of equal rivals the nearest counts
    nearest = away.masked_fill(others > rival[:, None] + _TIE, 100).amin(1)
    whole, whole_likeness = mid[:, :_WHOLE], likeness[:, _NEAR_PX, :_WHOLE]
    margin = (rival - whole).clamp(-_MAX_LOG, _MAX_LOG).masked_fill(alone, 0)
    margin_likeness = (whole_likeness - far_likeness.masked_fill(same, -1.0).amax(1)).masked_fill(alone, 0)
    crowd = (~same & (far < whole[:, None] + 0.3)).float().mean(1)
    distance = torch.log1p(nearest.clamp(max=100)).masked_fill(margin >= -_TIE, 0)
    gradient = torch.log1p(windows.diff(dim=2)[:, 3:-3, 3:-3].square().mean((1, 2)))
    columns = [
        (cost - lowest[:, None])[..., :_WHOLE].flatten(1),
        whole,
        whole_likeness,
        margin,
        margin_likeness,
        crowd,
        distance,
        mid[:, _WHOLE:],
        (mid - lowest)[:, _WHOLE:],
        variance[:, :_WHOLE],
        gradient[:, None],
    ]
    return columns, (far[..., 2] - mid[:, 2, None]).clamp(-_MAX_LOG, _MAX_LOG)


def _sample(image: Tensor, centers: Tensor, radius_x: int) -> Tensor:
    """(m, 15, 2 rx + 1) grey levels around sub-pixel centres."""
    return _sample_strip(image, centers[:, 0] - radius_x, centers[:, 1], 2 * radius_x + 1)


def _sample_strip(image: Tensor, left: Tensor, center_y: Tensor, width: int) -> Tensor:
    """(m, 15, width) grey levels of strips that begin at x = ``left``; bilinear, the border repeated."""
    height, num_columns = image.shape
    left = left.clamp(-2.0 * width, num_columns + 2.0 * width)
    center_y = center_y.clamp(-2.0 * _RADIUS_PX, height + 2.0 * _RADIUS_PX)
    x0, y0 = left.floor(), center_y.floor()
    fx, fy = (left - x0)[:, None, None], (center_y - y0)[:, None, None]
    rows = torch.arange(-_RADIUS_PX, _RADIUS_PX + 2, device=image.device)
    x = (x0.long()[:, None] + torch.arange(width + 1, device=image.device)).clamp(0, num_columns - 1)
    y = (y0.long()[:, None] + rows).clamp(0, height - 1)
    levels = image.reshape(-1)[y[:, :, None] * num_columns + x[:, None]]
    levels = levels[:, :-1] + fy * (levels[:, 1:] - levels[:, :-1])
    return levels[..., :-1] + fx * (levels[..., 1:] - levels[..., :-1])


def _window_kernels(windows: Tensor) -> Tensor:
    """(m, 225, 7) weights with sum 1: 5x5, 11x11, pixels like the centre (Yoon & Kweon 2006), four half windows."""
    side = windows.shape[1]
    r = torch.arange(side, device=windows.device) - _RADIUS_PX
    y, x = r[:, None].expand(side, side), r.expand(side, side)
    middle = (x.abs() <= 5) & (y.abs() <= 5)
    small = (x.abs() <= 2) & (y.abs() <= 2)
    halves = [middle & (x <= 1), middle & (x >= -1), middle & (y <= 1), middle & (y >= -1)]
    boxes = torch.stack([small, middle, *halves]).float().expand(len(windows), -1, -1, -1)
    center = windows[:, _RADIUS_PX - 1 : _RADIUS_PX + 2, _RADIUS_PX - 1 : _RADIUS_PX + 2].mean((1, 2))
    unlike = (windows - center[:, None, None]).abs() / _LIKENESS_LEVELS
    similar = torch.exp(-unlike - (x.square() + y.square()).float() / _LIKENESS_PX2)[:, None] + 1e-4
    weights = torch.cat([boxes[:, :2], similar, boxes[:, 2:]], 1).flatten(2)
    return (weights / weights.sum(2, keepdim=True)).transpose(1, 2)


def _compare(windows: Tensor, strips: Tensor, kernels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Log zero-mean SSD (m, D, K), correlation (m, D, K), and log variance of the windows (m, K).

    ``strips`` is (m, 15, D + 14): D windows, each one column on.
    """
    side, k = windows.shape[1], kernels.shape[2]
    level = windows.mean((1, 2))[:, None, None]  # near zero the squares keep their digits
    anchor = (windows - level).flatten(1)[..., None]
    moving = (strips - level).unfold(2, side, 1).transpose(1, 2).reshape(len(strips), -1, side * side)
    sums = moving @ torch.cat([kernels, kernels * anchor], 2)
    squares = moving.square_() @ kernels
    mean, product = sums[..., :k], sums[..., k:]
    anchor_mean = (kernels * anchor).sum(1)
    anchor_variance = ((kernels * anchor.square()).sum(1) - anchor_mean.square()).clamp(min=0)
    variance = (squares - mean.square()).clamp(min=0)
    covariance = product - mean * anchor_mean[:, None]
    difference = (variance + anchor_variance[:, None] - 2 * covariance).clamp(min=0)
    scale = (variance + _NOISE_VARIANCE) * (anchor_variance[:, None] + _NOISE_VARIANCE)
    return torch.log(difference + _NOISE_VARIANCE), covariance / scale.sqrt(), torch.log(anchor_variance + 1)
