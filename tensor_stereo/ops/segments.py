"""From the tensors of a ragged batch to the arrays that graph builders take."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tensor_stereo.delaunay.one_to_one import coincident_ids, keep_one_to_one
from tensor_stereo.types import check_integer, check_points, check_ptr, check_vector

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

_SMALLEST, _LARGEST = 1e-60, 1e60  # magnitudes whose degree-4 determinants neither underflow nor overflow


def segments_of(ptr: Tensor, group: Tensor, num_rows: int) -> Int:
    """(M,) int64 number of the segment, an object group within a pair, of every row."""
    check_vector("group", group, num_rows)
    check_integer("group", group)
    pair = pair_of(ptr)
    labels = group.detach().to("cpu", torch.int64).numpy()
    order = np.lexsort((labels, pair))
    differs = (np.diff(labels[order]) != 0) | (np.diff(pair[order]) != 0)
    segment = np.zeros(num_rows, dtype=np.int64)
    segment[order[1:]] = np.cumsum(differs)
    return segment


def pair_of(ptr: Tensor) -> Int:
    """(M,) number of the pair of every row."""
    length = np.diff(ptr.numpy(force=True))
    return np.repeat(np.arange(len(length)), length)


def to_points(name: str, keypoints: Tensor, ptr: Tensor, kernels: ModuleType | None = None) -> Float:
    """Keypoints as a float64 array; raises for what :func:`check_range` refuses, naming pair and row."""
    check_points(name, keypoints)
    check_ptr("ptr", ptr, len(keypoints))
    points: Float = keypoints.detach().to("cpu", torch.float64).contiguous().numpy()

    def describe(row: int) -> str:
        pair = int(torch.searchsorted(ptr.cpu(), row, right=True)) - 1
        return f"{name} in row {row - int(ptr[pair])} of pair {pair}"

    check_range(points, describe, kernels)
    return points


def check_range(points: Float, describe: Callable[[int], str], kernels: ModuleType | None = None) -> None:
    """Raise unless the exact predicates can take all of (N, 2) ``points``; ``describe`` names the point of a row.

    >>> check_range(np.array([[0.0, np.inf]]), lambda row: f"m.csv, row {row}: keypoint 0")
    Traceback (most recent call last):
    ...
    ValueError: m.csv, row 0: keypoint 0 must be finite, 0 or 1e-60..1e+60 in magnitude, got (0.0, inf)
    """
    if kernels is not None:
        row = int(kernels.first_point_out_of_range(points))
    else:
        magnitude = np.abs(points)
        good = ((magnitude == 0) | ((magnitude >= _SMALLEST) & (magnitude <= _LARGEST))).all(1)
        row = -1 if good.all() else int(good.argmin())
    if row >= 0:
        limits = f"0 or {_SMALLEST:g}..{_LARGEST:g} in magnitude"
        raise ValueError(f"{describe(row)} must be finite, {limits}, got {tuple(points[row].tolist())}")


def views_of(
    keypoints0: Tensor,
    keypoints1: Tensor,
    ptr: Tensor,
    cost: Tensor | None,
    group: Tensor | None,
    kernels: ModuleType | None,
) -> tuple[list[Float], Int | None, Bool]:
    """Points of both views of putative matches, the segment of every row if there are groups, and the vertices."""
    views = [to_points("keypoints0", keypoints0, ptr, kernels), to_points("keypoints1", keypoints1, ptr, kernels)]
    segment = None if group is None else segments_of(ptr, group, len(keypoints0))
    return views, segment, one_to_one(views, ptr, cost, kernels)


def one_to_one(views: list[Float], ptr: Tensor, cost: Tensor | None, kernels: ModuleType | None) -> Bool:
    """(M,) the rows that are vertices, as :func:`tensor_stereo.graphs.build_match_graphs` documents them."""
    values = None if cost is None else cost.detach().to("cpu", torch.float64).contiguous().numpy()
    if values is not None and np.isnan(values).any():
        raise ValueError(f"cost must not be NaN, got NaN in row {int(np.isnan(values).argmax())}")
    kept: Bool
    if kernels is not None:
        kept = kernels.one_to_one(*views, ptr.numpy(force=True), values, torch.get_num_threads())
        return kept
    pair = pair_of(ptr)
    ids0, ids1 = (coincident_ids(points, pair) for points in views)
    kept = keep_one_to_one(ids0, ids1, values)
    return kept


def group_size_of(ptr: Tensor, segment: Int | None, kept: Bool) -> Tensor:
    """(M,) int64 vertices in the segment of every row, 0 for rows that are none."""
    # NumPy, because torch would wake its threads for this, and they would spin beside the kernels' own.
    if segment is None and kept.all():
        length = np.diff(ptr.numpy(force=True))
        return torch.from_numpy(np.repeat(length, length))
    segment = pair_of(ptr) if segment is None else segment
    return torch.from_numpy(np.bincount(segment, weights=kept).astype(np.int64)[segment] * kept)


def vertices_of(ptr: Tensor, segment: Int | None, kept: Bool) -> tuple[Int, Int]:
    """Rows that are vertices, segment after segment, and the offsets of the segments."""
    if segment is None and kept.all():
        return np.arange(len(kept)), ptr.numpy(force=True)
    vertex = np.flatnonzero(kept)
    number = (pair_of(ptr) if segment is None else segment)[vertex]
    vertex = vertex[np.argsort(number, kind="stable")]
    return vertex, np.concatenate([[0], np.cumsum(np.bincount(number))])
