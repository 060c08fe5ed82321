"""Operator that moves matches to where the windows of both views fit best, to a fraction of a pixel."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator
from tensor_stereo.ops.samplers import Sampler, Views
from tensor_stereo.ops.windows import NOISE_VARIANCE, RADIUS_PX, TIGHT, window_kernels

_STEPS = 4
_STEP_PX = 0.5  # the longest
_APART_PX = 0.25  # of the samples that give the slope of the grey levels
_DAMPING = 1.0  # grey levels squared per px squared; flat windows stay
_NUM_PIXELS = 40.0  # that tell independently, of a window
_ROWS_AT_ONCE = 512


def _fake(*args: Any) -> tuple[Tensor, Tensor, Tensor]:
    left = args[5]
    along, across, variance = (left.new_empty(left.shape[0], dtype=torch.float32) for _ in range(3))
    return along, across, variance


@operator(_fake)
def window_refine(
    images0: list[Tensor],
    images1: list[Tensor],
    known1: list[Tensor],
    origin: Tensor,
    brighter: Tensor,
    left: Tensor,
    right: Tensor,
    along: Tensor,
    off_line: Tensor,
    slope: Tensor,
    ptr: Tensor,
    rectified: Tensor,
    max_shift_px: float,
    backend: str,
) -> tuple[Tensor, Tensor, Tensor]:
    """Minimise the zero-mean SSD of windows half-way along the slope in either view by Gauss-Newton steps on the lines.

    Args:
        images0: B images, as for :func:`tensor_stereo.ops.window_evidence`, low-pass filtered; so are the next four.
        images1: Their partners.
        known1: Maps of the places that view 1 has seen.
        origin: (B, 2) float32 px.
        brighter: (B,) float32 grey levels.
        left: (M, 2) float32 px of view 0.
        right: (M, 2) float32 px of view 1, of view 0 where a pair is not rectified.
        along: (M, 2) float32 unit vectors along the epipolar lines.
        off_line: (M,) float32 px, how far the partner lies from its line, across it.
        slope: (M, 2) float32 px/px of the disparity, along and across the line.
        ptr: (B + 1,) int64 offsets of the pairs.
        rectified: (B,) bool, whether the lines are rows.
        max_shift_px: No match moves farther.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        (M,) float32 px along and across the lines, 0 where a match would fit worse, and the variance of the first. No
        gradient.
    """
    kernels = native(backend)
    views = Views(images0, images1, known1, origin, brighter)
    if kernels is not None:
        results = kernels.window_refine(
            *views.to_numpy(),
            *(given.float().contiguous().numpy(force=True) for given in (left, right, along, off_line, slope)),
            *(given.numpy(force=True) for given in (ptr, rectified)),
            max_shift_px,
            torch.get_num_threads(),
        )
        shift, across, variance = (torch.from_numpy(values).to(left.device) for values in results)
        return shift, across, variance
    found = [torch.zeros(len(left), device=left.device) for _ in range(3)]
    for _, rows, looks in views.look_in_parts(along, ptr, rectified, _ROWS_AT_ONCE):
        parts = _minimise(looks, left[rows], right[rows], off_line[rows], slope[rows], max_shift_px)
        for whole, part in zip(found, parts, strict=True):
            whole[rows] = part
    return found[0], found[1], found[2]


def _minimise(
    looks: list[Sampler], left: Tensor, right: Tensor, off_line: Tensor, slope: Tensor, max_shift_px: float
) -> tuple[Tensor, Tensor, Tensor]:
    half = slope / 2
    windows = looks[0].slanted(left, RADIUS_PX, half)
    kernel = window_kernels(windows)[..., TIGHT].reshape_as(windows)

    def differ(along: Tensor, across: Tensor) -> Tensor:
        difference = windows - looks[1].slanted(looks[1].place(right, along, across), RADIUS_PX, -half)
        return difference - (kernel * difference).sum((1, 2), keepdim=True)

    def cost(along: Tensor, across: Tensor) -> Tensor:
        return (kernel * differ(along, across).square()).sum((1, 2))

    still = torch.zeros_like(off_line)
    across = torch.where(off_line.abs() <= max_shift_px, -off_line, 0)
    limit = (max_shift_px**2 - across.square()).clamp(min=0).sqrt()
    along, bend = still, still
    for _ in range(_STEPS):
        ahead, back = (differ(along + step, across) for step in (_APART_PX, -_APART_PX))
        steep = (back - ahead) / (2 * _APART_PX)
        bend = (kernel * steep.square()).sum((1, 2))
        step = (kernel * steep * differ(along, across)).sum((1, 2)) / (bend + _DAMPING)
        along = (along + step.clamp(-_STEP_PX, _STEP_PX)).clamp(-limit, limit)
    before, after = cost(still, still), cost(along, across)
    better = after <= before
    variance = (after + NOISE_VARIANCE) / (bend + 1e-3) / _NUM_PIXELS
    return torch.where(better, along, 0), torch.where(better, across, 0), variance
