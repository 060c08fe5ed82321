"""Coincident points: which of them become vertices (``Matches`` rest on a bijection between the views)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]


def coincident_ids(points: Float, segment: Int) -> Int:
    """Number the distinct points of each segment.

    Args:
        points: (N, 2) float64; -0 equals 0.
        segment: (N,) int64.

    Returns:
        (N,) int64 labels: equal iff segment, x and y are equal.

    Example:
        >>> coincident_ids(np.array([[1.0, 0.0], [0.0, 0.0], [1.0, -0.0]]), np.array([0, 0, 0]))
        array([1, 0, 1])
    """
    order = np.lexsort((points[:, 1], points[:, 0], segment))
    ordered, ordered_segment = points[order], segment[order]
    differs = (ordered[1:] != ordered[:-1]).any(1) | (ordered_segment[1:] != ordered_segment[:-1])
    ids = np.zeros(len(points), dtype=np.int64)
    ids[order[1:]] = np.cumsum(differs)
    return ids


def first_of_coincident(ids: Int) -> Bool:
    """(N,) True for the lowest index of each label.

    Example:
        >>> first_of_coincident(np.array([1, 0, 1]))
        array([ True,  True, False])
    """
    first = np.zeros(len(ids), dtype=bool)
    first[np.unique(ids, return_index=True)[1]] = True
    return first


def keep_one_to_one(ids0: Int, ids1: Int, cost: Float | None) -> Bool:
    """Greedy bijection: in the order (cost, row), a match is kept iff neither of its points is taken by a kept one.

    Args:
        ids0: (M,) labels of the left points, equal iff the points coincide.
        ids1: (M,) labels of the right points.
        cost: (M,) or None, lower is better; None means the order of the rows.

    Returns:
        (M,) True for kept matches.

    Example:
        >>> keep_one_to_one(np.array([0, 0, 1]), np.array([0, 1, 1]), np.array([3.0, 1.0, 2.0]))
        array([False,  True, False])
    """
    kept: Bool = (np.bincount(ids0)[ids0] == 1) & (np.bincount(ids1)[ids1] == 1)
    contested = np.flatnonzero(~kept)
    if cost is not None:
        contested = contested[np.argsort(cost[contested], kind="stable")]
    # The greedy choice is sequential by definition; only contested matches come here.
    taken0: set[int] = set()
    taken1: set[int] = set()
    for row, left, right in zip(contested.tolist(), ids0[contested].tolist(), ids1[contested].tolist(), strict=True):
        if left not in taken0 and right not in taken1:
            taken0.add(left)
            taken1.add(right)
            kept[row] = True
    return kept
