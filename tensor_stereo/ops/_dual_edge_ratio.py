"""Operator for the signed lengths of dual Voronoi edges, with its gradient."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from tensor_stereo.ops import reference
from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator, refuse_second_derivative


def _fake_backward(points: Tensor, *_: object) -> Tensor:
    return torch.empty_like(points)


@operator(_fake_backward, backward=refuse_second_derivative)
def dual_edge_ratio_backward(
    points: Tensor, pairs: Tensor, critical: Tensor, pair_ptr: Tensor, gradient: Tensor, bound: float, backend: str
) -> Tensor:
    """Gradient of ``points`` from that of :func:`dual_edge_ratio`; not differentiable again.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.0, 1.0]], dtype=torch.float64)
        >>> pairs, critical, ptr = torch.tensor([[0, 1]]), torch.tensor([[-1, 2]]), torch.tensor([0, 1])
        >>> dual_edge_ratio_backward(points, pairs, critical, ptr, torch.ones(1).double(), 9.0, "auto")[2]
        tensor([0.0000, 0.5000], dtype=torch.float64)
    """
    kernels = native(backend)
    if kernels is None:
        return reference.dual_edge_ratio_backward(points, pairs, critical, gradient, bound)
    arrays = (t.contiguous().numpy(force=True) for t in (points, pairs, critical, pair_ptr, gradient))
    result = kernels.dual_edge_ratio_backward(*arrays, bound, torch.get_num_threads())
    return torch.from_numpy(result).to(points.device)


def _fake(points: Tensor, pairs: Tensor, *_: object) -> Tensor:
    return points.new_empty(pairs.shape[0])


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:  # noqa: ARG001  # named by torch
    points, pairs, critical, pair_ptr, ctx.bound, ctx.backend = inputs
    ctx.save_for_backward(points, pairs, critical, pair_ptr)


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    points, pairs, critical, pair_ptr = ctx.saved_tensors
    result = dual_edge_ratio_backward(points, pairs, critical, pair_ptr, gradient, ctx.bound, ctx.backend)
    return result, None, None, None, None, None


@operator(_fake, backward=_backward, setup_context=_setup_context)
def dual_edge_ratio(
    points: Tensor, pairs: Tensor, critical: Tensor, pair_ptr: Tensor, bound: float, backend: str
) -> Tensor:
    """Signed length of the dual Voronoi edge of each pair, in lengths of the pair.

    Args:
        points: (M, 2) float64 px.
        pairs: (E, 2) int64 rows of two distinct points.
        critical: (E, 2) int64 rows of the points that bound it on both sides; -1: none, -2: blocked.
        pair_ptr: (K + 1,) int64; ranges of pairs that share no point with each other, which may run in parallel.
        bound: each end is clipped to so many lengths of the pair from its midpoint; a blocked pair has -2 ``bound``.
        backend: ``auto``, ``native`` or ``scipy`` (which here is plain torch).

    Returns:
        (E,) float64. Gradients flow to the four points of each pair, through the ends that are not clipped; they are
        finite, and not differentiable again.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.0, 1.0], [1.0, -1.0]], dtype=torch.float64)
        >>> pairs, critical = torch.tensor([[0, 1], [0, 1]]), torch.tensor([[-1, 2], [3, 2]])
        >>> dual_edge_ratio(points, pairs, critical, torch.tensor([0, 2]), 9.0, "auto")
        tensor([9., 0.], dtype=torch.float64)
    """
    kernels = native(backend)
    if kernels is None:
        return reference.dual_edge_ratio(points, pairs, critical, bound)
    arrays = (t.contiguous().numpy(force=True) for t in (points, pairs, critical, pair_ptr))
    return torch.from_numpy(kernels.dual_edge_ratio(*arrays, bound, torch.get_num_threads())).to(points.device)
