"""Two adjacencies over the same matches -> the sizes of their neighbour sets."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from tensor_stereo import ops
from tensor_stereo.configs import Backend
from tensor_stereo.types import Adjacency


class NeighborCounts(NamedTuple):
    """Sizes of the neighbour sets of every node, (M,) int64 each."""

    overlap: Tensor  # neighbours in both graphs
    degree0: Tensor
    degree1: Tensor


def shared_neighbors(adjacency0: Adjacency, adjacency1: Adjacency, *, backend: Backend = "auto") -> NeighborCounts:
    """Row sums of A0 AND A1, and of both: how many neighbours each node has, and how many both graphs share.

    Args:
        adjacency0: pattern over M nodes.
        adjacency1: pattern over the same nodes.
        backend: as in :func:`tensor_stereo.build_graphs`.

    Returns:
        overlap, degree0 and degree1, (M,) int64. No gradient.

    Raises:
        ValueError: if the two patterns differ in size.

    Example:
        >>> import torch
        >>> from tensor_stereo.graphs import build_graphs
        >>> ptr = torch.tensor([0, 3])
        >>> triangle = build_graphs(torch.tensor([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]]), ptr)
        >>> path = build_graphs(torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]), ptr)
        >>> shared_neighbors(triangle, path).overlap
        tensor([1, 2, 1])
    """
    if adjacency0.num_nodes != adjacency1.num_nodes:
        sizes = f"{adjacency0.num_nodes} and {adjacency1.num_nodes}"
        raise ValueError(f"adjacency0 and adjacency1 must have the same nodes, got {sizes}")
    (crow0, cols0), (crow1, cols1) = ((a.crow_indices, a.col_indices) for a in (adjacency0, adjacency1))
    return NeighborCounts(*ops.row_overlap(crow0, cols0, crow1, cols1, backend))
