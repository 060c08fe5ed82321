"""Operator that turns the sizes of neighbour sets into relations and verdicts."""

from __future__ import annotations

import torch
from torch import Tensor

from tensor_stereo.ops import reference
from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator


def _fake(overlap: Tensor, *_: object) -> tuple[Tensor, Tensor]:
    return torch.empty_like(overlap, dtype=torch.int8), torch.empty_like(overlap, dtype=torch.bool)


@operator(_fake)
def relate(
    overlap: Tensor,
    degree0: Tensor,
    degree1: Tensor,
    group_size: Tensor,
    min_group_size: int,
    accept_subsets: bool,
    backend: str,
) -> tuple[Tensor, Tensor]:
    """Relation of the two neighbour sets of every match, and the verdict.

    Args:
        overlap: (M,) int64 |N0 & N1|.
        degree0: (M,) int64 |N0|.
        degree1: (M,) int64 |N1|.
        group_size: (M,) int64 distinct matches in the same group, 0 for duplicates.
        min_group_size: groups below it are UNTESTED, as is an empty neighbour set in a group with other matches.
        accept_subsets: whether SUBSET and SUPERSET are inliers besides EQUAL.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        relation (M,) int8 of :class:`tensor_stereo.Relation`, and inlier (M,) bool. No gradient.

    Example:
        >>> one, size = torch.tensor([1, 1, 2, 1]), torch.tensor([9, 9, 9, 9])
        >>> relate(one, torch.tensor([1, 1, 3, 2]), torch.tensor([1, 2, 2, 3]), size, 4, True, "auto")[0].tolist()
        [1, 2, 3, 4]
    """
    kernels = native(backend)
    if kernels is None:
        return reference.relate(overlap, degree0, degree1, group_size, min_group_size, accept_subsets)
    arrays = (t.contiguous().numpy(force=True) for t in (overlap, degree0, degree1, group_size))
    relation, inlier = kernels.relate(*arrays, min_group_size, accept_subsets)
    return torch.from_numpy(relation).to(overlap.device), torch.from_numpy(inlier).to(overlap.device)
