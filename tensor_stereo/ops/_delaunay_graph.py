"""Operators that build Delaunay graphs: of one view, and of both views of putative matches."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from tensor_stereo.delaunay.edges import delaunay_edges
from tensor_stereo.delaunay.one_to_one import coincident_ids, first_of_coincident
from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator
from tensor_stereo.ops.segments import (
    Bool,
    Float,
    Int,
    group_size_of,
    one_to_one,
    pair_of,
    segments_of,
    to_points,
    vertices_of,
    views_of,
)
from tensor_stereo.types import check_tie_tolerance

Pattern = tuple[Tensor, Tensor]  # crow (N + 1,), cols (nnz,)


def _fake_pattern(keypoints: Tensor, ptr: Tensor, *_: object) -> Pattern:
    num_entries = torch.library.get_ctx().new_dynamic_size()
    return ptr.new_empty(keypoints.shape[0] + 1), ptr.new_empty(num_entries)


def _fake_match_graphs(
    keypoints0: Tensor, keypoints1: Tensor, ptr: Tensor, *_: object
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    size = ptr.new_empty(keypoints0.shape[0], device=keypoints0.device)
    return (*_fake_pattern(keypoints0, ptr), *_fake_pattern(keypoints1, ptr), size)


@operator(_fake_pattern)
def delaunay_graph(
    keypoints: Tensor, ptr: Tensor, group: Tensor | None, tie_tolerance: float, backend: str
) -> tuple[Tensor, Tensor]:
    """Pattern of the graph of every image; see :func:`tensor_stereo.build_graphs`.

    Args:
        keypoints: (N, 2) float32 or float64.
        ptr: (B + 1,) int64.
        group: (N,) integer or None.
        tie_tolerance: tolerance of the graph in [0, 1), in edge lengths.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        crow (N + 1,) and cols (nnz,) int64. No gradient.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [3.0, 0.0]])
        >>> delaunay_graph(points, torch.tensor([0, 4]), None, 1e-3, "auto")
        (tensor([0, 1, 3, 3, 4]), tensor([1, 0, 3, 1]))
    """
    check_tie_tolerance(tie_tolerance)
    kernels = native(backend)
    points = to_points("keypoints", keypoints, ptr, kernels)
    segment = None if group is None else segments_of(ptr, group, len(points))
    if segment is None and kernels is not None:
        kept = one_to_one([points, points], ptr, None, kernels)
    else:
        kept = first_of_coincident(coincident_ids(points, pair_of(ptr) if segment is None else segment))
    return _build([points], ptr, segment, kept, tie_tolerance, kernels)[0]


@operator(_fake_match_graphs)
def match_graphs(
    keypoints0: Tensor,
    keypoints1: Tensor,
    ptr: Tensor,
    cost: Tensor | None,
    group: Tensor | None,
    tie_tolerance: float,
    backend: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Patterns of both views over the rows of putative matches; see :func:`tensor_stereo.graphs.build_match_graphs`.

    Args:
        keypoints0: (M, 2) float32 or float64.
        keypoints1: (M, 2).
        ptr: (B + 1,) int64.
        cost: (M,) or None.
        group: (M,) integer or None.
        tie_tolerance: tolerance of the graph in [0, 1), in edge lengths.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        crow0, cols0, crow1, cols1 and group_size (M,), int64. No gradient.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [3.0, 0.0]])
        >>> match_graphs(points, points, torch.tensor([0, 4]), None, None, 1e-3, "auto")[-1]
        tensor([3, 3, 0, 3])
    """
    check_tie_tolerance(tie_tolerance)
    kernels = native(backend)
    views, segment, kept = views_of(keypoints0, keypoints1, ptr, cost, group, kernels)
    (crow0, cols0), (crow1, cols1) = _build(views, ptr, segment, kept, tie_tolerance, kernels)
    return crow0, cols0, crow1, cols1, group_size_of(ptr, segment, kept).to(keypoints0.device)


def _build(
    views: list[Float], ptr: Tensor, segment: Int | None, kept: Bool, tie_tolerance: float, kernels: ModuleType | None
) -> list[Pattern]:
    """Patterns of several point sets over the same segments; rows that are not kept are no vertices."""
    vertex, segment_ptr = vertices_of(ptr, segment, kept)
    if kernels is None:
        patterns = build_scipy(views, vertex, segment_ptr, tie_tolerance)
    else:
        settings = vertex, segment_ptr, tie_tolerance, torch.get_num_threads()
        patterns = [kernels.delaunay_graph(points, *settings) for points in views]
    return [(torch.from_numpy(crow).to(ptr.device), torch.from_numpy(cols).to(ptr.device)) for crow, cols in patterns]


def build_scipy(views: list[Float], vertex: Int, segment_ptr: Int, tie_tolerance: float) -> list[tuple[Int, Int]]:
    """Patterns of several point sets; all in one call, so that all threads have work to the end."""
    shift = segment_ptr[-1] * np.arange(len(views))[:, None]
    edges = delaunay_edges(
        np.concatenate([points[vertex] for points in views]) + 0.0,  # -0 becomes 0
        np.concatenate([segment_ptr[:1], (segment_ptr[1:] + shift).reshape(-1)]),
        tie_tolerance=tie_tolerance,
        num_threads=torch.get_num_threads(),
    )
    view = edges[:, 0] // max(len(vertex), 1)
    return [to_pattern(vertex[edges[view == v] - v * len(vertex)], len(views[0])) for v in range(len(views))]


def to_pattern(edges: Int, num_rows: int) -> tuple[Int, Int]:
    """Symmetric pattern (crow, cols) of undirected edges (E, 2)."""
    both = np.concatenate([edges, edges[:, ::-1]])
    rows, cols = np.divmod(np.sort(both[:, 0] * num_rows + both[:, 1]), max(num_rows, 1))
    return np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=num_rows))]), cols
