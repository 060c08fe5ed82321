from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import Delaunay

from tensor_stereo.delaunay import edges as edges_module
from tensor_stereo.delaunay.divide import divide_and_conquer
from tensor_stereo.delaunay.edges import delaunay_edges
from tensor_stereo.delaunay.mesh import build_mesh
from tests.oracles import circle_graph
from tests.point_sets import GENERATORS, distinct_points


def _edges(points: np.ndarray, tie_tolerance: float = 0.0) -> set[tuple[int, int]]:
    found = delaunay_edges(points, np.array([0, len(points)]), tie_tolerance=tie_tolerance, num_threads=1)
    return {(min(i, j), max(i, j)) for i, j in found.tolist()}


@pytest.mark.parametrize("kind", GENERATORS)
def test_exact_graph_is_the_circle_definition(kind: str) -> None:
    for seed in range(40):
        points = distinct_points(kind, seed, 1 + seed % 9)
        assert _edges(points) == circle_graph(points), (seed, points.tolist())


@pytest.mark.slow
def test_exact_graph_is_the_circle_definition_on_many_small_sets() -> None:
    kinds = list(GENERATORS)
    for seed in range(5_000):
        points = distinct_points(kinds[seed % len(kinds)], seed, 1 + seed % 8)
        assert _edges(points) == circle_graph(points), (kinds[seed % len(kinds)], seed)


@pytest.mark.parametrize("kind", GENERATORS)
def test_rebuilding_everything_changes_nothing(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    points = distinct_points(kind, 3, 300)
    expected = _edges(points), _edges(points, 1e-3)
    monkeypatch.setattr(edges_module, "_qhull", lambda part: np.empty((0, 3), dtype=np.int64))
    assert (_edges(points), _edges(points, 1e-3)) == expected


@pytest.mark.parametrize("kind", GENERATORS)
def test_tolerant_graph_is_a_subset(kind: str) -> None:
    points = distinct_points(kind, 5, 200)
    assert _edges(points, 1e-3) <= _edges(points)


@pytest.mark.parametrize("kind", ["grid_8px", "dense_integers", "integers", "nearly_collinear"])
def test_tolerant_graph_survives_rounding(kind: str) -> None:
    points = distinct_points(kind, 1, 400)
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    normalised = (points - points.mean(0)) / points.std()
    single = (points / 3).astype(np.float32).astype(np.float64)
    expected = _edges(points, 1e-3)
    for moved in (points / 3, points @ np.array([[c, -s], [s, c]]), normalised, single, points * 0.1 + 17.3):
        assert _edges(moved, 1e-3) == expected


def test_general_position_equals_qhull() -> None:
    points = np.random.default_rng(0).random((3000, 2))
    simplices = Delaunay(points).simplices
    sides = np.sort(simplices[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert _edges(points) == set(map(tuple, sides.tolist()))


def test_exchanging_the_diagonal_of_a_square_changes_no_bit() -> None:
    """The dual length next to a co-circular polygon may not depend on how the polygon was cut."""
    points = distinct_points("dense_integers", 2, 60)
    expected = _edges(points, 0.2)
    for seed in range(4):
        order = np.random.default_rng(seed).permutation(len(points))
        moved = _edges(points[order], 0.2)
        assert {tuple(sorted((int(order[i]), int(order[j])))) for i, j in moved} == expected


def test_hull_edge_over_a_flat_triangle_is_dropped() -> None:
    points = np.array([[0.0, 0.0], [10.0, 0.0], [5.0, 1e-4], [5.0, 8.0]])
    assert (0, 1) in _edges(points)
    assert (0, 1) not in _edges(points, 1e-3)


def test_segments_do_not_see_each_other() -> None:
    parts = [distinct_points(kind, 11, n) for kind, n in (("integers", 50), ("collinear", 3), ("circle", 1))]
    parts += [distinct_points("uniform", 12, 2), np.empty((0, 2)), distinct_points("far_away", 13, 40)]
    ptr = np.concatenate([[0], np.cumsum([len(p) for p in parts])])
    for num_threads in (1, 3):
        found = delaunay_edges(np.concatenate(parts), ptr, tie_tolerance=0.0, num_threads=num_threads)
        expected = {(i + int(ptr[s]), j + int(ptr[s])) for s, part in enumerate(parts) for i, j in _edges(part)}
        assert {(min(i, j), max(i, j)) for i, j in found.tolist()} == expected


@pytest.mark.parametrize(
    "spoil",
    [
        lambda t: t[:-1],  # a hole
        lambda t: np.concatenate([t, t[:1]]),  # a triangle twice
        lambda t: np.concatenate([t[:1, ::-1], t[1:]]),  # a triangle that turns clockwise
        lambda t: t[(t != 0).all(1)],  # a point that is no vertex
        lambda t: t[:0],
    ],
)
def test_certificate_refuses_a_spoiled_triangulation(spoil: object) -> None:
    points = distinct_points("uniform", 0, 50)
    triangles = divide_and_conquer(points)
    ptr, segments = np.array([0, len(points)]), np.array([0])
    assert build_mesh(points, ptr, triangles, segments)[1].tolist() == []
    assert build_mesh(points, ptr, spoil(triangles), segments)[1].tolist() == [0]  # type: ignore[operator]


def test_certificate_refuses_a_flipped_edge() -> None:
    points = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 1.0], [0.0, 1.1]])
    ptr, segments = np.array([0, 4]), np.array([0])
    cuts = {cut: build_mesh(points, ptr, np.array(cut), segments)[1].tolist() for cut in (
        ((0, 1, 2), (0, 2, 3)), ((0, 1, 3), (1, 2, 3))
    )}  # fmt: skip
    assert sorted(cuts.values()) == [[], [0]]
