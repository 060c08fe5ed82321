"""Two adjacencies over the same matches -> overlap, degrees and :class:`Relation` of every match."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tensor_stereo import ops
from tensor_stereo.configs import Backend, Restriction
from tensor_stereo.types import Adjacency, Relation


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


def relate(overlap: Tensor, degree0: Tensor, degree1: Tensor, tested: Tensor) -> Tensor:
    """Relation of the two neighbour sets of every match, from their sizes.

    Args:
        overlap: (M,) |N0 & N1|.
        degree0: (M,) |N0|.
        degree1: (M,) |N1|.
        tested: (M,) bool; False gives UNTESTED.

    Returns:
        (M,) int8 values of :class:`Relation`.

    Example:
        >>> one = torch.tensor([1, 1, 2, 1])
        >>> relate(one, torch.tensor([1, 1, 3, 2]), torch.tensor([1, 2, 2, 3]), torch.tensor([True] * 4)).tolist()
        [1, 2, 3, 4]
    """
    within0, within1 = overlap == degree0, overlap == degree1
    relation = torch.full_like(overlap, Relation.CONFLICT, dtype=torch.int8)
    relation[within0] = int(Relation.SUBSET)
    relation[within1] = int(Relation.SUPERSET)
    relation[within0 & within1] = int(Relation.EQUAL)
    relation[~tested] = int(Relation.UNTESTED)
    return relation


def is_inlier(relation: Tensor, restriction: Restriction) -> Tensor:
    """Verdict of a restriction.

    Args:
        relation: (M,) values of :class:`Relation`.
        restriction: ``adjacency`` (Restriction 1) accepts EQUAL; ``cardinality`` (Restriction 2) also SUBSET, SUPERSET.

    Returns:
        (M,) bool.

    Raises:
        ValueError: for another restriction.

    Source: Bustos, Vargas & Trujillo, CIARP 2016, section 3.

    Example:
        >>> is_inlier(torch.tensor([0, 1, 2, 3, 4]), "cardinality").tolist()
        [False, True, True, True, False]
    """
    equal = relation == Relation.EQUAL
    if restriction == "adjacency":
        return equal
    if restriction == "cardinality":
        return equal | (relation == Relation.SUBSET) | (relation == Relation.SUPERSET)
    raise ValueError(f"restriction must be 'adjacency' or 'cardinality', got {restriction!r}")
