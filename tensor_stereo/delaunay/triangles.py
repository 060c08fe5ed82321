"""Triangles that depend on the points alone: there is one way to cut a co-circular polygon."""

from __future__ import annotations

import numpy as np

from tensor_stereo.delaunay.edges import certified_meshes, polygons
from tensor_stereo.delaunay.mesh import HULL, Int, Mesh
from tensor_stereo.delaunay.predicates import Float


def delaunay_triangles(points: Float, ptr: Int) -> tuple[Int, Int]:
    """Delaunay triangulation of every segment, and the boundary of what it covers.

    A co-circular polygon is a fan around its lexicographically first vertex.

    Args:
        points: (N, 2) float64, distinct within a segment, 0 or 1e-60..1e60 in magnitude.
        ptr: (S + 1,) int64 offsets of the segments.

    Returns:
        triangles: (T, 3) int64 counter-clockwise vertices, the lexicographically first one in front; sorted by vertex.
        boundary: (H, 2) int64 edges of the convex hulls, counter-clockwise. Collinear points, which have no triangle,
            give the edges of their path in lexicographic order, a single point the edge to itself. The rows are in
            lexicographic order of the points in which the edges start.

    Example:
        >>> import numpy as np
        >>> square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        >>> triangles, boundary = delaunay_triangles(square, np.array([0, 4]))
        >>> triangles.tolist(), len(boundary)
        ([[0, 1, 2], [0, 2, 3]], 4)
    """
    meshes, paths = certified_meshes(points, ptr)
    rank = np.empty(len(points), dtype=np.int64)
    rank[np.lexsort((points[:, 1], points[:, 0]))] = np.arange(len(points))
    triangles = np.concatenate([_fans(rank, mesh) for mesh in meshes])
    paths = np.take_along_axis(paths, rank[paths].argsort(1), 1)
    single = ptr[:-1][np.diff(ptr) == 1]
    hulls = [mesh.edges[mesh.triangle[:, 1] == HULL] for mesh in meshes]
    boundary = np.concatenate([*hulls, paths, np.stack([single, single], 1)])
    return tuple(rows[np.lexsort(rank[rows].T[::-1])] for rows in (triangles, boundary))  # type: ignore[return-value]


def _fans(rank: Int, mesh: Mesh) -> Int:
    """Triangles of each co-circular polygon, most of which have three corners."""
    if not len(mesh.edges):
        return np.empty((0, 3), dtype=np.int64)
    outer = mesh.side < 0  # no diagonal of a polygon
    inner = outer & (mesh.triangle[:, 1] != HULL)
    sides = np.concatenate([mesh.edges[outer], mesh.edges[inner, ::-1]])  # each with its polygon on the left
    polygon = polygons(mesh)[np.concatenate([mesh.triangle[outer, 0], mesh.triangle[inner, 1]])]
    order = np.lexsort((rank[sides[:, 0]], polygon))
    sides, polygon = sides[order], polygon[order]
    first = np.diff(polygon, prepend=-1) != 0
    apex = sides[first, 0][np.cumsum(first) - 1]
    opposite = (sides != apex[:, None]).all(1)
    triangles: Int = np.concatenate([apex[:, None], sides], 1)[opposite]
    return triangles
