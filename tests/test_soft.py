"""The soft score against its definition, its limits and its gradient."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import assume, example, given
from hypothesis import strategies as st

import tensor_stereo as ts
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.relations import shared_neighbors
from tensor_stereo.soft import (
    LinkGeometry,
    SoftCounts,
    build_soft_graphs,
    count_soft_neighbors,
    dual_critical_points,
    dual_edge_length,
    soft_adjacency,
    soft_jaccard,
    soft_overlap,
    sum_soft_adjacency,
)
from tests.oracles import installed_backends
from tests.point_sets import GENERATORS, distinct_points

KINDS = sorted(GENERATORS)
BACKENDS = installed_backends()


def _matches(kind: str, seed: int, n: int, wrong: float = 0.4) -> ts.Matches:
    """Two views that differ in some points."""
    left = distinct_points(kind, seed, n)
    right = left.copy()
    rng = np.random.default_rng(seed)
    moved = np.flatnonzero(rng.random(len(left)) < wrong)
    right[moved] = right[rng.permutation(moved)]
    return ts.Matches(torch.from_numpy(left), torch.from_numpy(right), torch.tensor([0, len(left)]))


def _counts(matches: ts.Matches, temperature: float, unit: str = "edge", backend: str = "auto") -> SoftCounts:
    found = build_soft_graphs(matches, temperature, unit=unit, backend=backend)
    adjacencies = [
        soft_adjacency(points, found.links, view, temperature, unit=unit, backend=backend)
        for points, view in ((matches.keypoints0, found.view0), (matches.keypoints1, found.view1))
    ]
    return sum_soft_adjacency(*adjacencies, found.links, matches.num_matches)


def _length_by_definition(points: np.ndarray, i: int, j: int, bound: float) -> float:
    """hi - lo of the bounds of t over all third points, in px; design of the power functions, point by point."""
    a, b = points[i], points[j]
    length = math.dist(a, b)
    middle, normal = (a + b) / 2, np.array([a[1] - b[1], b[0] - a[0]]) / length
    low, high = -bound * length, bound * length
    for k in range(len(points)):
        if k in (i, j):
            continue
        slope = 2 * normal @ (middle - points[k])
        offset = (middle - points[k]) @ (middle - points[k]) - (middle - a) @ (middle - a)
        if slope > 0:
            low = max(low, -offset / slope)
        else:
            high = min(high, -offset / slope)
    return float(max(high, -bound * length) - min(low, bound * length))


@pytest.mark.parametrize("backend", BACKENDS)
@given(st.integers(0, 10**6), st.integers(3, 25), st.sampled_from(["edge", "px"]), st.sampled_from([0.3, 1.0, 4.0]))
@example(2840, 5, "edge", 0.3)
@example(198, 24, "edge", 0.3)
def test_counts_are_those_of_the_definition(backend: str, seed: int, n: int, unit: str, temperature: float) -> None:
    matches = _matches("uniform", seed, n)
    found = build_soft_graphs(matches, temperature, unit=unit, backend=backend)
    expected = np.zeros((n, 3))
    for i, j in found.links.tolist():
        soft = []
        for points in (matches.keypoints0.numpy(), matches.keypoints1.numpy()):
            edge, length = math.dist(points[i], points[j]), _length_by_definition(points, i, j, 1e3)
            if 0 < length <= 1e-3 * edge:  # no edge of the graph, by its tolerance
                length = -length
            scale = temperature * (edge if unit == "edge" else 1)
            soft.append(1 / (1 + math.exp(-min(max(length / scale, -40), 40))))
        for row in (i, j):
            expected[row] += (min(soft), *soft)
    counts = _counts(matches, temperature, unit, backend)
    assert torch.stack([counts.intersection, counts.degree0, counts.degree1], 1).numpy() == pytest.approx(
        expected, abs=2e-6 * n
    )  # links beyond the reach of 16 temperatures count as 40: 1.2e-7 each


@pytest.mark.parametrize("backend", BACKENDS)
@given(st.sampled_from(KINDS), st.integers(0, 10**6), st.integers(2, 30))
def test_limit_of_temperature_zero_is_the_hard_graph(backend: str, kind: str, seed: int, n: int) -> None:
    matches = _matches(kind, seed, n)
    found = build_soft_graphs(matches, backend=backend)
    for points, view in ((matches.keypoints0, found.view0), (matches.keypoints1, found.view1)):
        length = dual_edge_length(points, found.links, view.critical, backend=backend)
        edge = (points[found.links[:, 0]] - points[found.links[:, 1]]).norm(dim=1)
        assume(bool((length.abs() > 1e-6 * edge).all()))
    counts = _counts(matches, 1e-8, backend=backend)
    graphs = build_match_graphs(matches, backend=backend)
    hard = shared_neighbors(graphs.adjacency0, graphs.adjacency1, backend=backend)
    assert counts.intersection.numpy() == pytest.approx(hard.overlap.numpy(), abs=1e-12)
    assert counts.degree0.numpy() == pytest.approx(hard.degree0.numpy(), abs=1e-12)
    assert counts.degree1.numpy() == pytest.approx(hard.degree1.numpy(), abs=1e-12)


@given(st.sampled_from(KINDS), st.integers(0, 10**6), st.integers(2, 30))
def test_limits_of_the_scores_are_the_restrictions(kind: str, seed: int, n: int) -> None:
    matches = _matches(kind, seed, n)
    counts = _counts(matches, 1e-8)
    for restriction, score in (("adjacency", soft_jaccard(counts)), ("cardinality", soft_overlap(counts))):
        verdict = ts.classify_matches(matches, restriction=restriction, min_group_size=1)
        tested = verdict.relation != ts.Relation.UNTESTED
        sure = (score < 0.4) | (score > 1 - 1e-9)  # in between lie ties, which count half
        assert torch.equal((score > 1 - 1e-9)[tested & sure], verdict.inlier[tested & sure])


@given(st.sampled_from(KINDS), st.integers(0, 10**6), st.integers(1, 30))
def test_equal_views_agree_fully_at_any_temperature(kind: str, seed: int, n: int) -> None:
    matches = _matches(kind, seed, n, wrong=0)
    score = soft_jaccard(_counts(matches, 1.0))
    assert torch.equal(score, torch.full((matches.num_matches,), float(matches.num_matches > 1), dtype=torch.float64))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("unit", ["edge", "px"])
@pytest.mark.parametrize("n", [4, 9, 25])
def test_gradient_equals_finite_differences_in_general_position(backend: str, unit: str, n: int) -> None:
    generator = torch.Generator().manual_seed(n)
    left, right = (torch.rand(n, 2, dtype=torch.float64, generator=generator) * 10 for _ in range(2))
    ptr = torch.tensor([0, n])
    found = build_soft_graphs(ts.Matches(left, right, ptr), unit=unit, backend=backend)
    assert bool((found.view0.critical == -1).any())  # hull edges are among them

    def score(k0: torch.Tensor, k1: torch.Tensor, temperature: torch.Tensor) -> torch.Tensor:
        adjacencies = [
            soft_adjacency(points, found.links, view, temperature, unit=unit, link_ptr=found.link_ptr, backend=backend)
            for points, view in ((k0, found.view0), (k1, found.view1))
        ]
        counts = sum_soft_adjacency(*adjacencies, found.links, n)
        return torch.cat([soft_jaccard(counts), soft_overlap(counts)])

    temperature = torch.tensor(1.3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(score, (left.requires_grad_(), right.requires_grad_(), temperature))

    def fused(k0: torch.Tensor, k1: torch.Tensor, temperature: torch.Tensor) -> torch.Tensor:
        counts = count_soft_neighbors(ts.Matches(k0, k1, ptr), found, temperature, unit=unit, backend=backend)
        return torch.cat([soft_jaccard(counts), soft_overlap(counts)])

    assert torch.autograd.gradcheck(fused, (left, right, temperature))
    assert torch.allclose(fused(left, right, temperature), score(left, right, temperature), rtol=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
def test_length_has_a_gradient_to_all_four_points_without_hull_edges(backend: str) -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(40, 2, dtype=torch.float64, generator=generator)
    ptr = torch.tensor([0, 40])
    links = build_soft_graphs(ts.Matches(points, points, ptr)).links
    critical = dual_critical_points(points, ptr, links, backend=backend)
    inner = (critical >= 0).all(1)
    links, critical = links[inner], critical[inner]
    assert torch.autograd.gradcheck(
        lambda p: dual_edge_length(p, links, critical, backend=backend), points.requires_grad_()
    )


@pytest.mark.parametrize("backend", BACKENDS)
@given(
    st.sampled_from(KINDS),
    st.integers(0, 10**6),
    st.integers(1, 30),
    st.sampled_from(["edge", "px"]),
    st.sampled_from([1e-6, 1e-2, 1.0, 1e3]),
    st.sampled_from([0.0, 1e-3]),
)
def test_gradients_are_finite_everywhere(
    backend: str, kind: str, seed: int, n: int, unit: str, temperature: float, tie_tolerance: float
) -> None:
    matches = _matches(kind, seed, n)
    leaves = [points.clone().requires_grad_() for points in (matches.keypoints0, matches.keypoints1)]
    module = ts.DelaunayFilter(
        verdict="cardinality",
        score="topology",
        temperature=temperature,
        temperature_unit=unit,
        learnable_temperature=True,
        min_group_size=1,
        tie_tolerance=tie_tolerance,
        backend=backend,
    )
    output = module(ts.Matches(*leaves, matches.ptr))
    assert bool(((output.score >= 0) & (output.score <= 1)).all())
    output.score.sum().backward()
    for leaf in (*leaves, module.log_temperature):
        assert leaf.grad is not None
        assert bool(leaf.grad.isfinite().all())


@pytest.mark.skipif("native" not in BACKENDS, reason="the native kernels are not installed")
@pytest.mark.parametrize("kind", ["grid_8px", "grid_tenth", "rotated_grid", "uniform", "dense_integers"])
def test_back_ends_give_the_same_gradient(kind: str) -> None:
    matches = _matches(kind, 3, 60)
    gradients = []
    for choice in ("native", "scipy"):
        leaf = matches.keypoints1.clone().requires_grad_()
        ts.DelaunayFilter(verdict="cardinality", score="topology", backend=choice)(
            ts.Matches(matches.keypoints0, leaf, matches.ptr)
        ).score.square().sum().backward()
        gradients.append(leaf.grad)
    scale = gradients[0].abs().max().item()
    assert torch.allclose(*gradients, rtol=1e-6, atol=1e-6 * scale)  # a tie of 1e-9 may be off by 1e-15


def test_rounding_does_not_turn_the_gradient_of_correct_matches() -> None:
    left = torch.rand(300, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 100
    ptr = torch.tensor([0, 300])
    for noise in (0.0, 1e-12):
        right = (left - 5 + noise * torch.sin(torch.arange(600.0, dtype=torch.float64)).view(300, 2)).requires_grad_()
        ts.DelaunayFilter(verdict="cardinality", score="topology")(
            ts.Matches(left, right, ptr)
        ).score.square().sum().backward()
        assert float(right.grad.abs().max()) < 1e-2  # no direction is better; before, rounding chose one of size 1


def test_a_second_derivative_is_refused() -> None:
    matches = _matches("uniform", 0, 12)
    for backend in BACKENDS:
        leaf = matches.keypoints1.clone().requires_grad_()
        score = ts.DelaunayFilter(verdict="cardinality", score="topology", backend=backend)(
            ts.Matches(matches.keypoints0, leaf, matches.ptr)
        ).score.sum()
        (gradient,) = torch.autograd.grad(score, leaf, create_graph=True)
        with pytest.raises(NotImplementedError, match="twice"):
            gradient.square().sum().backward()


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")  # torch's own forward mode
def test_forward_mode_is_refused() -> None:
    matches = _matches("uniform", 0, 12)
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(matches.keypoints1, torch.ones_like(matches.keypoints1))
        with pytest.raises(NotImplementedError, match="keypoints"):
            ts.DelaunayFilter(verdict="cardinality", score="topology")(
                ts.Matches(matches.keypoints0, dual, matches.ptr)
            )


@pytest.mark.parametrize("backend", BACKENDS)
def test_large_co_circular_polygons_take_no_cubic_time(backend: str) -> None:
    corners = [(x, y) for x in range(-1105, 1106) for y in range(-1105, 1106) if x * x + y * y == 1105**2]
    assert len(corners) == 108
    points = torch.tensor(corners, dtype=torch.float64)
    found = build_soft_graphs(ts.Matches(points, points, torch.tensor([0, 108])), backend=backend)
    assert len(found.links) == 108  # the sides alone: its 5670 chords are not listed


@pytest.mark.parametrize("temperature", [0.0, -1.0, math.nan, math.inf, 1e-200])
def test_a_temperature_out_of_range_is_refused(temperature: float) -> None:
    matches = _matches("uniform", 0, 6)
    with pytest.raises(ValueError, match="temperature"):
        build_soft_graphs(matches, temperature)
    with pytest.raises(ValueError, match="temperature"):
        count_soft_neighbors(matches, build_soft_graphs(matches), temperature)
    with pytest.raises(ValueError, match="temperature"):
        count_soft_neighbors(matches, build_soft_graphs(matches), torch.full((1,), temperature))


def test_bad_links_and_tolerances_are_refused() -> None:
    points, critical = torch.rand(3, 2), torch.tensor([[-1, 2]])
    with pytest.raises(ValueError, match="rows 0"):
        dual_edge_length(points, torch.tensor([[0, 9]]), critical)
    with pytest.raises(ValueError, match="tie_tolerance"):
        dual_edge_length(points, torch.tensor([[0, 1]]), critical, tie_tolerance=-3.0)
    with pytest.raises(ValueError, match="keypoints"):
        dual_edge_length(torch.rand(3, 3), torch.tensor([[0, 1]]), critical)


def test_the_two_diagonals_of_a_flip_change_places_without_a_jump() -> None:
    left = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0], [2.0, 9.0], [-5.0, 1.0]], dtype=torch.float64)
    diagonals, edges = [], []
    for shift in (-0.2, -1e-9, 0.0, 1e-9, 0.2):
        moved = left.clone()
        moved[2, 0] += shift
        found = build_soft_graphs(ts.Matches(moved, left.flip(0), torch.tensor([0, 6])), tie_tolerance=0)
        adjacency = soft_adjacency(moved, found.links, found.view0, tie_tolerance=0)
        place = {tuple(link): k for k, link in enumerate(found.links.tolist())}
        diagonals.append(adjacency[[place[0, 2], place[1, 3]]])
        edges.append(found.links[found.view0.is_edge].tolist())
    first, last = ([[0, 2] in e, [1, 3] in e] for e in (edges[0], edges[-1]))
    assert first != last  # they do change places
    assert sum(first) == sum(last) == 1
    for near in diagonals[1:4]:
        assert torch.allclose(near, torch.full_like(near, 0.5), atol=1e-8)
    assert float((diagonals[0] - 0.5).abs().min()) > 1e-3  # they do move


def test_no_neighbour_scores_zero() -> None:
    zero, one = torch.zeros(1), torch.ones(1)
    assert soft_jaccard(SoftCounts(zero, zero, zero, zero)).item() == 0
    assert soft_overlap(SoftCounts(zero, one, zero, one)).item() == 0


def test_half_precision_keypoints_are_refused() -> None:
    points = torch.rand(3, 2)
    tie = LinkGeometry(torch.tensor([[-1, 2]]), torch.tensor([True]))
    for dtype in (torch.float16, torch.bfloat16):
        with pytest.raises(TypeError, match="keypoints"):
            soft_adjacency(points.to(dtype), torch.tensor([[0, 1]]), tie)
        with pytest.raises(TypeError, match="keypoints0"):
            ts.DelaunayFilter(verdict="cardinality", score="topology")(points[None].to(dtype), points[None].to(dtype))


def test_unknown_unit_is_refused() -> None:
    matches = _matches("uniform", 0, 5)
    with pytest.raises(ValueError, match="unit"):
        build_soft_graphs(matches, unit="cm")  # type: ignore[arg-type]
