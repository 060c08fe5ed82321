"""What the windows around both keypoints of matches say, in plain torch: the definition of ``window_evidence``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from tensor_stereo.ops.samplers import Place, Sampler, Views, search_line
from tensor_stereo.ops.windows import (
    LIKE,
    MIDDLE,
    NUM_HALVES,
    NUM_WHOLE,
    RADIUS_PX,
    TIE,
    TIGHT,
    compare_windows,
    lowest_place,
    window_kernels,
)

NEAR_PX = 3  # disparities on either side of the match that are looked at one by one
DISC_PX = 4  # radius of the disc that is searched where no rows are known
_SAME_PX = 2  # a rival is farther from the match than that
_NOWHERE = 20.0  # log SSD of a place outside of the image
_MAX_LOG = 6.0  # log ratios of SSDs are cut there
_GOOD, _GOOD_WIDTH = 0.3, 0.05  # by how much a rival may be worse and counts, and a half of the ramp there
_ROWS_AT_ONCE = 192  # matches whose windows stay in the cache
_SLANTED = (MIDDLE, LIKE)  # the windows that are also compared along the slope of the surface
_CURVES = (LIKE, TIGHT)  # those whose curve along the row is kept, for the disparities of the neighbours
NUM_CURVES = len(_CURVES)
_NUM_PLACES = 2 * NEAR_PX + 1
NUM_VALUES = 2 * (NUM_WHOLE * (_NUM_PLACES + 7) + 2 * NUM_HALVES + 1 + len(_SLANTED) * (_NUM_PLACES + 3)) + 2


def window_evidence(
    views: Views,
    places: Place,
    ptr: Tensor,
    first: Tensor,
    count: Tensor,
    has_rows: Tensor,
    rectified: Tensor,
    width: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The results of the operator of the same name, whose arguments these are."""
    none = torch.zeros(0, dtype=torch.float32, device=ptr.device)
    curve = none.reshape(0, NUM_CURVES, width)
    parts: list[tuple[Tensor, ...]] = [(none.reshape(0, NUM_VALUES), curve, curve, none, none)]
    ranges = list(zip(first.tolist(), count.tolist(), has_rows.tolist(), strict=True))
    for b, rows, looks in views.look_in_parts(places.along, ptr, rectified, _ROWS_AT_ONCE):
        low, num_places, has_own_rows = ranges[b]
        parts.append(measure_both(looks, places.select(rows), low, num_places, width, has_rows=has_own_rows))
    return tuple(torch.cat(part) for part in zip(*parts, strict=True))  # type: ignore[return-value]


class _Found(NamedTuple):
    """What the windows of one view say about m matches."""

    columns: list[Tensor]
    curve: Tensor  # (m, 2, D)
    offset: Tensor  # (m,)


def measure_both(
    looks: Sequence[Sampler], places: Place, first: int, count: int, width: int, *, has_rows: bool
) -> tuple[Tensor, ...]:
    """Values, both curves, the first disparity and the offset of m matches of one pair."""
    points = places.left, places.right
    start = places.disparity.round() - DISC_PX if not has_rows else torch.full_like(places.disparity, first)
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
    return values, *curves, start, (found[0].offset + found[1].offset) / 2


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

    cost, likeness, variance = compare(other.windows(partners, RADIUS_PX + NEAR_PX), kernels)
    mid, lowest = cost[:, NEAR_PX], cost.amin(1)
    slanted = other.slanted(partners, RADIUS_PX + NEAR_PX, shear)
    along, along_likeness, _ = compare(slanted, kernels[..., list(_SLANTED)], has_tight=False)
    offset = lowest_place(along) * (1 + shear[:, :1])  # whose places are that far apart
    rows = [0] if has_rows else list(range(-DISC_PX, DISC_PX + 1))
    searched = []
    for row in rows:
        strips, outside = search_line(other, points, across + row, first, count, reverse=reverse)
        far, far_likeness, _ = compare(strips, kernels[..., whole])
        searched.append((far, far_likeness, outside.flip(1) if reverse else outside))
    far, far_likeness, outside = (torch.cat(part, 1) for part in zip(*searched, strict=True))
    place = torch.arange(count, device=own.device).repeat(len(rows))
    below = torch.tensor(rows, device=own.device).repeat_interleave(count)
    away = torch.hypot(place - own[:, None], below.float())
    outside = (outside | ((away > DISC_PX) & (not has_rows)))[..., None]
    far, far_likeness = far.masked_fill(outside, _NOWHERE), far_likeness.masked_fill(outside, -1.0)
    same = (away <= _SAME_PX)[..., None]
    alone = (same | outside).all(1)
    others = far.masked_fill(same, _NOWHERE)
    away = away[..., None].expand_as(others)  # of equal rivals the nearest counts
    rival = others.amin(1)
    nearest = away.masked_fill(others > rival[:, None] + TIE, 100).amin(1)
    here, here_likeness = mid[:, whole], likeness[:, NEAR_PX, whole]
    margin = (rival - here).clamp(-_MAX_LOG, _MAX_LOG).masked_fill(alone, 0)
    margin_likeness = (here_likeness - far_likeness.masked_fill(same, -1.0).amax(1)).masked_fill(alone, 0)
    columns = [
        (cost - lowest[:, None])[..., whole].flatten(1),
        here,
        here_likeness,
        margin,
        margin_likeness,
        torch.where(same, 0, ((here[:, None] + _GOOD - far) / (2 * _GOOD_WIDTH) + 0.5).clamp(0, 1)).mean(1),
        torch.log1p(nearest.clamp(max=100)).masked_fill(margin >= -TIE, 0),
        mid[:, NUM_WHOLE:],
        (mid - lowest)[:, NUM_WHOLE:],
        variance[:, whole],
        torch.log1p(windows.diff(dim=2)[:, 3:-3, 3:-3].square().mean((1, 2)))[:, None],
        (along - along.amin(1, keepdim=True)).flatten(1),
        along[:, NEAR_PX] - mid[:, list(_SLANTED)],
        along_likeness[:, NEAR_PX],
        offset,
    ]
    curve = (far[:, below == 0] - here[:, None])[..., list(_CURVES)].clamp(-_MAX_LOG, _MAX_LOG)
    return _Found(columns, curve.transpose(1, 2), offset.mean(1))
