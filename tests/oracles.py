"""Slow, independent definitions that the package is held against."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from tensor_stereo.configs import Backend
from tensor_stereo.ops.backends import kernels


def circle_graph(points: np.ndarray) -> set[tuple[int, int]]:
    """Edges {i, j} for which some circle through both leaves all other points strictly outside.

    Exact over the rationals: with centre m + t n on the perpendicular bisector, each third point bounds t on one side
    or, on the line through i and j, forbids or allows all t.
    """
    rational = [(Fraction(float(x)), Fraction(float(y))) for x, y in points]
    edges = set()
    for i, (ax, ay) in enumerate(rational):
        for j in range(i + 1, len(rational)):
            bx, by = rational[j]
            mx, my, nx, ny = (ax + bx) / 2, (ay + by) / 2, ay - by, bx - ax
            lower: list[Fraction] = []
            upper: list[Fraction] = []
            free = True
            for k, (x, y) in enumerate(rational):
                if k in (i, j):
                    continue
                slope = 2 * (nx * (mx - x) + ny * (my - y))
                offset = (mx - x) ** 2 + (my - y) ** 2 - (mx - ax) ** 2 - (my - ay) ** 2
                if slope == 0:
                    free &= offset > 0
                else:
                    (lower if slope > 0 else upper).append(-offset / slope)
            if free and (not lower or not upper or max(lower) < min(upper)):
                edges.add((i, j))
    return edges


def edge_set(adjacency: object) -> set[tuple[int, int]]:
    """Upper triangle of an ``Adjacency`` as a Python set."""
    rows, cols = adjacency.row_indices.tolist(), adjacency.col_indices.tolist()  # type: ignore[attr-defined]
    return {(i, j) for i, j in zip(rows, cols, strict=True) if i < j}


def neighbor_sets(adjacency: object) -> list[set[int]]:
    """Neighbours of every node as Python sets."""
    nodes = range(adjacency.num_nodes)  # type: ignore[attr-defined]
    return [set(adjacency.neighbors(node).tolist()) for node in nodes]  # type: ignore[attr-defined]


RELATION_NAMES = ("UNTESTED", "EQUAL", "SUBSET", "SUPERSET", "CONFLICT")


def relation_of_sets(n0: set[int], n1: set[int]) -> str:
    """The definition of the relations in words."""
    if n0 == n1:
        return "EQUAL"
    if n0 < n1:
        return "SUBSET"
    if n1 < n0:
        return "SUPERSET"
    return "CONFLICT"


def installed_backends() -> list[Backend]:
    """Back ends that can run here."""
    return ["scipy"] if kernels is None else ["native", "scipy"]
