"""Operator that intersects the rows of two sparse patterns."""

from __future__ import annotations

import torch
from torch import Tensor

from tensor_stereo.ops import reference
from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator


def _fake(crow0: Tensor, *_: object) -> tuple[Tensor, Tensor, Tensor]:
    num_rows = crow0.shape[0] - 1
    return crow0.new_empty(num_rows), crow0.new_empty(num_rows), crow0.new_empty(num_rows)


@operator(_fake)
def row_overlap(
    crow0: Tensor, cols0: Tensor, crow1: Tensor, cols1: Tensor, backend: str
) -> tuple[Tensor, Tensor, Tensor]:
    """How many columns the rows of two patterns share, and how many each has.

    Args:
        crow0: (M + 1,) int64 row offsets.
        cols0: (nnz0,) int64 columns, ascending within a row.
        crow1: (M + 1,) int64 row offsets of the second pattern.
        cols1: (nnz1,) int64 columns of the second pattern, ascending within a row.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        overlap, degree0 and degree1, (M,) int64. No gradient.

    Example:
        >>> crow = torch.tensor([0, 2, 3])
        >>> row_overlap(crow, torch.tensor([0, 1, 1]), crow, torch.tensor([1, 2, 0]), "auto")[0]
        tensor([1, 0])
    """
    kernels = native(backend)
    if kernels is None:
        return reference.row_overlap(crow0, cols0, crow1, cols1)
    arrays = (t.numpy(force=True) for t in (crow0, cols0, crow1, cols1))
    results = kernels.row_overlap(*arrays, torch.get_num_threads())
    overlap, degree0, degree1 = (torch.from_numpy(values).to(crow0.device) for values in results)
    return overlap, degree0, degree1
