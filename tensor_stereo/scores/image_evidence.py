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
_SLOPE_GAP_PX, _STEEPEST, _SLOPE_REACH_PX, _SLOPE_RIDGE, _SLOPE_MISS_PX = 2.0, 0.5, 40.0, 40.0, 1.0
_NOISE_VARIANCE = 2.0  # grey levels squared; keeps windows without texture from deciding
_NOWHERE = 20.0  # log SSD of a place outside of the image
_TIE = 1e-3  # log SSDs that near are alike; rounding must not choose between them
_MAX_LOG = 6.0  # log ratios of SSDs are cut there
_LIKENESS_LEVELS, _LIKENESS_PX2 = 12.0, 40.0  # fall-off of the weights of pixels unlike the centre
_ROWS_AT_ONCE = 192  # matches whose windows stay in the cache
_TIGHT_LEVELS, _TIGHT_PX2 = 10.0, 8.0  # the same around the pixel of the keypoint itself
_WHOLE, _HALF = 4, 4  # whole windows, which are also held against the row, and half windows
_TIGHT = 3  # whose mean counts as well
_CURVES = 6  # the windows of pixels like the centre, and the half windows
_PLACES = 2 * _NEAR_PX + 1
_SLANTED = (1, 2)  # the whole windows that are also compared along the slope of the surface
_SLANTED_VALUES = len(_SLANTED) * (_PLACES + 3)
NUM_VALUES = 2 * (_WHOLE * (_PLACES + 7) + 2 * _HALF + 1 + _SLANTED_VALUES) + 2


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
    slope = local_slopes(matches, graphs)
    row_shift = matches.keypoints0.new_zeros(matches.num_matches).float()
    if alignment is not None:
        row_shift = alignment.row_shift(matches.keypoints0, matches.ptr).float()
    width = max((count for _, count in ranges), default=0)
    parts = [_empty(matches.keypoints0, width)]
    with torch.autocast(matches.keypoints0.device.type, enabled=False):
        for b, (start, stop) in enumerate(pairwise(matches.ptr.tolist())):
            gray = [to_gray(images[b][None])[0, 0].float() for images in views]
            gray[1] = gray[1] - _brighter(gray, matches, start, stop)
            for row in range(start, stop, _ROWS_AT_ONCE):
                rows = slice(row, min(row + _ROWS_AT_ONCE, stop))
                points = [keypoints[rows].float() for keypoints in (matches.keypoints0, matches.keypoints1)]
                parts.append(_measure_both(gray, points, row_shift[rows], slope[rows], *ranges[b], width))
    values, curve0, curve1, offset = (torch.cat(part) for part in zip(*parts, strict=True))
    spread = torch.tensor(ranges, dtype=torch.int64, device=matches.ptr.device).reshape(-1, 2)
    first, count = spread.repeat_interleave(matches.ptr.diff(), 0).unbind(1)
    return ImageEvidence(values, curve0, curve1, first.float(), count, offset)


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


def _brighter(gray: Sequence[Tensor], matches: Matches, start: int, stop: int) -> Tensor:
    """() by how many grey levels view 1 is brighter, the median over the matches of a pair."""
    if start == stop:
        return gray[0].new_zeros(())
    levels = []
    for image, points in zip(gray, (matches.keypoints0, matches.keypoints1), strict=True):
        smooth = torch.nn.functional.avg_pool2d(image[None, None], 5, 1, 2, count_include_pad=False)[0, 0]
        x, y = points[start:stop].round().long().unbind(1)
        levels.append(smooth[y.clamp(0, image.shape[0] - 1), x.clamp(0, image.shape[1] - 1)])
    return (levels[1] - levels[0]).median()


def _empty(like: Tensor, width: int) -> tuple[Tensor, ...]:
    none = torch.zeros(0, dtype=torch.float32, device=like.device)
    return none.reshape(0, NUM_VALUES), *(none.reshape(0, _CURVES, width),) * 2, none


def _measure_both(
    gray: Sequence[Tensor], points: Sequence[Tensor], row_shift: Tensor, slope: Tensor, first: int, count: int, width: int
) -> tuple[Tensor, ...]:
    """Values and both curves of m matches of one pair."""
    own = (points[0][:, 0] - points[1][:, 0] - first).round()  # column of the match
    columns, curves, levels, offsets = [], [], [], []
    rate = 1 / (1 - slope[:, :1])  # of view 1 against view 0
    for view in (0, 1):
        windows = _sample(gray[view], points[view], _RADIUS_PX)
        row = points[view][:, 1] + (-row_shift if view else row_shift)  # in the other view
        shear = slope * rate if view else -slope
        side, curve, offset = _measure_one(
            gray[1 - view], windows, points[view], row, points[1 - view], own, first, count, view, shear
        )
        offsets.append(offset)
        columns += side
        curves.append(torch.nn.functional.pad(curve, (0, width - count)))
        levels.append(windows[:, 4:-4, 4:-4].mean((1, 2)))
    brighter = (levels[0] - levels[1]).abs() / 16
    beyond = torch.log1p((-own).clamp(min=0) + (own - count + 1).clamp(min=0)).clamp(max=5)
    return torch.cat([*columns, brighter[:, None], beyond[:, None]], 1), *curves, sum(offsets) / 2


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
    shear: Tensor,
) -> tuple[list[Tensor], Tensor, Tensor]:
    """Values of the windows of one view, held against the image of the other, and their curve."""
    kernels = _window_kernels(windows)
    near = _sample(other, partners, _RADIUS_PX + _NEAR_PX)
    cost, likeness, variance = _compare(windows, near, kernels)
    if not view:  # disparity grows against the columns of view 1
        cost, likeness = cost.flip(1), likeness.flip(1)
    mid, lowest = cost[:, _NEAR_PX], cost.amin(1)
    slanted = _sample_slanted(other, partners, shear)
    along, along_likeness, _ = _compare(windows, slanted, kernels[..., list(_SLANTED)])
    if not view:
        along, along_likeness = along.flip(1), along_likeness.flip(1)
    offset = _lowest_place(along.exp())
    # the row of the window itself, but for the alignment: there lies a rectified partner
    toward = 1 if view else -1  # way of growing disparity in the other view
    x = points[:, :1] + toward * (first + torch.arange(count, device=points.device))  # (m, D)
    left = x.amin(1) if count else points[:, 0]
    strip = _sample_strip(other, left - _RADIUS_PX, row, count + 2 * _RADIUS_PX)
    far, far_likeness, _ = _compare(windows, strip, kernels)
    if not view:
        far, far_likeness = far.flip(1), far_likeness.flip(1)
    curve = (far[..., -_CURVES:] - mid[:, None, -_CURVES:]).clamp(-_MAX_LOG, _MAX_LOG)
    far, far_likeness = far[..., :_WHOLE], far_likeness[..., :_WHOLE]
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
        (along - along.amin(1, keepdim=True)).flatten(1),
        along[:, _NEAR_PX] - mid[:, list(_SLANTED)],
        along_likeness[:, _NEAR_PX],
        offset,
    ]
    return columns, curve.transpose(1, 2), offset[:, -1]


