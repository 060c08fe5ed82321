"""Delaunay triangulation by divide and conquer in integer arithmetic: slow, exact, for whatever Qhull gets wrong.

Source: Guibas & Stolfi, "Primitives for the Manipulation of General Subdivisions and the Computation of Voronoi
Diagrams", ACM Transactions on Graphics 4 (1985), section 9. O(N log N) for every input.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tensor_stereo.delaunay.predicates import Float, to_integers


def divide_and_conquer(points: Float) -> NDArray[np.int64]:
    """Triangulate distinct points exactly.

    Args:
        points: (N, 2) float64, distinct, N >= 2.

    Returns:
        (T, 3) int64 counter-clockwise triangles; none if all points are collinear.

    Example:
        >>> import numpy as np
        >>> divide_and_conquer(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        array([[2, 0, 1]])
        >>> divide_and_conquer(np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])).shape
        (0, 3)
    """
    order = np.lexsort((points[:, 1], points[:, 0]))
    mesh = _Mesh(to_integers(points[order]).tolist())
    mesh.build(0, len(points))
    return order[mesh.triangles()]


class _Mesh:
    """Half-edges 2k and 2k + 1 of edge k, each in the counter-clockwise ring of edges around its origin."""

    def __init__(self, points: list[tuple[int, int]]) -> None:
        self.points = points
        self.origin: list[int] = []
        self.after: list[int] = []  # next counter-clockwise half-edge of the same origin, Onext
        self.before: list[int] = []  # Oprev
        self.alive: list[bool] = []

    def turn(self, a: int, b: int, c: int) -> int:
        (ax, ay), (bx, by), (cx, cy) = self.points[a], self.points[b], self.points[c]
        return (ax - cx) * (by - cy) - (ay - cy) * (bx - cx)

    def inside(self, a: int, b: int, c: int, d: int) -> bool:
        (ax, ay), (bx, by), (cx, cy), (dx, dy) = (self.points[k] for k in (a, b, c, d))
        ux, uy, vx, vy, wx, wy = ax - dx, ay - dy, bx - dx, by - dy, cx - dx, cy - dy
        return (
            (ux * ux + uy * uy) * (vx * wy - vy * wx)
            + (vx * vx + vy * vy) * (wx * uy - wy * ux)
            + (wx * wx + wy * wy) * (ux * vy - uy * vx)
        ) > 0

    def add(self, start: int, end: int) -> int:
        edge = len(self.origin)
        self.origin += (start, end)
        self.after += (edge, edge + 1)
        self.before += (edge, edge + 1)
        self.alive += (True, True)
        return edge

    def splice(self, a: int, b: int) -> None:
        after_a, after_b = self.after[a], self.after[b]
        self.after[a], self.after[b] = after_b, after_a
        self.before[after_b], self.before[after_a] = a, b

    def left_next(self, edge: int) -> int:
        return self.before[edge ^ 1]

    def connect(self, a: int, b: int) -> int:
        """New edge from the end of ``a`` to the start of ``b``, with the same face on the left of all three."""
        edge = self.add(self.origin[a ^ 1], self.origin[b])
        self.splice(edge, self.left_next(a))
        self.splice(edge ^ 1, b)
        return edge

    def remove(self, edge: int) -> None:
        for half in (edge, edge ^ 1):
            self.splice(half, self.before[half])
            self.alive[half] = False

    def build(self, start: int, stop: int) -> tuple[int, int]:
        """Triangulate ``points[start:stop]``; the hull edges out of its leftmost and its rightmost point."""
        if stop - start == 2:
            edge = self.add(start, start + 1)
            return edge, edge ^ 1
        if stop - start == 3:
            a = self.add(start, start + 1)
            b = self.add(start + 1, start + 2)
            self.splice(a ^ 1, b)
            turn = self.turn(start, start + 1, start + 2)
            if turn == 0:
                return a, b ^ 1
            c = self.connect(b, a)
            return (a, b ^ 1) if turn > 0 else (c ^ 1, c)
        middle = (start + stop) // 2
        left_outer, left_inner = self.build(start, middle)
        right_inner, right_outer = self.build(middle, stop)
        return self.merge(left_outer, left_inner, right_inner, right_outer)

    def merge(self, left_outer: int, left_inner: int, right_inner: int, right_outer: int) -> tuple[int, int]:
        origin, after, before = self.origin, self.after, self.before
        while True:  # lower common tangent
            if self.turn(origin[right_inner], origin[left_inner], origin[left_inner ^ 1]) > 0:
                left_inner = self.left_next(left_inner)
            elif self.turn(origin[left_inner], origin[right_inner], origin[right_inner ^ 1]) < 0:
                right_inner = after[right_inner ^ 1]
            else:
                break
        base = self.connect(right_inner ^ 1, left_inner)
        if origin[left_inner] == origin[left_outer]:
            left_outer = base ^ 1
        if origin[right_inner] == origin[right_outer]:
            right_outer = base
        while True:  # stitch upwards
            end, start = origin[base ^ 1], origin[base]
            left = after[base ^ 1]
            if left_above := self.turn(origin[left ^ 1], end, start) > 0:
                while (
                    self.turn(origin[after[left] ^ 1], end, start) > 0
                    and self.inside(end, start, origin[left ^ 1], origin[after[left] ^ 1])
                ):  # fmt: skip
                    following = after[left]
                    self.remove(left)
                    left = following
            right = before[base]
            if right_above := self.turn(origin[right ^ 1], end, start) > 0:
                while (
                    self.turn(origin[before[right] ^ 1], end, start) > 0
                    and self.inside(end, start, origin[right ^ 1], origin[before[right] ^ 1])
                ):  # fmt: skip
                    following = before[right]
                    self.remove(right)
                    right = following
            if not left_above and not right_above:
                return left_outer, right_outer
            if not left_above or (right_above and self.inside(origin[left ^ 1], end, start, origin[right ^ 1])):
                base = self.connect(right, base ^ 1)
            else:
                base = self.connect(base ^ 1, left ^ 1)

    def triangles(self) -> NDArray[np.int64]:
        found = []
        for edge, alive in enumerate(self.alive):
            second = self.left_next(edge)
            third = self.left_next(second)
            if not alive or edge > min(second, third) or self.left_next(third) != edge:
                continue
            corners = self.origin[edge], self.origin[second], self.origin[third]
            if self.turn(*corners) > 0:
                found.append(corners)
        return np.array(found, dtype=np.int64).reshape(-1, 3)
