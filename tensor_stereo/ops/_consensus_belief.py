"""Operator for the belief in matches that agree with the displacement of their neighbours, with its gradient."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from tensor_stereo.ops import reference_consensus
from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator

_DIFFERENTIABLE = (0, 1, 3, 4)  # positions of keypoints0, keypoints1, cost and row_offset
_NUM_TENSORS, _NUM_ARGUMENTS = 10, 20


def _fake(keypoints0: Tensor, *_: object) -> Tensor:
    return keypoints0.new_empty(keypoints0.shape[0], dtype=torch.float64)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:  # noqa: ARG001  # named by torch
    ctx.save_for_backward(*inputs[:_NUM_TENSORS])
    ctx.settings = inputs[_NUM_TENSORS:-1]


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    """Repeats the rounds in plain torch, which keeps no intermediate result between forward and backward."""
    wanted = [k for k in _DIFFERENTIABLE if ctx.needs_input_grad[k]]
    twice = torch.is_grad_enabled()
    with torch.enable_grad():
        arguments = list(ctx.saved_tensors)
        for k in wanted:  # aliases, so that the second pass ends here
            arguments[k] = arguments[k].view_as(arguments[k])
        belief = reference_consensus.consensus_belief(*arguments, *ctx.settings)
        if not belief.requires_grad:  # no round, no row offset and no cost: a constant
            return (None,) * _NUM_ARGUMENTS
        found = torch.autograd.grad(
            belief, [arguments[k] for k in wanted], gradient, create_graph=twice, materialize_grads=True
        )
    results: list[Tensor | None] = [None] * _NUM_ARGUMENTS
    for k, result in zip(wanted, found, strict=True):
        results[k] = result
    return tuple(results)


@operator(_fake, backward=_backward, setup_context=_setup_context)
def consensus_belief(
    keypoints0: Tensor,
    keypoints1: Tensor,
    ptr: Tensor,
    cost: Tensor | None,
    row_offset: Tensor | None,
    found1: Tensor | None,
    crow0: Tensor,
    cols0: Tensor,
    crow1: Tensor,
    cols1: Tensor,
    tolerance_px: float,
    whole_tolerance_px: float,
    row_tolerance_px: float,
    whole_row_tolerance_px: float,
    slope: float,
    reach: float,
    doubt: float,
    cost_weight: float,
    num_rounds: int,
    backend: str,
) -> Tensor:
    """How likely every match is right, by what its believed neighbours in both views predict.

    The sums of both back ends run in the same order.

    Args:
        keypoints0: (M, 2) float32 or float64 px of view 0.
        keypoints1: (M, 2) float32 or float64 px of view 1.
        ptr: (B + 1,) int64 offsets of the pairs.
        cost: (M,) floating point, or None. In a pair with negative costs, costs count from the lowest one. In a pair
            with a cost beyond 1e300, costs are no evidence.
        row_offset: (M,) float64 px, how far each match lies off its row; None: that is no evidence.
        found1: (M, 2) px of view 1 as the keypoints were found, which may lie on whole pixels; None: ``keypoints1``. A
            constant.
        crow0: (M + 1,) int64 row offsets of the graph of view 0.
        cols0: (nnz0,) int64 neighbours, of the same pair and distinct from the match in view 0.
        crow1: (M + 1,) int64 row offsets of the graph of view 1.
        cols1: (nnz1,) int64 neighbours in view 1.
        tolerance_px: setting of :class:`tensor_stereo.configs.ConsensusConfig`, like all that follow.
        whole_tolerance_px: tolerance for keypoints on whole pixels.
        row_tolerance_px: tolerance of row offsets.
        whole_row_tolerance_px: tolerance of row offsets for keypoints on whole pixels.
        slope: expected slope of the displacement in px/px.
        reach: distance in edge lengths at which the vote of a neighbour counts half.
        doubt: votes against every match.
        cost_weight: log-odds per standard deviation of the cost.
        num_rounds: number of rounds; 0 gives the beliefs without neighbours.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        (M,) float64 in [0, 1). Gradients flow to both point sets, the cost and the row offset. The backward pass
        runs plain torch again under either back end, so that gradients can be differentiated again.

    Example:
        >>> points, ptr, crow = torch.tensor([[0.0, 0.0], [9.0, 0.0]]), torch.tensor([0, 2]), torch.tensor([0, 1, 2])
        >>> graphs, settings = (crow, torch.tensor([1, 0])) * 2, (0.6, 1.0, 0.25, 1.5, 0.2, 2.0, 1.0, 0.5, 1)
        >>> consensus_belief(points, points, ptr, None, None, None, *graphs, *settings, "auto")
        tensor([0.4444, 0.4444], dtype=torch.float64)
    """
    tolerances = tolerance_px, whole_tolerance_px, row_tolerance_px, whole_row_tolerance_px
    settings: tuple[Any, ...] = (*tolerances, slope, reach, doubt, cost_weight, num_rounds)
    graphs = crow0, cols0, crow1, cols1
    kernels = native(backend)
    if kernels is None:
        return reference_consensus.consensus_belief(
            keypoints0, keypoints1, ptr, cost, row_offset, found1, *graphs, *settings
        )
    result = kernels.consensus_belief(
        *(_to_float64(keypoints) for keypoints in (keypoints0, keypoints1)),
        ptr.contiguous().numpy(force=True),
        *(None if values is None else _to_float64(values) for values in (cost, row_offset, found1)),
        *(tensor.contiguous().numpy(force=True) for tensor in graphs),
        *settings,
        torch.get_num_threads(),
    )
    return torch.from_numpy(result).to(keypoints0.device)


def _to_float64(values: Tensor) -> Any:
    return values.detach().to("cpu", torch.float64).contiguous().numpy()
