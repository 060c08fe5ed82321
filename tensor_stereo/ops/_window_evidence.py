"""Operator that holds the windows around both keypoints of matches against the other view."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from tensor_stereo.ops.backends import native
from tensor_stereo.ops.reference_evidence import NUM_CURVES, NUM_VALUES
from tensor_stereo.ops.reference_evidence import window_evidence as reference
from tensor_stereo.ops.registration import operator
from tensor_stereo.ops.samplers import Place, Views


def _fake(*args: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    left, width = args[5], args[16]
    values = left.new_empty(left.shape[0], NUM_VALUES, dtype=torch.float32)
    curve0, curve1 = (values.new_empty(left.shape[0], NUM_CURVES, width) for _ in range(2))
    return values, curve0, curve1, values.new_empty(left.shape[0]), values.new_empty(left.shape[0])


@operator(_fake)
def window_evidence(
    images0: list[Tensor],
    images1: list[Tensor],
    known1: list[Tensor],
    origin: Tensor,
    brighter: Tensor,
    left: Tensor,
    right: Tensor,
    along: Tensor,
    disparity: Tensor,
    across: Tensor,
    slope: Tensor,
    ptr: Tensor,
    first: Tensor,
    count: Tensor,
    has_rows: Tensor,
    rectified: Tensor,
    width: int,
    backend: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Compare windows of either view with those of the other along rows or lines, around the match and along its slope.

    Args:
        images0: B images (H, W), uint8 or float32 grey levels.
        images1: Their partners, in the frame of view 0 where a pair is not rectified.
        known1: B maps (H1, W1) bool of the places that view 1 has seen; anything for rectified pairs.
        origin: (B, 2) float32 px of view 0, where the first pixel of view 1 lies; 0 for rectified pairs.
        brighter: (B,) float32 grey levels by which view 1 is brighter.
        left: (M, 2) float32 px of view 0.
        right: (M, 2) float32 px of view 1, of view 0 where a pair is not rectified.
        along: (M, 2) float32 unit vectors along the epipolar lines.
        disparity: (M,) float32 px.
        across: (M,) float32 px, how far across the keypoint of view 0 its line lies in view 1.
        slope: (M, 2) float32 px/px of the disparity, along and across the line, in the cyclopean frame.
        ptr: (B + 1,) int64 offsets of the pairs.
        first: (B,) int64 px, the least disparity that is searched.
        count: (B,) int64 number of disparities, at most 256; at most 9 where there are no rows.
        has_rows: (B,) bool, whether rows or lines are searched; else a disc of 4 px around each match.
        rectified: (B,) bool, whether the lines are rows.
        width: Disparities of the curves, at least all of ``count``.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        values (M, NUM_VALUES), curve0 and curve1 (M, 2, width), start (M,) and offset (M,), float32, as
        :class:`tensor_stereo.scores.image_evidence.ImageEvidence` describes them. No gradient. Both back ends agree to
        1e-4; the bits do not depend on the processor.
    """
    kernels = native(backend)
    if kernels is None:
        views = Views(images0, images1, known1, origin, brighter)
        places = Place(left, right, along, disparity, across, slope)
        return reference(views, places, ptr, first, count, has_rows, rectified, width)
    values, curve0, curve1, start, offset = kernels.window_evidence(
        *Views(images0, images1, known1, origin, brighter).to_numpy(),
        *(given.float().contiguous().numpy(force=True) for given in (left, right, along, disparity, across, slope)),
        *(given.numpy(force=True) for given in (ptr, first, count, has_rows, rectified)),
        width,
        torch.get_num_threads(),
    )
    found = (torch.from_numpy(x).to(left.device) for x in (values, curve0, curve1, start, offset))
    values, curve0, curve1, start, offset = found
    return values, curve0, curve1, start, offset
