"""Pairs of points whose soft adjacency counts, and the points that bound their dual Voronoi edges.

The critical point of a pair {i, j} on one side of its line is the one that sees the segment under the largest angle, of
several the lexicographically first. Here it is found among all points of the segment.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tensor_stereo.delaunay.edges import canonical_opposite, certified_meshes, map_blocks, polygons
from tensor_stereo.delaunay.mesh import HULL, Int, Mesh
from tensor_stereo.delaunay.predicates import Float, incircle, orientation

BLOCKED = -2  # a point lies between the two, or the dual edge is out of reach
MOST_CORNERS = 16  # the chords of larger co-circular polygons are not listed: there are too many
_CHUNK = 2**18  # pairs x points that are compared at a time


def soft_pairs(views: list[Float], ptr: Int, *, num_threads: int) -> tuple[Int, Int]:
    """Pairs that count in at least one of several point sets over the same segments.

    They are the edges of the exact graphs, for each edge with critical points on both sides that pair if it crosses the
    edge, and the chords of co-circular polygons with at most ``MOST_CORNERS`` corners.

    Args:
        views: (N, 2) float64 each.
        ptr: (S + 1,) int64 offsets of the segments.
        num_threads: threads that share the segments.

    Returns:
        pairs (E, 2) int64, i < j, ascending, and their offsets (S + 1,).
    """
    found = [np.empty((0, 2), dtype=np.int64)]
    for points in views:
        found += map_blocks(_block_pairs, points, ptr, num_threads)
    both = np.sort(np.concatenate(found), axis=1)
    pairs = np.unique(both, axis=0)
    return pairs, np.searchsorted(pairs[:, 0], ptr)


def _block_pairs(points: Float, ptr: Int) -> Int:
    meshes, paths = certified_meshes(points, ptr)
    return np.concatenate([paths, *(part for mesh in meshes for part in _mesh_pairs(points, mesh))])


def _mesh_pairs(points: Float, mesh: Mesh) -> list[Int]:
    is_strict = mesh.side < 0
    opposite = canonical_opposite(points, mesh)
    inner = is_strict & (opposite != HULL).all(1)
    (i, j), (left, right) = mesh.edges[inner].T, opposite[inner].T
    before, after = (orientation(points[right], points[left], points[end]) for end in (i, j))
    crossing = (before > 0) & (after < 0)
    found = [mesh.edges[is_strict], np.stack([left, right], 1)[crossing]]
    if (mesh.side == 0).any():
        polygon = polygons(mesh)
        order = np.argsort(polygon, kind="stable")
        for members in np.split(mesh.triangles[order], np.flatnonzero(np.diff(polygon[order])) + 1):
            vertices = np.unique(members)
            if len(members) > 1 and len(vertices) <= MOST_CORNERS:
                found.append(vertices[np.stack(np.triu_indices(len(vertices), 1), 1)])
    return found


def critical_points(points: Float, ptr: Int, pairs: Int, pair_ptr: Int) -> Int:
    """Critical points of given pairs of vertices, from all points of their segment.

    Args:
        points: (N, 2) float64, distinct within a segment.
        ptr: (S + 1,) offsets of the segments.
        pairs: (E, 2) rows of points.
        pair_ptr: (S + 1,) offsets of the pairs of each segment.

    Returns:
        (E, 2) rows of points, right and left of the way from the first vertex to the second; -1 where that side is
        empty; -2 for both where a point lies between the two.

    Example:
        >>> corners = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])
        >>> critical_points(corners, np.array([0, 4]), np.array([[0, 1], [0, 2]]), np.array([0, 2])).tolist()
        [[-1, 3], [1, 3]]
    """
    found = np.empty_like(pairs)
    for s in np.flatnonzero(np.diff(pair_ptr)):
        members = points[ptr[s] : ptr[s + 1]]
        step = max(1, _CHUNK // len(members))
        for start in range(pair_ptr[s], pair_ptr[s + 1], step):
            rows = slice(start, min(start + step, pair_ptr[s + 1]))
            local = _search(members, pairs[rows] - ptr[s])
            found[rows] = np.where(local < 0, local, local + ptr[s])
    return found


def _search(points: Float, pairs: Int) -> Int:
    i, j = points[pairs[:, 0]], points[pairs[:, 1]]
    dx, dy = (j - i).T[:, :, None]  # (E, 1)
    x, y = (points[None] - i[:, None]).transpose(2, 0, 1)  # (E, n)
    cross, along = dx * y - dy * x, x * (x - dx) + y * (y - dy)
    is_third = np.ones(cross.shape, dtype=bool)
    is_third[np.arange(len(pairs))[:, None], pairs] = False
    side = np.sign(cross).astype(np.int8)
    unsure = is_third & ~(np.abs(cross) > 1e-14 * (np.abs(dx * y) + np.abs(dy * x)))
    pair, point = np.nonzero(unsure)
    side[pair, point] = orientation(i[pair], j[pair], points[point])
    with np.errstate(all="ignore"):
        end = along / (2 * np.abs(cross))
        reach, span = np.abs(x) + np.abs(y), np.abs(dx) + np.abs(dy)
        error = 1e-15 * reach * (reach + (1 + 2 * np.abs(end)) * span) / np.abs(cross)
    found = [_best(points, pairs, is_third & (side == sign), end, error, sign) for sign in (-1, 1)]
    result = np.stack(found, 1)
    low, high = np.minimum(i, j)[:, None], np.maximum(i, j)[:, None]  # products may round, comparisons do not
    is_between = ((points[None] >= low) & (points[None] <= high)).all(2)
    result[(is_third & (side == 0) & is_between).any(1)] = BLOCKED
    return result


def _best(points: Float, pairs: Int, candidate: NDArray[np.bool_], end: Float, error: Float, sign: int) -> Int:
    """The candidates with the smallest ``end``; exact predicates decide what ``error`` leaves open."""
    with np.errstate(all="ignore"):
        upper = np.where(candidate, np.where(np.isnan(end + error), np.inf, end + error), np.inf)
        near = candidate & ~(end - error > upper.min(1, keepdims=True, initial=np.inf))
    order = np.argsort(~near, axis=1, kind="stable")
    best = np.where(near.any(1), order[:, 0], HULL)
    a, b = pairs[:, 0], pairs[:, 1]
    if sign < 0:
        a, b = b, a
    for k in range(1, int(near.sum(1).max(initial=0))):
        rows = np.flatnonzero(near.sum(1) > k)
        other = order[rows, k]
        inside = incircle(points[a[rows]], points[b[rows]], points[best[rows]], points[other])
        (px, py), (qx, qy) = points[other].T, points[best[rows]].T
        is_before = (px < qx) | ((px == qx) & (py < qy))
        better = (inside > 0) | ((inside == 0) & is_before)
        best[rows[better]] = other[better]
    return best


def limit_reach(points: Float, pairs: Int, critical: Int, *, edge_lengths: float, px: float) -> Int:
    """Mark as blocked what has a dual length below minus (``edge_lengths`` times its length plus ``px``)."""
    between = np.flatnonzero((critical >= 0).all(1))
    i, j = (points[pairs[between, k]] for k in (0, 1))
    dx, dy = (j - i).T
    least = []  # ends less what rounding may have added to them
    with np.errstate(all="ignore"):
        for k in critical[between].T:
            x, y = (points[k] - i).T
            scale = 0.5 / np.abs(dx * y - dy * x)
            end = (x * (x - dx) + y * (y - dy)) * scale
            size, span = np.abs(x) + np.abs(y), np.abs(dx) + np.abs(dy)
            least.append(end - 2e-15 * (size * (size + (1 + 2 * np.abs(end)) * span)) * scale)
        limit = edge_lengths + px / np.sqrt(dx * dx + dy * dy)
        far = np.isfinite(limit) & ~(least[1] + least[0] >= -limit)
    result = critical.copy()
    result[between[far]] = BLOCKED
    return result
