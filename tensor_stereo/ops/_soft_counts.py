"""Operator for the soft sizes of the neighbour sets of matches, with its gradient."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from tensor_stereo.ops import reference_soft
from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator, refuse_second_derivative

_NUM_TENSORS = 9  # points0 ... temperature, the first arguments of both operators


def _fake_backward(*arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    points0, points1, *_, temperature = arguments[:_NUM_TENSORS]
    return torch.empty_like(points0), torch.empty_like(points1), torch.empty_like(temperature)


@operator(_fake_backward, backward=refuse_second_derivative)
def soft_counts_backward(
    points0: Tensor,
    points1: Tensor,
    links: Tensor,
    critical0: Tensor,
    critical1: Tensor,
    is_edge0: Tensor,
    is_edge1: Tensor,
    link_ptr: Tensor,
    temperature: Tensor,
    gradient: Tensor,
    saturation: float,
    in_px: bool,
    bound: float,
    backend: str,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of both point sets and the temperature from that of :func:`soft_counts`; not differentiable again.

    Example:
        >>> points, ptr = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.0, 2.0]]).double(), torch.tensor([0, 1])
        >>> links, critical, edge = torch.tensor([[0, 1]]), torch.tensor([[-1, 2]]), torch.tensor([True])
        >>> views = (points, points, links, critical, critical, edge, edge, ptr, torch.ones(()).double())
        >>> soft_counts_backward(*views, torch.ones(3, 3).double(), 40.0, False, 1.0, "auto")[0].shape
        torch.Size([3, 2])
    """
    views = points0, points1, links, critical0, critical1, is_edge0, is_edge1
    kernels = native(backend)
    if kernels is None:
        return reference_soft.soft_counts_backward(*views, temperature, gradient, saturation, in_px, bound)
    of_points0, of_points1, of_temperature = kernels.soft_counts_backward(
        *_arrays(*views, link_ptr, gradient), temperature.item(), saturation, in_px, bound, torch.get_num_threads()
    )
    results = (torch.from_numpy(of_points).to(points0.device) for of_points in (of_points0, of_points1))
    return *results, torch.full_like(temperature, of_temperature)  # type: ignore[return-value]


def _fake(points0: Tensor, *_: object) -> Tensor:
    return points0.new_empty(points0.shape[0], 3)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:  # noqa: ARG001  # named by torch
    ctx.save_for_backward(*inputs[:_NUM_TENSORS])
    ctx.settings = inputs[_NUM_TENSORS:]


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    arguments = (*ctx.saved_tensors, gradient, *ctx.settings)
    of_points0, of_points1, of_temperature = soft_counts_backward(*arguments)
    return of_points0, of_points1, None, None, None, None, None, None, of_temperature, None, None, None, None


@operator(_fake, backward=_backward, setup_context=_setup_context)
def soft_counts(
    points0: Tensor,
    points1: Tensor,
    links: Tensor,
    critical0: Tensor,
    critical1: Tensor,
    is_edge0: Tensor,
    is_edge1: Tensor,
    link_ptr: Tensor,
    temperature: Tensor,
    saturation: float,
    in_px: bool,
    bound: float,
    backend: str,
) -> Tensor:
    """Sums over the links of each match of min(a0, a1), a0 and a1, its soft adjacencies in both views.

    This is what :func:`tensor_stereo.soft.soft_adjacency` in both views and
    :func:`tensor_stereo.soft.sum_soft_adjacency` compute together.

    Args:
        points0: (M, 2) float64 px of view 0.
        points1: (M, 2) float64 px of view 1.
        links: (E, 2) int64 rows of the matches that each link joins.
        critical0: (E, 2) int64 rows that bound the dual edges in view 0, from
            :func:`tensor_stereo.ops.soft_match_graphs`.
        critical1: (E, 2) int64 rows of the same for view 1.
        is_edge0: (E,) bool, whether each link is an edge of the graph of view 0.
        is_edge1: (E,) bool, the same for view 1.
        link_ptr: (K + 1,) int64 offsets of ranges of links that share no match; ranges may run in parallel.
        temperature: () float64, positive.
        saturation: |dual length / temperature| beyond which an adjacency is constant.
        in_px: whether the temperature is in px, not in lengths of the link.
        bound: number of link lengths from the midpoint of the link at which each end of its dual edge is clipped.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        (M, 3) float64. Gradients flow to both point sets and the temperature; they are finite, and not differentiable
        again.

    Example:
        >>> points, ptr = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.0, 1.0]]).double(), torch.tensor([0, 1])
        >>> links, critical, edge = torch.tensor([[0, 1]]), torch.tensor([[-1, 2]]), torch.tensor([True])
        >>> views = (points, points, links, critical, critical, edge, edge, ptr, torch.ones(()).double())
        >>> soft_counts(*views, 40.0, False, 100.0, "auto")[:, 0]
        tensor([1., 1., 0.], dtype=torch.float64)
    """
    views = points0, points1, links, critical0, critical1, is_edge0, is_edge1
    kernels = native(backend)
    if kernels is None:
        return reference_soft.soft_counts(*views, temperature, saturation, in_px, bound)
    counts = kernels.soft_counts(
        *_arrays(*views, link_ptr), temperature.item(), saturation, in_px, bound, torch.get_num_threads()
    )
    return torch.from_numpy(counts).to(points0.device)


def _arrays(*tensors: Tensor) -> list[Any]:
    return [tensor.contiguous().numpy(force=True) for tensor in tensors]
