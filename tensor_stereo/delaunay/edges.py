"""Edges of the exact Delaunay graph of every segment of a ragged batch.

Qhull proposes a triangulation; exact predicates certify it; what they refuse is built anew in integer arithmetic.
An edge of the triangulation belongs to the graph iff its opposite vertices are not co-circular with it, and, with a
tolerance e, iff its dual Voronoi edge, clipped to 1 / e edge lengths around the midpoint, exceeds e edge lengths.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, QhullError

from tensor_stereo.delaunay.divide import divide_and_conquer
from tensor_stereo.delaunay.mesh import HULL, Int, Mesh, build_mesh
from tensor_stereo.delaunay.predicates import Float

_BLOCK = 4096


def delaunay_edges(points: Float, ptr: Int, *, tie_tolerance: float, num_threads: int) -> Int:
    """Edges of the Delaunay graph of every segment.

    Args:
        points: (N, 2) float64, distinct within a segment, 0 or 1e-60..1e60 in magnitude.
        ptr: (S + 1,) int64 offsets of the segments.
        tie_tolerance: e of the module's docstring, in edge lengths; 0 gives the exact strict graph.
        num_threads: threads that share the segments.

    Returns:
        (E, 2) int64 global indices of the ends, each edge once, in no particular order.

    Example:
        >>> import numpy as np
        >>> square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        >>> edges = delaunay_edges(square, np.array([0, 4]), tie_tolerance=0.0, num_threads=1)
        >>> sorted(map(tuple, np.sort(edges, axis=1).tolist()))  # no diagonal
        [(0, 1), (0, 3), (1, 2), (2, 3)]
    """
    found = map_blocks(lambda points, ptr: _block_edges(points, ptr, tie_tolerance), points, ptr, num_threads)
    return np.concatenate([np.empty((0, 2), dtype=np.int64), *found])


def map_blocks(function: Callable[[Float, Int], Int], points: Float, ptr: Int, num_threads: int) -> list[Int]:
    """Apply a function of (points, ptr) that returns point indices to runs of segments, in a pool of threads."""

    def shifted(block: slice) -> Int:
        part = ptr[block]
        found: Int = function(points[part[0] : part[-1]], part - part[0]) + part[0]
        return found

    blocks = _blocks(ptr)
    if num_threads > 1 and len(blocks) > 1:
        with ThreadPoolExecutor(num_threads) as pool:
            return list(pool.map(shifted, blocks))
    return [shifted(block) for block in blocks]


def _blocks(ptr: Int) -> list[slice]:
    """Runs of segments, as slices of ptr, of about so many points that the arrays of one run stay in cache."""
    block = ptr[:-1] // _BLOCK
    first = np.append(np.flatnonzero(np.diff(block, prepend=-1)), len(block))
    return [slice(start, stop + 1) for start, stop in pairwise(first)]


def _block_edges(points: Float, ptr: Int, tie_tolerance: float) -> Int:
    """Edges of consecutive segments."""
    meshes, paths = certified_meshes(points, ptr)
    return np.concatenate([*(_long_edges(points, mesh, tie_tolerance) for mesh in meshes), paths])


def certified_meshes(points: Float, ptr: Int) -> tuple[list[Mesh], Int]:
    """The Delaunay triangulations of consecutive segments, and the edges (E, 2) of those that are collinear."""
    size = np.diff(ptr)
    segments = np.flatnonzero(size > 2)
    proposals = [_qhull(points[ptr[s] : ptr[s + 1]]) for s in segments]
    mesh, faulty = _build(points, ptr, proposals, segments)
    meshes, paths = [mesh], [ptr[:-1][size == 2][:, None] + np.array([0, 1])]
    if len(faulty):
        meshes = [_without(mesh, np.isin(np.searchsorted(ptr, mesh.edges[:, 0], side="right") - 1, faulty))]
        rebuilt = [divide_and_conquer(points[ptr[s] : ptr[s + 1]]) for s in faulty]
        flat = np.array([len(triangles) == 0 for triangles in rebuilt])
        mesh, wrong = _build(points, ptr, [t for t in rebuilt if len(t)], faulty[~flat])
        if len(wrong):
            raise RuntimeError(f"the exact triangulation of segments {wrong[:10].tolist()} fails its own proof")
        meshes.append(mesh)
        paths += [_path(points, ptr, s) for s in faulty[flat]]
    return meshes, np.concatenate(paths)


def _qhull(points: Float) -> Int:
    centre = (points.min(0) + points.max(0)) / 2  # Qhull's tolerance grows with the distance from the origin
    try:
        simplices: Int = Delaunay(points - centre).simplices.astype(np.int64)
    except QhullError:  # collinear, or flat by its tolerance
        return np.empty((0, 3), dtype=np.int64)
    return simplices


def _path(points: Float, ptr: Int, segment: np.int64) -> Int:
    """Edges of a collinear segment: a path in lexicographic order."""
    part = points[ptr[segment] : ptr[segment + 1]]
    order = np.lexsort((part[:, 1], part[:, 0])) + ptr[segment]
    return np.stack([order[:-1], order[1:]], 1)


def _build(points: Float, ptr: Int, triangulations: Sequence[Int], segments: Int) -> tuple[Mesh, Int]:
    empty = np.empty((0, 3), dtype=np.int64)
    triangles = np.concatenate([empty, *(t + ptr[s] for t, s in zip(triangulations, segments, strict=True))])
    return build_mesh(points, ptr, triangles, segments)


def _without(mesh: Mesh, dropped: NDArray[np.bool_]) -> Mesh:
    """A mesh without some of its edges; the triangles stay."""
    kept = ~dropped
    return Mesh(mesh.triangles, mesh.edges[kept], mesh.opposite[kept], mesh.triangle[kept], mesh.side[kept])


def _long_edges(points: Float, mesh: Mesh, tie_tolerance: float) -> Int:
    """Those edges of a triangulation that belong to the graph."""
    kept = mesh.side < 0
    if tie_tolerance > 0:
        kept &= _dual_length(points, mesh, 1 / tie_tolerance) > tie_tolerance
    return mesh.edges[kept]


def _dual_length(points: Float, mesh: Mesh, bound: float) -> Float:
    """(E,) length of the dual Voronoi edges in edge lengths, each end clipped to ``bound`` from the midpoint.

    In edge lengths, the centre of the circle through i, j and k lies cot(angle at k) / 2 from the midpoint of {i, j}.
    """
    opposite = canonical_opposite(points, mesh)
    i, j = (points.take(vertex, axis=0) for vertex in mesh.edges.T)
    ends = []
    for k in opposite.T:
        corner = points.take(k, axis=0, mode="wrap")  # HULL has none, and is not asked
        v, w = i - corner, j - corner
        dot = v[:, 0] * w[:, 0] + v[:, 1] * w[:, 1]
        cross = np.abs(v[:, 0] * w[:, 1] - v[:, 1] * w[:, 0])  # its sign is known, its rounding must not flip it
        with np.errstate(divide="ignore", invalid="ignore"):
            end = np.clip(0.5 * dot / cross, -bound, bound)
        ends.append(np.where(k == HULL, bound, end))
    return ends[0] + ends[1]


def polygons(mesh: Mesh) -> Int:
    """(T,) number of the co-circular polygon that each triangle is part of."""
    num_triangles = len(mesh.triangles)
    a, b = mesh.triangle[mesh.side == 0].T
    graph = coo_array((np.ones(len(a), dtype=bool), (a, b)), shape=(num_triangles, num_triangles))
    polygon: Int = connected_components(graph, directed=False)[1].astype(np.int64)
    return polygon


def canonical_opposite(points: Float, mesh: Mesh) -> Int:
    """Opposite vertices that depend on the points alone.

    The triangulation of a co-circular polygon is arbitrary, and its vertices give the same circle but for rounding:
    take the polygon's lexicographically first vertex that is not on the edge.
    """
    tied = mesh.side == 0
    if not tied.any():
        return mesh.opposite
    polygon = polygons(mesh)
    several = np.unique(mesh.triangle[tied])  # triangles that share a polygon with another one
    member, vertex = np.repeat(polygon[several], 3), mesh.triangles[several].reshape(-1)
    order = np.lexsort((points[vertex, 1], points[vertex, 0], member))
    member, vertex = member[order], vertex[order]
    distinct = (np.diff(member, prepend=-1) != 0) | (np.diff(vertex, prepend=-1) != 0)
    member, vertex = member[distinct], vertex[distinct]
    first = np.searchsorted(member, polygon[mesh.triangle]) + np.arange(3)[:, None, None]  # (3, E, 2)
    candidate = vertex[np.minimum(first, len(vertex) - 1)]
    free = (candidate != mesh.edges[:, :1]) & (candidate != mesh.edges[:, 1:])
    chosen = np.take_along_axis(candidate, free.argmax(0)[None], 0)[0]
    return np.where(np.isin(mesh.triangle, several), chosen, mesh.opposite)
