"""Operator that counts the neighbours that move as a match does."""

from __future__ import annotations

import torch
from torch import Tensor

from tensor_stereo.ops import reference
from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator


def _fake(keypoints0: Tensor, keypoints1: Tensor, crow0: Tensor, *_: object) -> Tensor:  # noqa: ARG001  # named by torch
    return crow0.new_empty(keypoints0.shape[0])


@operator(_fake)
def agreeing_neighbors(
    keypoints0: Tensor,
    keypoints1: Tensor,
    crow0: Tensor,
    cols0: Tensor,
    crow1: Tensor,
    cols1: Tensor,
    row_px: float,
    disparity_px: float,
    slope: float,
    spread: float,
    backend: str,
) -> Tensor:
    """How many neighbours of every match agree with it, whatever shift all matches share.

    Args:
        keypoints0: (M, 2) float32 or float64 px of view 0.
        keypoints1: (M, 2) px of view 1.
        crow0: (M + 1,) int64 row offsets of the graph of view 0.
        cols0: (nnz0,) int64 neighbours.
        crow1: (M + 1,) int64 row offsets of the graph of view 1.
        cols1: (nnz1,) int64 neighbours in view 1.
        row_px: Largest difference of the row offsets y1 - y0 of two matches that agree.
        disparity_px: Largest difference of their disparities,
        slope: and what is added to it per px between their columns in view 0.
        spread: What is added to both per px between their columns and per px between their rows.
        backend: a name of :mod:`tensor_stereo.ops.backends`; both give the same.

    Returns:
        (M,) int64, a neighbour in both views counts twice. No gradient.

    Example:
        >>> points, graph = torch.tensor([[0.0, 0.0], [9.0, 0.0]]), (torch.tensor([0, 1, 2]), torch.tensor([1, 0]))
        >>> agreeing_neighbors(points, points, *graph, *graph, 1.0, 2.0, 0.2, 0.0, "auto")
        tensor([2, 2])
    """
    graphs = crow0, cols0, crow1, cols1
    kernels = native(backend)
    if kernels is None:
        return reference.agreeing_neighbors(keypoints0, keypoints1, *graphs, row_px, disparity_px, slope, spread)
    points = (view.detach().to("cpu", torch.float64).contiguous().numpy() for view in (keypoints0, keypoints1))
    patterns = (tensor.contiguous().numpy(force=True) for tensor in graphs)
    count = kernels.agreeing_neighbors(*points, *patterns, row_px, disparity_px, slope, spread, torch.get_num_threads())
    return torch.from_numpy(count).to(crow0.device)
