"""Operator for the signed lengths of dual Voronoi edges, with its gradient."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from tensor_stereo.ops import reference_soft
from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator, refuse_second_derivative


def _fake_backward(points: Tensor, *_: object) -> Tensor:
    return torch.empty_like(points)


@operator(_fake_backward, backward=refuse_second_derivative)
def dual_edge_ratio_backward(
    points: Tensor, links: Tensor, critical: Tensor, link_ptr: Tensor, gradient: Tensor, bound: float, backend: str
) -> Tensor:
    """Gradient of ``points`` from that of :func:`dual_edge_ratio`; not differentiable again.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.0, 1.0]], dtype=torch.float64)
        >>> links, critical, ptr = torch.tensor([[0, 1]]), torch.tensor([[-1, 2]]), torch.tensor([0, 1])
        >>> dual_edge_ratio_backward(points, links, critical, ptr, torch.ones(1).double(), 9.0, "auto")[2]
        tensor([0.0000, 0.5000], dtype=torch.float64)
    """
    kernels = native(backend)
    if kernels is None:
        return reference_soft.dual_edge_ratio_backward(points, links, critical, gradient, bound)
    arrays = (t.contiguous().numpy(force=True) for t in (points, links, critical, link_ptr, gradient))
    result = kernels.dual_edge_ratio_backward(*arrays, bound, torch.get_num_threads())
    return torch.from_numpy(result).to(points.device)


def _fake(points: Tensor, links: Tensor, *_: object) -> Tensor:
    return points.new_empty(links.shape[0])


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:  # noqa: ARG001  # named by torch
    points, links, critical, link_ptr, ctx.bound, ctx.backend = inputs
    ctx.save_for_backward(points, links, critical, link_ptr)


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    points, links, critical, link_ptr = ctx.saved_tensors
    result = dual_edge_ratio_backward(points, links, critical, link_ptr, gradient, ctx.bound, ctx.backend)
    return result, None, None, None, None, None


@operator(_fake, backward=_backward, setup_context=_setup_context)
def dual_edge_ratio(
    points: Tensor, links: Tensor, critical: Tensor, link_ptr: Tensor, bound: float, backend: str
) -> Tensor:
    """Signed length of the dual Voronoi edge of each link, in lengths of the link.

    Args:
        points: (M, 2) float64 px.
        links: (E, 2) int64 rows of two distinct points.
        critical: (E, 2) int64 rows of the points that bound the dual edge on both sides; -1: none, -2: blocked.
        link_ptr: (K + 1,) int64 offsets of ranges of links that share no point; ranges may run in parallel.
        bound: number of link lengths from the midpoint of the link at which each end is clipped; a blocked link has -2
            ``bound``.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        (E,) float64. Gradients flow to the four points of each link, through the ends that are not clipped; they are
        finite, and not differentiable again.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.0, 1.0], [1.0, -1.0]], dtype=torch.float64)
        >>> links, critical = torch.tensor([[0, 1], [0, 1]]), torch.tensor([[-1, 2], [3, 2]])
        >>> dual_edge_ratio(points, links, critical, torch.tensor([0, 2]), 9.0, "auto")
        tensor([9., 0.], dtype=torch.float64)
    """
    kernels = native(backend)
    if kernels is None:
        return reference_soft.dual_edge_ratio(points, links, critical, bound)
    arrays = (t.contiguous().numpy(force=True) for t in (points, links, critical, link_ptr))
    return torch.from_numpy(kernels.dual_edge_ratio(*arrays, bound, torch.get_num_threads())).to(points.device)
