"""Operator for the soft sizes of the neighbour sets of matches, with its gradient."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator, refuse_second_derivative

Gradients = tuple[Tensor, Tensor, Tensor]


def _fake_backward(*arguments: Any) -> Gradients:
    points0, points1, *_, temperature, _, _, _, _ = arguments
    return torch.empty_like(points0), torch.empty_like(points1), torch.empty_like(temperature)


@operator(_fake_backward, backward=refuse_second_derivative)
def soft_counts_backward(
    points0: Tensor,
    points1: Tensor,
    pairs: Tensor,
    critical0: Tensor,
    critical1: Tensor,
    is_edge0: Tensor,
    is_edge1: Tensor,
    pair_ptr: Tensor,
    temperature: Tensor,
    saturation: float,
    in_px: bool,
    bound: float,
    gradient: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of both point sets and the temperature from that of :func:`soft_counts`; not differentiable again.

    Example:
        >>> points, ptr = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.0, 2.0]]).double(), torch.tensor([0, 1])
        >>> pairs, critical, edge = torch.tensor([[0, 1]]), torch.tensor([[-1, 2]]), torch.tensor([True])
        >>> views = (points, points, pairs, critical, critical, edge, edge, ptr, torch.ones(()).double())
        >>> from tensor_stereo.ops import backend
        >>> if backend().name == "native":
        ...     of_points0, _, _ = soft_counts_backward(*views, 40.0, False, 1.0, torch.ones(3, 3).double())
        ...     assert of_points0.shape == (3, 2)
    """
    kernels = native("native")
    arrays = _arrays(points0, points1, pairs, critical0, critical1, is_edge0, is_edge1, pair_ptr, gradient)
    of_points0, of_points1, of_temperature = kernels.soft_counts_backward(  # type: ignore[union-attr]
        *arrays, temperature.detach().item(), saturation, in_px, bound, torch.get_num_threads()
    )
    to = points0.device
    results = torch.from_numpy(of_points0).to(to), torch.from_numpy(of_points1).to(to)
    return *results, torch.full_like(temperature, of_temperature)


def _fake(points0: Tensor, *_: object) -> Tensor:
    return points0.new_empty(points0.shape[0], 3)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:  # noqa: ARG001  # named by torch
    ctx.save_for_backward(*inputs[:9])
    ctx.settings = inputs[9:]


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    arguments = (*ctx.saved_tensors, *ctx.settings, gradient)
    of_points0, of_points1, of_temperature = soft_counts_backward(*arguments)
    return of_points0, of_points1, None, None, None, None, None, None, of_temperature, None, None, None


@operator(_fake, backward=_backward, setup_context=_setup_context)
def soft_counts(
    points0: Tensor,
    points1: Tensor,
    pairs: Tensor,
    critical0: Tensor,
    critical1: Tensor,
    is_edge0: Tensor,
    is_edge1: Tensor,
    pair_ptr: Tensor,
    temperature: Tensor,
    saturation: float,
    in_px: bool,
    bound: float,
) -> Tensor:
    """Sums over the pairs of each match of min(a0, a1), a0 and a1, its soft adjacencies in both views.

    What :func:`tensor_stereo.soft.soft_adjacency` and :func:`tensor_stereo.soft.soft_counts` compute together, in one
    pass and by the native kernels only.

    Args:
        points0: (M, 2) float64 px of view 0.
        points1: (M, 2) float64 px of view 1.
        pairs: (E, 2) int64 rows.
        critical0: (E, 2) int64 rows, as :func:`tensor_stereo.ops._soft_match_graphs` gives them.
        critical1: (E, 2).
        is_edge0: (E,) bool.
        is_edge1: (E,).
        pair_ptr: (B + 1,) int64.
        temperature: () float64, positive.
        saturation: |dual length / temperature| beyond which an adjacency is constant.
        in_px: whether the temperature is in px, not in lengths of the pair.
        bound: each end of a dual edge is clipped to so many lengths of the pair from its midpoint.

    Returns:
        (M, 3) float64. Gradients flow to both point sets and the temperature; they are finite, and not differentiable
        again.

    Example:
        >>> points, ptr = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.0, 1.0]]).double(), torch.tensor([0, 1])
        >>> pairs, critical, edge = torch.tensor([[0, 1]]), torch.tensor([[-1, 2]]), torch.tensor([True])
        >>> views = (points, points, pairs, critical, critical, edge, edge, ptr, torch.ones(()).double())
        >>> from tensor_stereo.ops import backend
        >>> if backend().name == "native":
        ...     assert soft_counts(*views, 40.0, False, 100.0)[:, 0].tolist() == [1.0, 1.0, 0.0]
    """
    kernels = native("native")
    arrays = _arrays(points0, points1, pairs, critical0, critical1, is_edge0, is_edge1, pair_ptr)
    counts = kernels.soft_counts(  # type: ignore[union-attr]
        *arrays, temperature.detach().item(), saturation, in_px, bound, torch.get_num_threads()
    )
    return torch.from_numpy(counts).to(points0.device)


def _arrays(*tensors: Tensor) -> list[Any]:
    return [tensor.contiguous().numpy(force=True) for tensor in tensors]
