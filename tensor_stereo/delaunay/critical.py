"""Links whose soft adjacency counts, and the points that bound their dual Voronoi edges.

A link joins two points that are neighbours, or nearly so. The critical point of a link {i, j} on one side of its line
is the one that sees the segment under the largest angle, of several the lexicographically first. Here it is searched
among all points of the segment.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tensor_stereo.delaunay.edges import canonical_opposite, certified_meshes, map_blocks, polygons
from tensor_stereo.delaunay.mesh import HULL, Int, Mesh
from tensor_stereo.delaunay.predicates import Float, incircle, orientation

BLOCKED = -2  # a point lies between the two, or the dual edge is out of reach
MOST_CORNERS = 16  # the chords of larger co-circular polygons are not listed: there are too many
_CHUNK = 2**18  # links x points that are compared at a time


def soft_links(views: list[Float], ptr: Int, *, num_threads: int) -> tuple[Int, Int]:
    """Links that count in at least one of several point sets over the same segments.

    They are the edges of the exact graphs; the two critical points of each edge if the segment between them crosses it;
    and the chords of co-circular polygons with at most ``MOST_CORNERS`` corners.

    Args:
        views: (N, 2) float64 each.
        ptr: (S + 1,) int64 offsets of the segments.
        num_threads: threads that share the segments.

    Returns:
        links (E, 2) int64, i < j, ascending, and their offsets (S + 1,).
    """
    found = [np.empty((0, 2), dtype=np.int64)]
    for points in views:
        found += map_blocks(_block_links, points, ptr, num_threads)
    both = np.sort(np.concatenate(found), axis=1)
    links = np.unique(both, axis=0)
    return links, np.searchsorted(links[:, 0], ptr)


def _block_links(points: Float, ptr: Int) -> Int:
    meshes, paths = certified_meshes(points, ptr)
    return np.concatenate([paths, *(part for mesh in meshes for part in _mesh_links(points, mesh))])


def _mesh_links(points: Float, mesh: Mesh) -> list[Int]:
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


def critical_points(points: Float, ptr: Int, links: Int, link_ptr: Int) -> Int:
    """Critical points of given links, searched among all points of their segment.

    Args:
        points: (N, 2) float64, distinct within a segment.
        ptr: (S + 1,) offsets of the segments.
        links: (E, 2) rows of the two points that each link joins.
        link_ptr: (S + 1,) offsets of the links of each segment.

    Returns:
        (E, 2) rows of points, right and left of the way from the first vertex to the second; -1 where that side is
        empty; -2 for both where a point lies between the two.

    Example:
        >>> corners = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])
        >>> critical_points(corners, np.array([0, 4]), np.array([[0, 1], [0, 2]]), np.array([0, 2])).tolist()
        [[-1, 3], [1, 3]]
    """
    found = np.empty_like(links)
    for s in np.flatnonzero(np.diff(link_ptr)):
        members = points[ptr[s] : ptr[s + 1]]
        step = max(1, _CHUNK // len(members))
        for start in range(link_ptr[s], link_ptr[s + 1], step):
            rows = slice(start, min(start + step, link_ptr[s + 1]))
            local = _search(members, links[rows] - ptr[s])
            found[rows] = np.where(local < 0, local, local + ptr[s])
    return found


def _search(points: Float, links: Int) -> Int:
    i, j = points[links[:, 0]], points[links[:, 1]]
    dx, dy = (j - i).T[:, :, None]  # (E, 1)
    x, y = (points[None] - i[:, None]).transpose(2, 0, 1)  # (E, n)
    cross, along = dx * y - dy * x, x * (x - dx) + y * (y - dy)
    is_third = np.ones(cross.shape, dtype=bool)
    is_third[np.arange(len(links))[:, None], links] = False
    side = np.sign(cross).astype(np.int8)
    unsure = is_third & ~(np.abs(cross) > 1e-14 * (np.abs(dx * y) + np.abs(dy * x)))
    link, point = np.nonzero(unsure)
    side[link, point] = orientation(i[link], j[link], points[point])
    with np.errstate(all="ignore"):
        end = along / (2 * np.abs(cross))
        reach, span = np.abs(x) + np.abs(y), np.abs(dx) + np.abs(dy)
        error = 1e-15 * reach * (reach + (1 + 2 * np.abs(end)) * span) / np.abs(cross)
    found = [_best(points, links, is_third & (side == sign), end, error, sign) for sign in (-1, 1)]
    result = np.stack(found, 1)
    low, high = np.minimum(i, j)[:, None], np.maximum(i, j)[:, None]  # products may round, comparisons do not
    is_between = ((points[None] >= low) & (points[None] <= high)).all(2)
    result[(is_third & (side == 0) & is_between).any(1)] = BLOCKED
    return result


def _best(points: Float, links: Int, candidate: NDArray[np.bool_], end: Float, error: Float, sign: int) -> Int:
    """The candidates with the smallest ``end``; exact predicates decide what ``error`` leaves open."""
    with np.errstate(all="ignore"):
        upper = np.where(candidate, np.where(np.isnan(end + error), np.inf, end + error), np.inf)
        near = candidate & ~(end - error > upper.min(1, keepdims=True, initial=np.inf))
    order = np.argsort(~near, axis=1, kind="stable")
    best = np.where(near.any(1), order[:, 0], HULL)
    a, b = links[:, 0], links[:, 1]
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


def limit_reach(points: Float, links: Int, critical: Int, *, edge_lengths: float, px: float) -> Int:
    """Mark links as blocked whose dual length is below minus (``edge_lengths`` times their length plus ``px``)."""
    between = np.flatnonzero((critical >= 0).all(1))
    i, j = (points[links[between, k]] for k in (0, 1))
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
