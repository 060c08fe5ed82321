"""Operator that finds the points that bound dual Voronoi edges."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from tensor_stereo.delaunay.critical import critical_points
from tensor_stereo.delaunay.one_to_one import coincident_ids, first_of_coincident
from tensor_stereo.ops.backends import native
from tensor_stereo.ops.registration import operator
from tensor_stereo.ops.segments import pair_of, segments_of, to_points, vertices_of
from tensor_stereo.types import check_links


def _fake(*arguments: Any) -> Tensor:
    _, _, _, links, _ = arguments
    return torch.empty_like(links)


@operator(_fake)
def dual_critical_points(keypoints: Tensor, ptr: Tensor, group: Tensor | None, links: Tensor, backend: str) -> Tensor:
    """Critical points of given links; see :func:`tensor_stereo.soft.dual_critical_points`.

    Args:
        keypoints: (N, 2) float32 or float64.
        ptr: (B + 1,) int64.
        group: (N,) integer or None.
        links: (E, 2) int64 rows of two distinct points of one segment.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        (E, 2) int64 rows. No gradient.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [4.0, 0.0], [2.0, 1.0], [2.0, -2.0]])
        >>> dual_critical_points(points, torch.tensor([0, 4]), None, torch.tensor([[0, 1]]), "auto")
        tensor([[3, 2]])
    """
    kernels = native(backend)
    points = to_points("keypoints", keypoints, ptr, kernels)
    check_links("links", links, len(points))
    rows = links.numpy(force=True)
    segment = pair_of(ptr) if group is None else segments_of(ptr, group, len(points))
    kept = first_of_coincident(coincident_ids(points, segment))
    bad = (rows[:, 0] == rows[:, 1]) | (segment[rows[:, 0]] != segment[rows[:, 1]]) | ~kept[rows].all(1)
    if bad.any():
        given = rows[bad.argmax()].tolist()
        raise ValueError(f"links must join two distinct points of one segment, not repeated before, got {given}")
    vertex, segment_ptr = vertices_of(ptr, segment, kept)
    number = segment[rows[:, 0]]
    order = np.argsort(number, kind="stable")
    counts = np.bincount(number, minlength=len(segment_ptr) - 1)
    link_ptr = np.concatenate([[0], np.cumsum(counts)])
    if kernels is not None:
        threads = torch.get_num_threads()
        found = kernels.dual_critical_points(points, vertex, segment_ptr, rows[order], link_ptr, threads)
    else:
        place = np.zeros(len(points), dtype=np.int64)
        place[vertex] = np.arange(len(vertex))
        found = critical_points(points[vertex] + 0.0, segment_ptr, place[rows[order]], link_ptr)
        found = np.where(found < 0, found, vertex[np.maximum(found, 0)])
    result = np.empty_like(found)
    result[order] = found
    return torch.from_numpy(result).to(keypoints.device)
