from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo.delaunay.predicates import incircle, orientation
from tensor_stereo.delaunay.triangles import delaunay_triangles


def cells(count: int, seed: int, side: int = 9) -> np.ndarray:
    """Distinct points of a small grid, most of which lie on circles with others."""
    cell = np.random.default_rng(seed).permutation(side * side)[:count]
    return np.stack([cell % side, cell // side], 1).astype(np.float64)


def turn(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    return orientation(*(points[triangles[:, k]] for k in range(3)))


@given(st.integers(3, 40), st.integers(0, 10**6))
def test_triangles_cover_the_hull_and_their_circles_are_empty(count: int, seed: int) -> None:
    points = cells(count, seed)
    triangles, boundary = delaunay_triangles(points, np.array([0, count]))
    (ax, ay), (bx, by) = points[boundary[:, 0]].T, points[boundary[:, 1]].T
    start = list(zip(ax, ay, strict=True))
    assert start == sorted(start)
    if not len(triangles):
        assert len(boundary) == count - 1
        return
    assert (turn(points, triangles) > 0).all()
    a, b, c = (points[triangles[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert area.sum() == (ax * by - ay * bx).sum()
    for point in points:
        assert (incircle(a, b, c, np.broadcast_to(point, a.shape)) <= 0).all()
    assert set(triangles.ravel()) == set(range(count))


@given(st.integers(1, 40), st.integers(0, 10**6))
def test_triangles_depend_on_the_points_alone(count: int, seed: int) -> None:
    points = cells(count, seed)
    order = np.random.default_rng(seed + 1).permutation(count)
    one, other = (delaunay_triangles(p, np.array([0, count])) for p in (points, points[order]))
    for rows, mixed in zip(one, other, strict=True):
        assert np.array_equal(points[rows], points[order][mixed])


def test_segments_have_nothing_in_common() -> None:
    parts = [cells(count, seed) for seed, count in enumerate((12, 0, 1, 2, 30, 3))]
    parts.append(np.array([[0.0, 0.0], [2.0, 2.0], [1.0, 1.0]]))  # collinear
    ptr = np.cumsum([0, *map(len, parts)])
    found = delaunay_triangles(np.concatenate(parts), ptr)
    alone = [delaunay_triangles(part, np.array([0, len(part)])) for part in parts]
    for rows, single in zip(found, zip(*alone, strict=True), strict=True):
        segment = np.searchsorted(ptr, rows[:, 0], side="right") - 1
        for k, expected in enumerate(single):
            assert np.array_equal(rows[segment == k] - ptr[k], expected)


@pytest.mark.parametrize(("points", "boundary"), [([[1, 1]], [[0, 0]]), ([[3, 0], [1, 1]], [[1, 0]]), ([], [])])
def test_too_few_points_have_no_triangle(points: list, boundary: list) -> None:
    given = np.array(points, dtype=np.float64).reshape(-1, 2)
    triangles, hull = delaunay_triangles(given, np.array([0, len(given)]))
    assert triangles.shape == (0, 3)
    assert hull.tolist() == boundary
