"""Operators that build Delaunay graphs: of one view, and of both views of putative matches."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tensor_stereo.configs import Backend
from tensor_stereo.delaunay.edges import delaunay_edges
from tensor_stereo.duplicates import coincident_ids, first_of_coincident, keep_one_to_one
from tensor_stereo.ops.backends import kernels, resolve_backend
from tensor_stereo.ops.registration import operator
from tensor_stereo.types import check_integer, check_points, check_ptr, check_vector

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
Pattern = tuple[Tensor, Tensor]  # crow (N + 1,), cols (nnz,)

SMALLEST, LARGEST = 1e-60, 1e60  # magnitudes whose degree-4 determinants neither underflow nor overflow


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
        tie_tolerance: in [0, 1), in edge lengths.
        backend: ``auto``, ``native`` or ``scipy``.

    Returns:
        crow (N + 1,) and cols (nnz,) int64. No gradient.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [3.0, 0.0]])
        >>> delaunay_graph(points, torch.tensor([0, 4]), None, 1e-3, "auto")
        (tensor([0, 1, 3, 3, 4]), tensor([1, 0, 3, 1]))
    """
    choice = _check_options(tie_tolerance, backend)
    points = _to_points("keypoints", keypoints, ptr)
    segment = None if group is None else segments_of(ptr, group, len(points))
    if segment is None and choice == "native":
        kept = _keep_one_to_one([points, points], ptr, None, choice)
    else:
        kept = first_of_coincident(coincident_ids(points, _pair(ptr) if segment is None else segment))
    return _build([points], ptr, segment, kept, tie_tolerance, choice)[0]


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
        tie_tolerance: in [0, 1), in edge lengths.
        backend: ``auto``, ``native`` or ``scipy``.

    Returns:
        crow0, cols0, crow1, cols1 and group_size (M,), int64. No gradient.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [3.0, 0.0]])
        >>> match_graphs(points, points, torch.tensor([0, 4]), None, None, 1e-3, "auto")[-1]
        tensor([3, 3, 0, 3])
    """
    choice = _check_options(tie_tolerance, backend)
    views = [_to_points("keypoints0", keypoints0, ptr), _to_points("keypoints1", keypoints1, ptr)]
    segment = None if group is None else segments_of(ptr, group, len(keypoints0))
    kept = _keep_one_to_one(views, ptr, cost, choice)
    (crow0, cols0), (crow1, cols1) = _build(views, ptr, segment, kept, tie_tolerance, choice)
    return crow0, cols0, crow1, cols1, _group_size(ptr, segment, kept).to(keypoints0.device)


def segments_of(ptr: Tensor, group: Tensor, num_rows: int) -> Int:
    """(M,) int64 number of the segment, an object group within a pair, of every row."""
    check_vector("group", group, num_rows)
    check_integer("group", group)
    pair = _pair(ptr)
    labels = group.detach().to("cpu", torch.int64).numpy()
    order = np.lexsort((labels, pair))
    differs = (np.diff(labels[order]) != 0) | (np.diff(pair[order]) != 0)
    segment = np.zeros(num_rows, dtype=np.int64)
    segment[order[1:]] = np.cumsum(differs)
    return segment


def _check_options(tie_tolerance: float, backend: str) -> Backend:
    if not 0 <= tie_tolerance < 1:
        raise ValueError(f"tie_tolerance must lie in [0, 1), got {tie_tolerance}")
    return resolve_backend(backend)  # type: ignore[arg-type]


def _pair(ptr: Tensor) -> Int:
    length = np.diff(ptr.numpy(force=True))
    return np.repeat(np.arange(len(length)), length)


def _to_points(name: str, keypoints: Tensor, ptr: Tensor) -> Float:
    check_points(name, keypoints)
    check_ptr("ptr", ptr, len(keypoints))
    points: Float = keypoints.detach().to("cpu", torch.float64).contiguous().numpy()
    row = _first_out_of_range(points)
    if row >= 0:
        pair = int(torch.searchsorted(ptr.cpu(), row, right=True)) - 1
        where = f"row {row - int(ptr[pair])} of pair {pair}"
        given = tuple(points[row].tolist())
        raise ValueError(f"{name} must be finite, 0 or {SMALLEST:g}..{LARGEST:g} in magnitude, got {given} in {where}")
    return points


def _first_out_of_range(points: Float) -> int:
    if kernels is not None:
        return int(kernels.first_point_out_of_range(points))
    magnitude = np.abs(points)
    bad = ~((magnitude == 0) | ((magnitude >= SMALLEST) & (magnitude <= LARGEST))).all(1)
    return int(bad.argmax()) if bad.any() else -1


def _keep_one_to_one(views: list[Float], ptr: Tensor, cost: Tensor | None, backend: Backend) -> Bool:
    values = None if cost is None else cost.detach().to("cpu", torch.float64).contiguous().numpy()
    if values is not None and np.isnan(values).any():
        raise ValueError(f"cost must not be NaN, got NaN in row {int(np.isnan(values).argmax())}")
    kept: Bool
    if backend == "native" and kernels is not None:
        kept = kernels.one_to_one(*views, ptr.numpy(force=True), values, torch.get_num_threads())
        return kept
    pair = _pair(ptr)
    ids0, ids1 = (coincident_ids(points, pair) for points in views)
    kept = keep_one_to_one(ids0, ids1, values)
    return kept


def _group_size(ptr: Tensor, segment: Int | None, kept: Bool) -> Tensor:
    # NumPy, because torch would wake its threads for this, and they would spin beside the kernels' own.
    if segment is None and kept.all():
        length = np.diff(ptr.numpy(force=True))
        return torch.from_numpy(np.repeat(length, length))
    segment = _pair(ptr) if segment is None else segment
    return torch.from_numpy(np.bincount(segment, weights=kept).astype(np.int64)[segment] * kept)


def _build(
    views: list[Float], ptr: Tensor, segment: Int | None, kept: Bool, tie_tolerance: float, backend: Backend
) -> list[Pattern]:
    """Patterns of several point sets over the same segments; rows that are not kept are no vertices."""
    if segment is None and kept.all():
        vertex, segment_ptr = np.arange(len(kept)), ptr.numpy(force=True)
    else:
        vertex = np.flatnonzero(kept)
        number = (_pair(ptr) if segment is None else segment)[vertex]
        order = np.argsort(number, kind="stable")
        vertex = vertex[order]
        segment_ptr = np.concatenate([[0], np.cumsum(np.bincount(number))])
    build = _build_native if backend == "native" else _build_scipy
    return [
        (torch.from_numpy(crow).to(ptr.device), torch.from_numpy(cols).to(ptr.device))
        for crow, cols in build(views, vertex, segment_ptr, tie_tolerance)
    ]


def _build_native(views: list[Float], vertex: Int, segment_ptr: Int, tie_tolerance: float) -> list[tuple[Int, Int]]:
    build = kernels.delaunay_graph  # type: ignore[union-attr]  # resolve_backend has made sure that they are there
    return [build(points, vertex, segment_ptr, tie_tolerance, torch.get_num_threads()) for points in views]


def _build_scipy(views: list[Float], vertex: Int, segment_ptr: Int, tie_tolerance: float) -> list[tuple[Int, Int]]:
    # Both views in one call, so that all threads have work to the end.
    shift = segment_ptr[-1] * np.arange(len(views))[:, None]
    edges = delaunay_edges(
        np.concatenate([points[vertex] for points in views]) + 0.0,  # -0 becomes 0
        np.concatenate([segment_ptr[:1], (segment_ptr[1:] + shift).reshape(-1)]),
        tie_tolerance=tie_tolerance,
        num_threads=torch.get_num_threads(),
    )
    view = edges[:, 0] // max(len(vertex), 1)
    return [_to_pattern(vertex[edges[view == v] - v * len(vertex)], len(views[0])) for v in range(len(views))]


def _to_pattern(edges: Int, num_rows: int) -> tuple[Int, Int]:
    both = np.concatenate([edges, edges[:, ::-1]])
    rows, cols = np.divmod(np.sort(both[:, 0] * num_rows + both[:, 1]), max(num_rows, 1))
    return np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=num_rows))]), cols
