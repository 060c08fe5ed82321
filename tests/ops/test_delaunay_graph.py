from __future__ import annotations

import numpy as np
import pytest
import torch

from tensor_stereo.batching import collate_matches
from tensor_stereo.delaunay import edges
from tensor_stereo.graphs import build_graphs
from tensor_stereo.ops import delaunay_graph, match_graphs
from tensor_stereo.types import Matches
from tests.oracles import circle_graph, edge_set, installed_backends
from tests.point_sets import GENERATORS, distinct_points
from tests.test_classification import random_pair

needs_kernels = pytest.mark.skipif("native" not in installed_backends(), reason="the native kernels are not installed")
TOLERANCES = (0.0, 1e-12, 1e-6, 1e-3, 0.2)


def _same(points: np.ndarray, ptr: torch.Tensor, group: torch.Tensor | None = None) -> None:
    for tie_tolerance in TOLERANCES:
        native, scipy = (
            delaunay_graph(torch.from_numpy(points), ptr, group, tie_tolerance, backend)
            for backend in ("native", "scipy")
        )
        assert torch.equal(native[0], scipy[0]), tie_tolerance
        assert torch.equal(native[1], scipy[1]), tie_tolerance


@needs_kernels
@pytest.mark.parametrize("kind", GENERATORS)
def test_both_back_ends_give_the_same_bits(kind: str) -> None:
    for n in (1, 2, 3, 4, 5, 9, 40, 400, 2000):
        points = distinct_points(kind, n, n)
        _same(points, torch.tensor([0, len(points)]))


@needs_kernels
@pytest.mark.parametrize("kind", GENERATORS)
def test_both_back_ends_treat_duplicates_and_groups_alike(kind: str) -> None:
    rng = np.random.default_rng(3)
    points = GENERATORS[kind](rng, 200)
    points = np.concatenate([points, points[rng.integers(0, len(points), 30)], -0.0 * points[:5]])
    ptr = torch.tensor([0, 60, 60, len(points)])
    _same(points, ptr)
    _same(points, ptr, torch.from_numpy(rng.integers(-2, 3, len(points))))


@needs_kernels
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["uniform", "integers", "grid_8px", "parabola_facing_line", "circle"])
def test_both_back_ends_give_the_same_bits_on_large_sets(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if kind in ("parabola_facing_line", "circle"):  # Qhull's time is quadratic here; the exact rebuild takes its place
        monkeypatch.setattr(edges, "_qhull", lambda part: np.empty((0, 3), dtype=np.int64))
    points = distinct_points(kind, 0, 100_000 if kind != "circle" else 20_000)
    arguments = torch.from_numpy(points), torch.tensor([0, len(points)]), None, 1e-3
    native, scipy = (delaunay_graph(*arguments, backend) for backend in ("native", "scipy"))
    assert all(torch.equal(a, b) for a, b in zip(native, scipy, strict=True))


@needs_kernels
@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
def test_native_graph_is_the_circle_definition_on_many_small_sets(part: int) -> None:
    """1e5 sets in all, built in batches of 500 segments."""
    kinds = list(GENERATORS)
    for batch in range(50 * part, 50 * part + 50):
        sets = [distinct_points(kinds[k % len(kinds)], 500 * batch + k, 2 + k % 5) for k in range(500)]
        ptr = np.concatenate([[0], np.cumsum([len(points) for points in sets])])
        points = torch.from_numpy(np.concatenate(sets))
        found = edge_set(build_graphs(points, torch.from_numpy(ptr), tie_tolerance=0.0, backend="native"))
        expected = {
            (i + int(ptr[k]), j + int(ptr[k])) for k, points in enumerate(sets) for i, j in circle_graph(points)
        }  # fmt: skip
        assert found == expected, batch


@needs_kernels
@pytest.mark.parametrize("kind", GENERATORS)
def test_native_graph_is_the_circle_definition(kind: str) -> None:
    for seed in range(30):
        points = distinct_points(kind, seed, 1 + seed % 10)
        graph = build_graphs(
            torch.from_numpy(points), torch.tensor([0, len(points)]), tie_tolerance=0, backend="native"
        )
        assert edge_set(graph) == circle_graph(points), seed


@needs_kernels
def test_thread_count_and_batch_change_nothing() -> None:
    parts = [distinct_points(kind, 5, 300) for kind in GENERATORS]
    ptr = torch.tensor([0, *np.cumsum([len(part) for part in parts])])
    points = torch.from_numpy(np.concatenate(parts))
    threads = torch.get_num_threads()
    try:
        results = []
        for count in (1, 3):
            torch.set_num_threads(count)
            results.append(delaunay_graph(points, ptr, None, 1e-3, "native"))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
    graph = build_graphs(points, ptr, backend="native")
    for b, part in enumerate(parts):
        alone = build_graphs(torch.from_numpy(part), torch.tensor([0, len(part)]), backend="native")
        assert torch.equal(graph.to_dense(b), alone.to_dense(0))


@needs_kernels
def test_match_graphs_agree_with_costs_groups_and_duplicates() -> None:
    pair = collate_matches([random_pair(kind, 1, 120) for kind in ("integer", "grid", "subpixel")])
    rows = torch.randint(0, pair.num_matches, (600,), generator=torch.Generator().manual_seed(0)).sort().values
    rng = torch.Generator().manual_seed(1)
    matches = Matches(
        pair.keypoints0[rows],
        pair.keypoints1[rows.flip(0)],
        torch.tensor([0, 100, 350, 600]),
        torch.randint(0, 3, (600,), generator=rng),
        torch.randint(0, 4, (600,), generator=rng),
    )
    for cost in (None, matches.cost):
        for group in (None, matches.group):
            views = matches.keypoints0, matches.keypoints1, matches.ptr
            native, scipy = (match_graphs(*views, cost, group, 1e-3, backend) for backend in ("native", "scipy"))
            assert all(torch.equal(a, b) for a, b in zip(native, scipy, strict=True))
            assert 0 < int((native[-1] > 0).sum()) < 600


@pytest.mark.parametrize("backend", installed_backends())
def test_operators_keep_the_rules_of_torch(backend: str) -> None:
    points = torch.rand(30, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    ptr = torch.tensor([0, 10, 30])
    checks = ("test_schema", "test_faketensor", "test_autograd_registration")
    torch.library.opcheck(
        torch.ops.tensor_stereo.delaunay_graph.default, (points, ptr, None, 1e-3, backend), test_utils=checks
    )
    torch.library.opcheck(
        torch.ops.tensor_stereo.match_graphs.default,
        (points, points, ptr, points[:, 0], None, 1e-3, backend),
        test_utils=checks,
    )


@pytest.mark.parametrize("backend", installed_backends())
def test_operators_compile_without_a_graph_break(backend: str) -> None:
    def degrees(points: torch.Tensor, ptr: torch.Tensor) -> torch.Tensor:
        crow, _ = delaunay_graph(points, ptr, None, 1e-3, backend)
        return crow.diff() * 2

    points = torch.rand(30, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    ptr = torch.tensor([0, 10, 30])
    compiled = torch.compile(degrees, fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(points, ptr), degrees(points, ptr))


def test_there_is_no_gradient() -> None:
    points = torch.rand(9, 2, requires_grad=True)
    crow, cols = delaunay_graph(points, torch.tensor([0, 9]), None, 1e-3, "auto")
    assert not crow.requires_grad
    assert not cols.requires_grad
