"""Operator that finds nearest neighbours by SSD, among the keypoints inside a gate or among all."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tensor_stereo.configs import MatchingConfig
from tensor_stereo.ops import reference_ssd
from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator
from tensor_stereo.types import Features


def _fake(keypoints0: Tensor, keypoints1: Tensor, *_: object) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    num0, num1 = keypoints0.shape[0], keypoints1.shape[0]
    cost = keypoints0.new_empty(num0, dtype=torch.float32)
    cost1 = keypoints0.new_empty(num1, dtype=torch.float32)
    index, index1 = (keypoints0.new_empty(n, dtype=torch.int64) for n in (num0, num1))
    return cost, index, torch.empty_like(cost), cost1, index1


@operator(_fake)
def nearest_ssd(
    keypoints0: Tensor,
    keypoints1: Tensor,
    descriptors0: Tensor,
    descriptors1: Tensor,
    ptr0: Tensor,
    ptr1: Tensor,
    max_row_offset_px: float,
    min_disparity_px: float,
    max_disparity_px: float,
    backend: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Nearest neighbours by sum of squared differences; of equal costs the lowest index counts.

    Candidates of keypoint i are the keypoints j of the partner image with y1 within y0 +- ``max_row_offset_px`` and x1
    between x0 - ``max_disparity_px`` and x0 - ``min_disparity_px``, in float64, bounds included. With
    all gates open every keypoint is one, and keypoints need not be finite. Descriptors on another device than the CPU
    are then compared there, by the reference; otherwise the work is done on the CPU.

    Args:
        keypoints0: (N0, 2) px of view 0, finite unless all gates are open.
        keypoints1: (N1, 2) px of view 1, likewise.
        descriptors0: (N0, D) float32, finite and at most 2**50 in magnitude.
        descriptors1: (N1, D) float32, likewise.
        ptr0: (B + 1,) int64 offsets of the images of view 0.
        ptr1: (B + 1,) int64 offsets of the images of view 1.
        max_row_offset_px: largest row offset; infinity opens the gate.
        min_disparity_px: smallest disparity; minus infinity opens the gate.
        max_disparity_px: largest disparity; infinity opens the gate.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        cost (N0,) float32, index (N0,) int64 rows of view 1, cost of the second-best candidate (N0,) float32, and seen
        from view 1: cost (N1,), index (N1,). Without a candidate infinity and -1. No gradient.

    Example:
        >>> points, ptr = torch.tensor([[9.0, 4.0], [5.0, 4.0]]), torch.tensor([0, 2])
        >>> windows = torch.tensor([[1.0], [7.0]])
        >>> nearest_ssd(points, points - 2, windows, windows, ptr, ptr, 2.0, 0.0, 3.0, "auto")[1]
        tensor([0, 1])
    """
    kernels = native(backend)
    gates = (max_row_offset_px, min_disparity_px, max_disparity_px)
    if any(math.isnan(gate) for gate in gates):
        raise ValueError(f"max_row_offset_px, min_disparity_px and max_disparity_px must not be NaN, got {gates}")
    is_open = reference_ssd.is_open(*gates)
    for name, descriptors in (("features0", descriptors0), ("features1", descriptors1)):
        reference_ssd.check_descriptors(name, descriptors)
    if kernels is None or (is_open and descriptors0.device.type != "cpu"):
        config = MatchingConfig(
            max_row_offset_px=max_row_offset_px, min_disparity_px=min_disparity_px, max_disparity_px=max_disparity_px
        )
        views = ((keypoints0, ptr0, descriptors0), (keypoints1, ptr1, descriptors1))
        features0, features1 = (Features(points, ptr, vectors, points[:, 0]) for points, ptr, vectors in views)
        return reference_ssd.nearest_ssd(features0, features1, config)  # type: ignore[return-value]
    for name, points in (("features0", keypoints0), ("features1", keypoints1)):
        if not is_open:
            reference_ssd.check_coordinates(name, points)
    results = kernels.nearest_ssd(
        *(p.detach().to("cpu", torch.float64).contiguous().numpy() for p in (keypoints0, keypoints1)),
        *(d.detach().to("cpu", torch.float32).contiguous().numpy() for d in (descriptors0, descriptors1)),
        *(ptr.numpy(force=True) for ptr in (ptr0, ptr1)),
        max_row_offset_px,
        min_disparity_px,
        max_disparity_px,
        torch.get_num_threads(),
    )
    cost, index, second_cost, cost1, index1 = (torch.from_numpy(values).to(keypoints0.device) for values in results)
    return cost, index, second_cost, cost1, index1
