"""Operator that builds the graphs of putative matches and finds all links whose soft adjacency counts."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from tensor_stereo.delaunay.critical import critical_points, limit_reach, soft_links
from tensor_stereo.ops._delaunay_graph import build_scipy
from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator
from tensor_stereo.ops.segments import (
    Bool,
    Float,
    Int,
    group_size_of,
    vertices_of,
    views_of,
)
from tensor_stereo.types import check_tie_tolerance

Found = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def _fake(*arguments: Any) -> Found:
    keypoints0, _, ptr, *_ = arguments
    num_entries0, num_entries1, num_links = (torch.library.get_ctx().new_dynamic_size() for _ in range(3))
    num_rows, num_offsets = keypoints0.shape[0], ptr.shape[0]
    patterns = (num_rows + 1, num_entries0, num_rows + 1, num_entries1)
    crow0, cols0, crow1, cols1 = (ptr.new_empty(size) for size in patterns)
    links, critical0, critical1 = (ptr.new_empty(num_links, 2) for _ in range(3))
    is_edge0, is_edge1 = (ptr.new_empty(num_links, dtype=torch.bool) for _ in range(2))
    group_size, link_ptr = ptr.new_empty(num_rows), ptr.new_empty(num_offsets)
    return crow0, cols0, crow1, cols1, group_size, links, link_ptr, critical0, critical1, is_edge0, is_edge1


@operator(_fake)
def soft_match_graphs(
    keypoints0: Tensor,
    keypoints1: Tensor,
    ptr: Tensor,
    cost: Tensor | None,
    group: Tensor | None,
    reach: Tensor,
    tie_tolerance: float,
    backend: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Graphs of both views, the links whose soft adjacency counts, and the points that bound their dual Voronoi edges.

    The links are, in either view, the edges of the exact graph; the critical points of each edge if their segment
    crosses it, so that an ordinary flip enters and leaves without a jump; and the chords of co-circular polygons with
    at most 16 corners. The time of the native search grows with the number of triangles that the links cross (quadratic
    on a parabola facing a line); without kernels every link is compared with every point.

    Args:
        keypoints0: (M, 2) float32 or float64.
        keypoints1: (M, 2).
        ptr: (B + 1,) int64.
        cost: (M,) or None.
        group: (M,) integer or None.
        reach: (2,) float64 (r, s). Links whose signed dual length is below -(r lengths of the link + s px) are
            blocked: the points that bound them need not be known.
        tie_tolerance: tolerance of the graph in [0, 1), in edge lengths.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        crow0, cols0, crow1, cols1 and group_size (M,) of :func:`tensor_stereo.ops.match_graphs`; links (E, 2) of rows
        i < j; their offsets (B + 1,); critical0 and critical1 (E, 2) rows, right and left of the way from i to j, -1
        where that side is empty, -2 for both where a point lies between or out of reach; is_edge0 and is_edge1 (E,)
        bool. No gradient.

    Example:
        >>> points, ptr = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]]), torch.tensor([0, 4])
        >>> found = soft_match_graphs(points, points, ptr, None, None, torch.tensor([16.0, 0.0]), 1e-3, "auto")
        >>> found[5].tolist(), found[9].tolist()  # both diagonals count, neither is an edge
        ([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]], [True, False, True, True, False, True])
    """
    check_tie_tolerance(tie_tolerance)
    kernels = native(backend)
    edge_lengths, px = reach.tolist()
    views, segment, kept = views_of(keypoints0, keypoints1, ptr, cost, group, kernels)
    vertex, segment_ptr = vertices_of(ptr, segment, kept)
    if kernels is not None:
        threads = torch.get_num_threads()
        found = kernels.soft_match_graphs(*views, vertex, segment_ptr, tie_tolerance, edge_lengths, px, threads)
    else:
        found = _soft_match_graphs(views, vertex, segment_ptr, tie_tolerance, edge_lengths, px)
    (crow0, cols0), (crow1, cols1), links, link_ptr, *rest = found
    link_ptr = _ptr_of_batch(link_ptr, vertex, segment_ptr, ptr)
    group_size = group_size_of(ptr, segment, kept)
    arrays = (torch.from_numpy(array) for array in (crow0, cols0, crow1, cols1))
    results = (*arrays, group_size, *(torch.from_numpy(array) for array in (links, link_ptr, *rest)))
    return tuple(result.to(keypoints0.device) for result in results)  # type: ignore[return-value]


def _ptr_of_batch(link_ptr: Int, vertex: Int, segment_ptr: Int, ptr: Tensor) -> Int:
    """Offsets of the links by stereo pair, from those by segment."""
    bounds = ptr.numpy(force=True)
    if len(segment_ptr) == len(bounds) and np.array_equal(segment_ptr, bounds):
        return link_ptr
    filled = np.flatnonzero(np.diff(segment_ptr))
    number = np.searchsorted(bounds, vertex[segment_ptr[filled]], side="right") - 1
    counts = np.bincount(number, weights=np.diff(link_ptr)[filled], minlength=len(bounds) - 1)
    return np.concatenate([[0], np.cumsum(counts.astype(np.int64))])


def _soft_match_graphs(
    views: list[Float], vertex: Int, segment_ptr: Int, tie_tolerance: float, edge_lengths: float, px: float
) -> tuple[object, ...]:
    points = [view[vertex] + 0.0 for view in views]  # -0 becomes 0
    patterns = build_scipy(views, vertex, segment_ptr, tie_tolerance)
    links, link_ptr = soft_links(points, segment_ptr, num_threads=torch.get_num_threads())
    rows = vertex[links]
    critical: list[Int] = []
    is_edge: list[Bool] = []
    for view, (crow, cols) in zip(points, patterns, strict=True):
        found = critical_points(view, segment_ptr, links, link_ptr)
        found = limit_reach(view, links, found, edge_lengths=edge_lengths, px=px)
        critical.append(np.where(found < 0, found, vertex[np.maximum(found, 0)]))
        keys = np.repeat(np.arange(len(crow) - 1), np.diff(crow)) * len(crow) + cols
        is_edge.append(np.isin(rows[:, 0] * len(crow) + rows[:, 1], keys))
    return (*patterns, rows, link_ptr, *critical, *is_edge)
