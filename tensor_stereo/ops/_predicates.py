"""Operators for the exact signs of orientation and in-circle."""

from __future__ import annotations

import torch
from torch import Tensor

from tensor_stereo.delaunay import predicates
from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator
from tensor_stereo.types import check_points, check_rows


def _fake(a: Tensor, *_: object) -> Tensor:
    return a.new_empty(a.shape[0], dtype=torch.int8)


@operator(_fake)
def orientation(a: Tensor, b: Tensor, c: Tensor, backend: str) -> Tensor:
    """Exact turn of the path a, b, c; see :func:`tensor_stereo.delaunay.predicates.orientation`.

    Args:
        a: (K, 2) float64, 0 or 1e-60..1e60 in magnitude.
        b: (K, 2).
        c: (K, 2).
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        (K,) int8: 1 counter-clockwise with y upwards, -1 clockwise, 0 collinear. No gradient.

    Example:
        >>> a, b, c = torch.tensor([[[0.0, 0.0]], [[1.0, 0.0]], [[0.0, 1.0]]], dtype=torch.float64)
        >>> orientation(a, b, c, "auto")
        tensor([1], dtype=torch.int8)
    """
    return _signs("orientation", (a, b, c), backend)


@operator(_fake)
def incircle(a: Tensor, b: Tensor, c: Tensor, d: Tensor, backend: str) -> Tensor:
    """Exact side of the circle through a, b, c; see :func:`tensor_stereo.delaunay.predicates.incircle`.

    Args:
        a: (K, 2) float64, 0 or 1e-60..1e60 in magnitude; a, b, c counter-clockwise.
        b: (K, 2).
        c: (K, 2).
        d: (K, 2).
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        (K,) int8: 1 if d lies strictly inside, -1 strictly outside, 0 on the circle. No gradient.

    Example:
        >>> square = torch.tensor([[[0.0, 0.0]], [[1.0, 0.0]], [[1.0, 1.0]], [[0.0, 1.0]]], dtype=torch.float64)
        >>> incircle(*square, "auto")
        tensor([0], dtype=torch.int8)
    """
    return _signs("incircle", (a, b, c, d), backend)


def _signs(name: str, points: tuple[Tensor, ...], backend: str) -> Tensor:
    for letter, values in zip("abcd", points, strict=False):
        check_points(letter, values)
        check_rows(letter, values, len(points[0]))
        if values.dtype != torch.float64:
            raise TypeError(f"{letter} must be float64, got {values.dtype}")
    arrays = [values.contiguous().numpy(force=True) for values in points]
    signs = getattr(native(backend) or predicates, name)(*arrays)
    return torch.from_numpy(signs).to(points[0].device)
