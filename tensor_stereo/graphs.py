"""Keypoints of a ragged batch -> their Delaunay graphs as one sparse adjacency over the whole batch."""

from __future__ import annotations

import os
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.configs import Backend
from tensor_stereo.delaunay.edges import delaunay_edges
from tensor_stereo.duplicates import coincident_ids, first_of_coincident, keep_one_to_one
from tensor_stereo.types import Adjacency, Matches, check_integer, check_points, check_ptr, check_vector

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

SMALLEST, LARGEST = 1e-60, 1e60  # magnitudes whose degree-4 determinants neither underflow nor overflow


class MatchGraphs(NamedTuple):
    """The graphs of both views over the rows of one batch of matches."""

    adjacency0: Adjacency
    adjacency1: Adjacency
    group_size: Tensor  # (M,) int64 distinct matches in the same object group, 0 for duplicates, which are no vertices


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
        backend: ``scipy``, ``native``, or ``auto`` for the best one installed; the environment variable
            ``TENSOR_STEREO_BACKEND`` overrides ``auto``. All give the same bits.

    Returns:
        The adjacency, on the device of ``keypoints``. Of coincident points the lowest index is a vertex, the others
        have degree 0. No gradient.

    Raises:
        ValueError: for NaN, infinite or out-of-range coordinates (naming pair and row), or bad shapes and options.
        TypeError: for dtypes other than those above.

    Source: Bustos, Vargas & Trujillo, CIARP 2016, section 2; strict graph and tolerance are this library's.

    Example:
        >>> square = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        >>> build_graphs(square, torch.tensor([0, 4])).degree
        tensor([2, 2, 2, 2])
    """
    points = _to_points("keypoints", keypoints, ptr)
    segment = _segments(ptr, group, len(points))
    segment[~first_of_coincident(coincident_ids(points, segment))] = -1
    return _build([points], segment, ptr, tie_tolerance, backend)[0]


def build_match_graphs(matches: Matches, *, tie_tolerance: float = 1e-3, backend: Backend = "auto") -> MatchGraphs:
    """Delaunay graphs of both views of every pair, over the rows of ``matches``.

    The method rests on a bijection: per pair, matches are taken in the order (cost, row), or by row without a cost, and
    one is kept iff neither its left nor its right point was taken by a kept one. The others are no vertices.

    Args:
        matches: B pairs; ``group`` splits each pair into objects (Restriction 3).
        tie_tolerance: as in :func:`build_graphs`.
        backend: as in :func:`build_graphs`.

    Returns:
        Both adjacencies and the size of each match's group. No gradient.

    Raises:
        ValueError: for NaN or infinite ``keypoints0``, ``keypoints1`` (naming pair and row) or NaN ``cost``.

    Example:
        >>> from tensor_stereo.types import Matches
        >>> points = torch.tensor([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0], [0.0, 3.0]])
        >>> build_match_graphs(Matches(points, points - 1, torch.tensor([0, 4]))).group_size
        tensor([3, 3, 3, 0])
    """
    views = [
        _to_points(f"keypoints{v}", p, matches.ptr) for v, p in enumerate((matches.keypoints0, matches.keypoints1))
    ]
    segment = _segments(matches.ptr, matches.group, matches.num_matches)
    pair = ptr_to_batch(matches.ptr).numpy(force=True)
    cost = None if matches.cost is None else matches.cost.detach().to("cpu", torch.float64).numpy()
    if cost is not None and np.isnan(cost).any():
        raise ValueError(f"cost must not be NaN, got NaN in row {int(np.isnan(cost).argmax())}")
    ids0, ids1 = (coincident_ids(points, pair) for points in views)
    segment[~keep_one_to_one(ids0, ids1, cost)] = -1
    adjacency0, adjacency1 = _build(views, segment, matches.ptr, tie_tolerance, backend)
    size = np.bincount(segment[segment >= 0], minlength=1)[segment] * (segment >= 0)
    return MatchGraphs(adjacency0, adjacency1, torch.from_numpy(size).to(matches.keypoints0.device))


def resolve_backend(backend: Backend) -> Backend:
    """The back end that runs: ``auto`` becomes the best one installed, or what ``TENSOR_STEREO_BACKEND`` names."""
    if backend == "auto":
        backend = os.environ.get("TENSOR_STEREO_BACKEND", "auto")  # type: ignore[assignment]
    if backend not in ("auto", "native", "scipy"):
        raise ValueError(f"backend must be 'auto', 'native' or 'scipy', got {backend!r}")
    if backend == "native":
        raise ValueError("backend 'native' is not part of this installation; use 'auto' or 'scipy'")
    return "scipy"


def _build(views: list[Float], segment: Int, ptr: Tensor, tie_tolerance: float, backend: Backend) -> list[Adjacency]:
    """Graphs of several point sets over the same segments; rows with segment -1 are no vertices."""
    if not 0 <= tie_tolerance < 1:
        raise ValueError(f"tie_tolerance must lie in [0, 1), got {tie_tolerance}")
    resolve_backend(backend)
    vertex = np.flatnonzero(segment >= 0)
    vertex = vertex[np.argsort(segment[vertex], kind="stable")]
    length = np.bincount(segment[vertex])
    length = np.tile(length[length > 0], len(views))
    segment_ptr = np.concatenate([[0], np.cumsum(length)])
    edges = delaunay_edges(
        np.concatenate([points[vertex] for points in views]),
        segment_ptr,
        tie_tolerance=tie_tolerance,
        num_threads=torch.get_num_threads(),
    )
    view = edges[:, 0] // max(len(vertex), 1)
    return [_to_adjacency(vertex[edges[view == v] - v * len(vertex)], len(segment), ptr) for v in range(len(views))]


def _to_adjacency(edges: Int, num_nodes: int, ptr: Tensor) -> Adjacency:
    both = np.concatenate([edges, edges[:, ::-1]])
    key = np.sort(both[:, 0] * num_nodes + both[:, 1])
    rows, cols = np.divmod(key, max(num_nodes, 1))
    crow = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=num_nodes))])
    return Adjacency(torch.from_numpy(crow).to(ptr.device), torch.from_numpy(cols).to(ptr.device), ptr)


def _to_points(name: str, keypoints: Tensor, ptr: Tensor) -> Float:
    check_points(name, keypoints)
    check_ptr("ptr", ptr, len(keypoints))
    points: Float = keypoints.detach().to("cpu", torch.float64).numpy() + 0.0  # -0 becomes 0
    magnitude = np.abs(points)
    bad = ~((magnitude == 0) | ((magnitude >= SMALLEST) & (magnitude <= LARGEST))).all(1)
    if bad.any():
        row = int(bad.argmax())
        pair = int(torch.searchsorted(ptr.cpu(), row, right=True)) - 1
        where = f"row {row - int(ptr[pair])} of pair {pair}"
        given = tuple(points[row].tolist())
        raise ValueError(f"{name} must be finite, 0 or {SMALLEST:g}..{LARGEST:g} in magnitude, got {given} in {where}")
    return points


def _segments(ptr: Tensor, group: Tensor | None, num_rows: int) -> Int:
    """(M,) int64 number of the segment, a pair or an object group within it, of every row."""
    pair: Int = ptr_to_batch(ptr).numpy(force=True).copy()
    if group is None:
        return pair
    check_vector("group", group, num_rows)
    check_integer("group", group)
    labels = group.detach().to("cpu", torch.int64).numpy()
    order = np.lexsort((labels, pair))
    differs = (np.diff(labels[order]) != 0) | (np.diff(pair[order]) != 0)
    segment = np.zeros(num_rows, dtype=np.int64)
    segment[order[1:]] = np.cumsum(differs)
    return segment
