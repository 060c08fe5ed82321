from __future__ import annotations

import networkx
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tensor_stereo.graphs import build_graphs, build_match_graphs
from tensor_stereo.ops import resolve_backend
from tensor_stereo.types import Matches
from tests.oracles import circle_graph, edge_set, neighbor_sets
from tests.point_sets import distinct_points


def _graph(points: np.ndarray, tie_tolerance: float = 0.0, **options: object) -> set[tuple[int, int]]:
    keypoints = torch.from_numpy(np.array(points, dtype=np.float64))
    return edge_set(build_graphs(keypoints, torch.tensor([0, len(keypoints)]), tie_tolerance=tie_tolerance, **options))  # type: ignore[arg-type]


small_grids = arrays(np.int64, st.tuples(st.integers(0, 9), st.just(2)), elements=st.integers(-3, 3))


@given(small_grids)
def test_of_coincident_points_the_lowest_index_is_the_vertex(points: np.ndarray) -> None:
    first = np.sort(np.unique(points, axis=0, return_index=True)[1])
    expected = {(int(first[i]), int(first[j])) for i, j in circle_graph(points[first])}
    assert _graph(points) == expected


@given(small_grids, st.randoms(use_true_random=False))
def test_relabelling_and_exact_maps_leave_the_exact_graph(points: np.ndarray, random: object) -> None:
    points = np.unique(points, axis=0).astype(np.float64)
    expected = _graph(points)
    order = list(range(len(points)))
    random.shuffle(order)  # type: ignore[attr-defined]
    moved = {tuple(sorted((order[i], order[j]))) for i, j in _graph(points[order])}
    assert moved == expected
    for image in (points[:, ::-1], points * 2.0**-7, points + np.array([1024, -512]), points * [1, -1]):
        assert _graph(image) == expected


def test_matrix_is_symmetric_sorted_and_connected() -> None:
    points = torch.from_numpy(distinct_points("integers", 0, 300))
    adjacency = build_graphs(points, torch.tensor([0, len(points)]))
    dense = adjacency.to_dense(0)
    assert torch.equal(dense, dense.T)
    assert not dense.diagonal().any()
    rows = [adjacency.neighbors(i) for i in range(len(points))]
    assert all(bool((row.diff() > 0).all()) for row in rows)
    graph = networkx.from_numpy_array(dense.numpy())
    assert networkx.is_connected(graph)
    assert networkx.check_planarity(graph)[0]
    assert torch.equal(adjacency.to_sparse_csr(torch.int32).to_dense().bool(), dense)
    assert torch.equal(adjacency.to_sparse_coo().to_dense(), dense)
    assert torch.equal(adjacency.degree, dense.sum(1))


def test_batch_equals_loop() -> None:
    parts = [distinct_points(kind, 1, n) for kind, n in (("uniform", 70), ("grid_8px", 40), ("collinear", 5))]
    parts += [np.empty((0, 2)), distinct_points("uniform", 2, 1), distinct_points("uniform", 2, 2)]
    ptr = torch.tensor([0, *np.cumsum([len(p) for p in parts])])
    batch = build_graphs(torch.from_numpy(np.concatenate(parts)), ptr)
    for b, part in enumerate(parts):
        alone = build_graphs(torch.from_numpy(part), torch.tensor([0, len(part)]))
        assert torch.equal(batch.to_dense(b), alone.to_dense(0))


def test_group_refines_the_blocks() -> None:
    points = torch.from_numpy(distinct_points("uniform", 4, 120))
    group = torch.arange(len(points)) % 3 - 1
    ptr = torch.tensor([0, 50, len(points)])
    grouped = neighbor_sets(build_graphs(points, ptr, group))
    for pair in range(2):
        for label in range(-1, 2):
            rows = torch.arange(int(ptr[pair]), int(ptr[pair + 1]))
            rows = rows[group[rows] == label]
            alone = build_graphs(points[rows], torch.tensor([0, len(rows)]))
            for i, row in enumerate(rows.tolist()):
                assert grouped[row] == set(rows[alone.neighbors(i)].tolist())


