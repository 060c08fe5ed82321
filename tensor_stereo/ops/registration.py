"""How a Python function becomes an operator of ``torch.library``."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad

P = ParamSpec("P")
R = TypeVar("R")


def operator(
    fake: Callable[..., Any],
    *,
    backward: Callable[..., Any] | None = None,
    setup_context: Callable[..., Any] | None = None,
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Register a function on plain tensors under its own name in the namespace ``tensor_stereo``.

    The registered operator stands behind ``torch.ops.tensor_stereo``; it is what compilers and tensor subclasses see.
    Eager calls on plain tensors go straight to the function, which spares them the dispatcher: 0.1 ms a call.

    Args:
        fake: makes empty results of the right shape from the same positional arguments; those that no shape depends on
            may be swallowed by ``*_``.
        backward: gradient of the arguments from (context, gradient of the results), as ``register_autograd`` takes it.
            An operator with a gradient always goes through the dispatcher.
        setup_context: fills the context from (context, arguments, results).
    """

    def register(function: Callable[P, R]) -> Callable[P, R]:
        registered = torch.library.custom_op(f"tensor_stereo::{function.__name__}", function, mutates_args=())
        registered.register_fake(fake)
        if backward is not None:
            registered.register_autograd(backward, setup_context=setup_context)

        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            plain = all(type(value) is Tensor or not isinstance(value, Tensor) for value in args)
            if backward is not None or torch.compiler.is_compiling() or not plain or kwargs:
                result: R = registered(*args, **kwargs)
                return result
            return function(*args, **kwargs)

        return call

    return register


def refuse_second_derivative(*_: Any) -> None:
    """The backward of an operator that is itself one; without it a second derivative would be zero in silence."""
    raise NotImplementedError("soft counts and dual edge lengths are not differentiable twice")


def refuse_tangent(name: str, values: Tensor, score: str) -> None:
    """Raise for a tensor of forward mode, of which no operator knows the tangent: it would be lost in silence."""
    if torch.compiler.is_compiling():
        return
    if forward_ad.unpack_dual(values).tangent is not None:  # type: ignore[no-untyped-call]
        raise NotImplementedError(f"{name} carries a tangent, but the {score} score has no forward mode")
