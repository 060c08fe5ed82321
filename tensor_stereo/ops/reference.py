"""The operators in plain torch: the definition of what the compiled kernels compute."""

from __future__ import annotations

import torch
from torch import Tensor

from tensor_stereo.types import Relation


def row_overlap(crow0: Tensor, cols0: Tensor, crow1: Tensor, cols1: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Row sums of A0 AND A1, and of A0 and A1; see :func:`tensor_stereo.ops.row_overlap`.

    torch has no arithmetic on sparse boolean tensors; the AND is a merge of the sorted keys row * M + column.

    Example:
        >>> crow = torch.tensor([0, 2, 3])
        >>> row_overlap(crow, torch.tensor([0, 1, 1]), crow, torch.tensor([1, 2, 0]))[0]
        tensor([1, 0])
    """
    degree0, degree1 = crow0.diff(), crow1.diff()
    if not len(cols0) or not len(cols1):
        return torch.zeros_like(degree0), degree0, degree1
    stride = int(torch.maximum(cols0.max(), cols1.max())) + 1
    keys0, keys1 = (
        torch.repeat_interleave(degree) * stride + cols for degree, cols in ((degree0, cols0), (degree1, cols1))
    )
    position = torch.searchsorted(keys1, keys0).clamp_(max=len(keys1) - 1)
    shared = torch.nn.functional.pad((keys1[position] == keys0).cumsum(0), (1, 0))  # (nnz0 + 1,)
    return shared[crow0].diff(), degree0, degree1


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
) -> Tensor:
    """How many neighbours move as a match does; see :func:`tensor_stereo.ops.agreeing_neighbors`."""
    places, partners = keypoints0.double(), keypoints1.double()
    seen = torch.cat([places, places[:, :1] - partners[:, :1], partners[:, 1:] - places[:, 1:]], 1)
    count = torch.zeros_like(crow0[1:])
    for crow, j in ((crow0, cols0), (crow1, cols1)):
        i = torch.repeat_interleave(crow.diff())
        x, y, disparity, row = (seen.index_select(0, i) - seen.index_select(0, j)).abs_().unbind(1)
        more = spread * (x + y)
        agrees = (row <= row_px + more) & (disparity <= disparity_px + slope * x + more)
        count.index_add_(0, i, agrees.to(count.dtype))
    return count


def relate(
    overlap: Tensor, degree0: Tensor, degree1: Tensor, group_size: Tensor, min_group_size: int, accept_subsets: bool
) -> tuple[Tensor, Tensor]:
    """Relation and verdict from the sizes of neighbour sets; see :func:`tensor_stereo.ops.relate`."""
    within0, within1 = overlap == degree0, overlap == degree1
    relation = torch.full_like(overlap, Relation.CONFLICT, dtype=torch.int8)
    relation[within0] = int(Relation.SUBSET)
    relation[within1] = int(Relation.SUPERSET)
    relation[within0 & within1] = int(Relation.EQUAL)
    # An empty neighbour set is a subset of anything: evidence only where there is nobody else.
    has_evidence = ((degree0 > 0) & (degree1 > 0)) | (group_size == 1)
    relation[(group_size < min_group_size) | (group_size == 0) | ~has_evidence] = int(Relation.UNTESTED)
    last = Relation.SUPERSET if accept_subsets else Relation.EQUAL
    return relation, (relation >= int(Relation.EQUAL)) & (relation <= int(last))