def _lowest_place(cost: Tensor) -> Tensor:
    """(m, K) px from the middle place to the lowest, by the parabola through it and both beside it."""
    k = cost.argmin(1, keepdim=True).clamp(1, _PLACES - 2)
    before, least, after = (cost.gather(1, k + step)[:, 0] for step in (-1, 0, 1))
    bend = (before - 2 * least + after).clamp(min=1e-3)
    return (k[:, 0] - _NEAR_PX) + ((before - after) / (2 * bend)).clamp(-1, 1)


def _sample_slanted(image: Tensor, centers: Tensor, shear: Tensor) -> Tensor:
    """(m, 15, 21) grey levels around sub-pixel centres, with columns moved by the shear of the place; bilinear."""
    height, width = image.shape
    v = torch.arange(-_RADIUS_PX, _RADIUS_PX + 1, device=image.device, dtype=torch.float32)[:, None]
    reach = _RADIUS_PX + _NEAR_PX
    u = torch.arange(-reach, reach + 1, device=image.device, dtype=torch.float32)
    x = (centers[:, 0, None, None] + u + shear[:, 0, None, None] * u + shear[:, 1, None, None] * v).clamp(0, width - 1)
    y = (centers[:, 1, None, None] + v).clamp(0, height - 1)
    x0, y0 = x.floor(), y.floor()
    fx, fy = x - x0, y - y0
    left, top = x0.long(), y0.long()
    right, bottom = (left + 1).clamp(max=width - 1), (top + 1).clamp(max=height - 1)
    flat = image.reshape(-1)
    rows = [flat[row * width + left] * (1 - fx) + flat[row * width + right] * fx for row in (top, bottom)]
    return rows[0] + fy * (rows[1] - rows[0])


def local_slopes(matches: Matches, graphs: MatchGraphs) -> Tensor:
    """(M, 2) float32 px/px, how the disparity changes with x and y of view 0 around every match."""
    x, y = matches.keypoints0.double().unbind(1)
    disparity = matches.disparity.double()
    ends = [torch.cat([getattr(a, name) for a in (graphs.adjacency0, graphs.adjacency1)]) for name in ("row_indices", "col_indices")]
    dx, dy, gap = (values[ends[1]] - values[ends[0]] for values in (x, y, disparity))
    length = (dx * dx + dy * dy).sqrt()
    weight = (gap.abs() <= (_SLOPE_GAP_PX + _STEEPEST * length)).double() / (1 + (gap / (1 + 0.2 * length)) ** 2)
    a = b = torch.zeros_like(x)
    near = 1 / (1 + (length / _SLOPE_REACH_PX) ** 2)
    for _ in range(4):
        wx, wy = weight * near * dx, weight * near * dy
        xx, xy, yy, gx, gy = (
            torch.zeros_like(x).index_add(0, ends[0], column)
            for column in (wx * dx, wx * dy, wy * dy, wx * gap, wy * gap)
        )
        xx, yy = xx + _SLOPE_RIDGE, yy + _SLOPE_RIDGE
        determinant = xx * yy - xy * xy
        a, b = (gx * yy - gy * xy) / determinant, (gy * xx - gx * xy) / determinant
        miss = gap - a[ends[0]] * dx - b[ends[0]] * dy
        weight = 1 / (1 + (miss / _SLOPE_MISS_PX).square()).square()
    return torch.stack([a, b], 1).clamp(-_STEEPEST, _STEEPEST).float()


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
    far = (x.square() + y.square()).float()
    similar = torch.exp(-unlike - far / _LIKENESS_PX2)[:, None] + 1e-4
    unlike = (windows - windows[:, _RADIUS_PX, _RADIUS_PX, None, None]).abs() / _TIGHT_LEVELS
    tight = torch.exp(-unlike - far / _TIGHT_PX2)[:, None] + 1e-5
    weights = torch.cat([boxes[:, :2], similar, tight, boxes[:, 2:]], 1).flatten(2)
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
    if k > _TIGHT:
        difference[..., _TIGHT] += (mean - anchor_mean[:, None])[..., _TIGHT].square()
    scale = (variance + _NOISE_VARIANCE) * (anchor_variance[:, None] + _NOISE_VARIANCE)
    return torch.log(difference + _NOISE_VARIANCE), covariance / scale.sqrt(), torch.log(anchor_variance + 1)
