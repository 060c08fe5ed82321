"""A triangulation seen by its undirected edges, and the exact proof that it is the Delaunay triangulation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tensor_stereo.delaunay.predicates import Float, Sign, incircle, orientation

Int = NDArray[np.int64]
HULL = -1  # opposite vertex and triangle on a side without points


class Mesh(NamedTuple):
    """Undirected edges of a triangulation and what lies on their two sides."""

    triangles: Int  # (T, 3) vertices, counter-clockwise
    edges: Int  # (E, 2) vertices, directed as in the triangle on the left
    opposite: Int  # (E, 2) third vertices of the triangles on the left and right, HULL if there is none
    triangle: Int  # (E, 2) these triangles, HULL if there is none
    side: Sign  # (E,) in-circle sign of the right opposite vertex in the left circle, -1 on the hull


def build_mesh(points: Float, ptr: Int, triangles: Int, segments: Int) -> tuple[Mesh, Int]:
    """Pair the edges of all triangles and certify the Delaunay triangulation of each segment.

    A segment is certified iff every triangle turns counter-clockwise, every edge has one triangle or two that lie on
    different sides, the boundary turns left once around, every point is a vertex and no opposite vertex lies strictly
    inside the circle of its neighbour. Triangles of positive area inside a boundary of winding number one cover its
    inside exactly once, so nothing else can be wrong.

    Args:
        points: (N, 2) float64.
        ptr: (S + 1,) offsets of the segments.
        triangles: (T, 3) global vertex indices, meant to be counter-clockwise.
        segments: (K,) the segments that the triangles are to cover.

    Returns:
        The mesh of all triangles, and the sorted segments among ``segments`` that are not certified.
    """
    turn = orientation(*(points.take(triangles[:, k], axis=0) for k in range(3)))
    start, end = triangles.reshape(-1), np.roll(triangles, -1, axis=1).reshape(-1)
    third = np.roll(triangles, -2, axis=1).reshape(-1)
    key = np.minimum(start, end) * len(points) + np.maximum(start, end)
    order = np.argsort(key)
    key = key[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    count = np.diff(first, append=len(key))
    inner = count > 1
    one, other = order[first], order[np.where(inner, first + 1, first)]
    left, right = np.minimum(one, other), np.where(inner, np.maximum(one, other), HULL)
    opposite = np.stack([third[left], np.where(inner, third[right], HULL)], 1)
    triangle = np.stack([left // 3, np.where(inner, right // 3, HULL)], 1)
    edges = np.stack([start[left], end[left]], 1)
    side = np.full(len(edges), -1, dtype=np.int8)
    corners = (edges[:, 0], edges[:, 1], opposite[:, 0], opposite[:, 1])
    side[inner] = incircle(*(points.take(v[inner], axis=0) for v in corners))

    used = np.zeros(len(points), dtype=bool)
    used[start] = True
    expected = np.isin(np.repeat(np.arange(len(ptr) - 1), np.diff(ptr)), segments)
    tangled = (count > 2) | (inner & (start[right] == start[left]))
    witnesses = [
        start[::3][turn <= 0],
        np.flatnonzero(expected & ~used),
        edges[tangled | (side > 0), 0],
        _boundary_faults(points, ptr, edges[~inner]),
    ]
    faulty = np.unique(np.searchsorted(ptr, np.concatenate(witnesses), side="right") - 1)
    return Mesh(triangles, edges, opposite, triangle, side), faulty


def _boundary_faults(points: Float, ptr: Int, hull: Int) -> Int:
    """Vertices of segments whose boundary is not one cycle that turns left, or goes straight on, once around."""
    following = np.full(len(points), HULL)
    following[hull[:, 0]] = hull[:, 1]
    doubled = hull[following[hull[:, 0]] != hull[:, 1], 0]
    end = following[hull[:, 1]]
    hull_closed = hull[end != HULL]
    a, b, c = points[hull_closed[:, 0]], points[hull_closed[:, 1]], points[end[end != HULL]]
    into, out = _is_lexicographically_less(a, b), _is_lexicographically_less(b, c)
    turn = orientation(a, b, c)
    reflex = (turn < 0) | ((turn == 0) & (into != out))
    # Each time around, a path of left turns has one vertex at which it leaves descending for ascending order.
    lowest = hull_closed[~into & out, 1]
    segment = np.searchsorted(ptr, lowest, side="right") - 1
    laps = np.bincount(segment, minlength=len(ptr) - 1)[segment]
    return np.concatenate([doubled, hull[end == HULL, 1], hull_closed[reflex, 1], lowest[laps != 1]])


def _is_lexicographically_less(a: Float, b: Float) -> NDArray[np.bool_]:
    less: NDArray[np.bool_] = (a[:, 0] < b[:, 0]) | ((a[:, 0] == b[:, 0]) & (a[:, 1] < b[:, 1]))
    return less
