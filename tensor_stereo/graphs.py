"""Keypoints of a ragged batch -> their Delaunay graphs as one sparse adjacency over the whole batch."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from tensor_stereo import ops
from tensor_stereo.configs import Backend
from tensor_stereo.types import Adjacency, Matches


class MatchGraphs(NamedTuple):
    """The graphs of both views over the rows of one batch of matches."""

    adjacency0: Adjacency
    adjacency1: Adjacency
    group_size: Tensor  # (M,) int64 distinct matches in the same object group, 0 for duplicates, which are no vertices

    @property
    def patterns(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Row offsets and neighbours of view 0, then of view 1, as operators take them."""
        zero, one = self.adjacency0, self.adjacency1
        return zero.crow_indices, zero.col_indices, one.crow_indices, one.col_indices


def build_graphs(
    keypoints: Tensor,
    ptr: Tensor,
    group: Tensor | None = None,
    *,
    tie_tolerance: float = 1e-3,
    backend: Backend = "auto",
) -> Adjacency:
    """Delaunay graph of the keypoints of every image, as one block-diagonal adjacency.

    {i, j} is an edge iff some circle through both points has every other point of the segment strictly outside; the
    graph is unique, also for co-circular points (no diagonals) and collinear ones (a path). A segment is an image, or a
    group within it.

    Args:
        keypoints: (N, 2) float32 or float64, (x, y); 0 or 1e-60..1e60 in magnitude.
        ptr: (B + 1,) int64 offsets of the images.
        group: (N,) integer; points of one image with different values share no edge. None: one group per image.
        tie_tolerance: e in [0, 1), in edge lengths. An edge counts only if its dual Voronoi edge, measured where the
            circle's centre lies within 1 / e edge lengths of the edge's midpoint, is longer than e edge lengths: then
            rounding of the coordinates does not change the graph. 0 gives the exact graph of the given numbers.
        backend: a name of :mod:`tensor_stereo.ops.backends`. All give the same bits.

    Returns:
        The adjacency, on the device of ``keypoints``. Of coincident points the lowest index is a vertex, the others
        have degree 0. No gradient.

    Raises:
        ValueError: for NaN, infinite or out-of-range coordinates (naming pair and row), or bad shapes and options.
        TypeError: for dtypes other than those above.

    Source: Bustos, Vargas & Trujillo, CIARP 2016, section 2; strict graph and tolerance are this library's.

    Example:
        >>> import torch
        >>> square = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        >>> build_graphs(square, torch.tensor([0, 4])).degree
        tensor([2, 2, 2, 2])
    """
    crow, cols = ops.delaunay_graph(keypoints, ptr, group, tie_tolerance, backend)
    return Adjacency(crow, cols, ptr)


def check_match_graphs(matches: Matches, graphs: MatchGraphs) -> None:
    """Raise unless the graphs have as many nodes as there are matches.

    >>> import torch
    >>> points = torch.tensor([[0.0, 0.0], [4.0, 0.0]])
    >>> matches = Matches(points, points, torch.tensor([0, 2]))
    >>> check_match_graphs(matches, build_match_graphs(matches))
    """
    for name in ("adjacency0", "adjacency1"):
        adjacency: Adjacency = getattr(graphs, name)
        if adjacency.num_nodes != matches.num_matches:
            raise ValueError(f"graphs.{name} must have {matches.num_matches} nodes, got {adjacency.num_nodes}")


def build_match_graphs(matches: Matches, *, tie_tolerance: float = 1e-3, backend: Backend = "auto") -> MatchGraphs:
    """Delaunay graphs of both views of every pair, over the rows of ``matches``.

    The method rests on a bijection: per pair, matches are taken in the order (cost, row), or by row without a cost, and
    one is kept iff neither its left nor its right point was taken by a kept one. The others are no vertices.

    Args:
        matches: B pairs; ``group`` splits each pair into objects (Restriction 3).
        tie_tolerance: e in [0, 1), in edge lengths; see :func:`build_graphs`.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        Both adjacencies and the size of each match's group. No gradient.

    Raises:
        ValueError: for NaN or infinite ``keypoints0``, ``keypoints1`` (naming pair and row) or NaN ``cost``.

    Example:
        >>> import torch
        >>> points = torch.tensor([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0], [0.0, 3.0]])
        >>> build_match_graphs(Matches(points, points - 1, torch.tensor([0, 4]))).group_size
        tensor([3, 3, 3, 0])
    """
    crow0, cols0, crow1, cols1, group_size = ops.match_graphs(
        matches.keypoints0, matches.keypoints1, matches.ptr, matches.cost, matches.group, tie_tolerance, backend
    )
    adjacency0, adjacency1 = Adjacency(crow0, cols0, matches.ptr), Adjacency(crow1, cols1, matches.ptr)
    return MatchGraphs(adjacency0, adjacency1, group_size)