def test_thread_count_changes_nothing() -> None:
    points = torch.from_numpy(distinct_points("dense_integers", 4, 2000))
    ptr = torch.arange(0, len(points) + 1, len(points) // 20)
    ptr[-1] = len(points)
    threads = torch.get_num_threads()
    try:
        columns = []
        for count in (1, 4):
            torch.set_num_threads(count)
            columns.append(build_graphs(points, ptr).col_indices)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*columns)


def test_a_duplicate_is_decided_by_cost_then_row() -> None:
    left = torch.tensor([[0.0, 0.0], [0.0, -0.0], [5.0, 1.0], [2.0, 7.0], [6.0, 6.0]])
    right = left + torch.tensor([[0.0, 0.0], [1.0, 3.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    ptr = torch.tensor([0, 5])
    by_row = build_match_graphs(Matches(left, right, ptr)).group_size
    by_cost = build_match_graphs(Matches(left, right, ptr, cost=torch.tensor([2.0, 1.0, 1.0, 1.0, 1.0]))).group_size
    assert by_row.tolist() == [4, 0, 4, 4, 4]
    assert by_cost.tolist() == [0, 4, 4, 4, 4]


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4), st.integers(0, 2)), max_size=12))
def test_the_kept_matches_are_the_greedy_bijection(rows: list[tuple[int, int, int]]) -> None:
    taken0: set[int] = set()
    taken1: set[int] = set()
    kept = []
    for _, row in sorted((cost, row) for row, (_, _, cost) in enumerate(rows)):
        left, right, _ = rows[row]
        if left not in taken0 and right not in taken1:
            kept.append(row)
            taken0.add(left)
            taken1.add(right)
    table = torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)
    points0, points1 = (torch.stack([column, column**2], 1) for column in (table[:, 0], table[:, 1]))
    graphs = build_match_graphs(Matches(points0, points1, torch.tensor([0, len(rows)]), cost=table[:, 2]))
    assert torch.nonzero(graphs.group_size)[:, 0].tolist() == sorted(kept)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e61, 1e-61])
def test_bad_coordinate_names_pair_and_row(value: float) -> None:
    points = torch.zeros(5, 2, dtype=torch.float64)
    points[:, 0] = torch.arange(5)
    bad = points.clone()
    bad[4, 1] = value
    with pytest.raises(ValueError, match=r"keypoints1 .* row 2 of pair 1"):
        build_match_graphs(Matches(points, bad, torch.tensor([0, 2, 5])))
    with pytest.raises(ValueError, match=r"keypoints .* row 2 of pair 1"):
        build_graphs(bad, torch.tensor([0, 2, 5]))


def test_bad_options_are_named() -> None:
    points, ptr = torch.rand(3, 2), torch.tensor([0, 3])
    with pytest.raises(ValueError, match="tie_tolerance"):
        build_graphs(points, ptr, tie_tolerance=1.0)
    with pytest.raises(ValueError, match="backend"):
        build_graphs(points, ptr, backend="cuda")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="group"):
        build_graphs(points, ptr, torch.rand(3))
    with pytest.raises(ValueError, match="ptr"):
        build_graphs(points, torch.tensor([0, 2]))
    with pytest.raises(TypeError, match="keypoints"):
        build_graphs(points.half(), ptr)
    with pytest.raises(ValueError, match="cost"):
        build_match_graphs(Matches(points, points, ptr, cost=torch.tensor([0.0, float("nan"), 0.0])))


def test_environment_overrides_auto(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TENSOR_STEREO_BACKEND", "scipy")
    assert resolve_backend("auto") == "scipy"
    monkeypatch.setenv("TENSOR_STEREO_BACKEND", "qhull")
    with pytest.raises(ValueError, match="qhull"):
        resolve_backend("auto")
