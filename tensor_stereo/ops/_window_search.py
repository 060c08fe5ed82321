"""Operator that searches rows and lines for the place where the window of a keypoint fits best."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator
from tensor_stereo.ops.samplers import Sampler, Views, search_line
from tensor_stereo.ops.windows import (
    LIKE,
    NUM_WHOLE,
    RADIUS_PX,
    TIGHT,
    compare_windows,
    parabola_offset,
    window_kernels,
)

_NOWHERE = 40.0  # log SSD of a place that is not looked at
_ROWS_AT_ONCE = 192


def _fake(*args: Any) -> tuple[Tensor, Tensor]:
    points = args[5]
    return points.new_empty(points.shape[0], dtype=torch.float32), points.new_empty(points.shape[0], dtype=torch.bool)


@operator(_fake)
def window_search(
    images0: list[Tensor],
    images1: list[Tensor],
    known1: list[Tensor],
    origin: Tensor,
    brighter: Tensor,
    points: Tensor,
    along: Tensor,
    across: Tensor,
    predicted: Tensor,
    ptr: Tensor,
    first: Tensor,
    count: Tensor,
    rectified: Tensor,
    near_px: float,
    backend: str,
) -> tuple[Tensor, Tensor]:
    """The disparity near some predictions at which the window of a keypoint of view 0 fits best in view 1.

    Args:
        images0: B images, as for :func:`tensor_stereo.ops.window_evidence`, and so are the next four.
        images1: Their partners.
        known1: Maps of the places that view 1 has seen.
        origin: (B, 2) float32 px.
        brighter: (B,) float32 grey levels.
        points: (T, 2) float32 px of view 0.
        along: (T, 2) float32 unit vectors along the epipolar lines.
        across: (T,) float32 px, how far across the keypoint its line lies in view 1.
        predicted: (T, K) float32 px.
        ptr: (B + 1,) int64 offsets of the pairs.
        first: (B,) int64 px, the least disparity.
        count: (B,) int64 number of whole disparities, at least 3.
        rectified: (B,) bool, whether the lines are rows.
        near_px: How far from a prediction is searched.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        (T,) float32 px, to a fraction, of the least mean of the log SSDs of two windows, and (T,) bool, whether a place
        near a prediction lies in view 1. No gradient.
    """
    kernels = native(backend)
    views = Views(images0, images1, known1, origin, brighter)
    if kernels is not None:
        results = kernels.window_search(
            *views.to_numpy(),
            *(given.float().contiguous().numpy(force=True) for given in (points, along, across, predicted)),
            *(given.numpy(force=True) for given in (ptr, first, count, rectified)),
            near_px,
            torch.get_num_threads(),
        )
        disparity, found = (torch.from_numpy(values).to(points.device) for values in results)
        return disparity, found
    disparity = torch.zeros(len(points), device=points.device)
    found = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for b, rows, looks in views.look_in_parts(along, ptr, rectified, _ROWS_AT_ONCE):
        span = int(first[b]), int(count[b])
        disparity[rows], found[rows] = _search(looks, points[rows], across[rows], predicted[rows], *span, near_px)
    return disparity, found


def _search(
    looks: list[Sampler], points: Tensor, across: Tensor, predicted: Tensor, first: int, count: int, near_px: float
) -> tuple[Tensor, Tensor]:
    windows = looks[0].windows(points, RADIUS_PX)
    kernels = window_kernels(windows)[..., :NUM_WHOLE]
    lowest = torch.full_like(across, first)
    strips, outside = search_line(looks[1], points, across, lowest, count, reverse=True)
    cost, _, _ = compare_windows(windows, strips, kernels, has_tight=True)
    cost = cost.flip(1)[..., [LIKE, TIGHT]].mean(2)
    disparity = first + torch.arange(count, device=cost.device, dtype=cost.dtype)
    near = ((disparity[:, None] - predicted[:, None]).abs() <= near_px).any(2)
    allowed = near & ~outside.flip(1)
    k = cost.masked_fill(~allowed, _NOWHERE).argmin(1, keepdim=True).clamp(1, count - 2)
    return disparity[k[:, 0]] + parabola_offset(cost.exp(), k).clamp(-0.5, 0.5), allowed.any(1)
