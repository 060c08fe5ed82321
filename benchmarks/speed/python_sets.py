"""The paper's Restriction 2 as one would write it first: scipy's triangulation and Python sets."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay


def find_neighbors(points: np.ndarray) -> list[set[int]]:
    offsets, neighbors = Delaunay(points).vertex_neighbor_vertices
    return [set(neighbors[offsets[i] : offsets[i + 1]].tolist()) for i in range(len(points))]


def classify_with_sets(points0: np.ndarray, points1: np.ndarray) -> list[bool]:
    """Whether one neighbour set of a match contains the other, for the matches of one pair."""
    sets = zip(find_neighbors(points0), find_neighbors(points1), strict=True)
    return [n0 <= n1 or n1 <= n0 for n0, n1 in sets]
