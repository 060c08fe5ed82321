"""Both back ends give the same beliefs; least squares match by match says which are right."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo import Matches
from tensor_stereo.batching import select_pairs
from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.ops import consensus_belief, reference_consensus
from tests.oracles import installed_backends
from tests.point_sets import GENERATORS, distinct_points

NATIVE = pytest.mark.skipif("native" not in installed_backends(), reason="the native kernels are not installed")
DEFAULTS = (0.6, 1.0, 0.25, 1.5, 0.2, 2.0, 1.0, 0.5, 2)
OTHERS = (0.5, 2.0, 0.5, 1.0, 0.1, 1.5, 2.0, 0.0, 3)
SMOOTH = (0.6, 0.6, 0.25, 0.25, 0.2, 2.0, 1.0, 0.5, 2)  # without the step that the choice of the tolerance is


def _matches(seed: int, lengths: tuple[int, ...] = (200, 1, 0, 57, 2, 3), *, whole: bool = False) -> Matches:
    """Pairs of a sloped surface, 30 % of whose matches are wrong."""
    rng = torch.Generator().manual_seed(seed)
    count = sum(lengths)
    left, other = (torch.rand(count, 2, generator=rng, dtype=torch.float64) * 300 for _ in range(2))
    shift = torch.stack([20 + 0.1 * left[:, 0] + 0.02 * left[:, 1], torch.randn(count, generator=rng) / 5], 1)
    right = torch.where(torch.rand(count, 1, generator=rng) < 0.3, other, left - shift)
    if whole:
        left, right = left.round(), right.round()
    cost = torch.rand(count, generator=rng, dtype=torch.float64) * 1000
    return Matches(left, right, torch.tensor([0, *lengths]).cumsum(0), cost)


def _arguments(matches: Matches, graphs: MatchGraphs | None = None) -> tuple[Any, ...]:
    graph0, graph1, _ = build_match_graphs(matches) if graphs is None else graphs
    patterns = graph0.crow_indices, graph0.col_indices, graph1.crow_indices, graph1.col_indices
    row_shift = 0.5 + 0.01 * matches.keypoints0[:, 0].double()
    row_offset = matches.keypoints0[:, 1].double() - matches.keypoints1[:, 1].double() + row_shift
    return matches.keypoints0, matches.keypoints1, matches.ptr, matches.cost, row_offset, None, *patterns


def _assert_same(matches: Matches, settings: tuple[Any, ...]) -> None:
    _assert_same_of(_arguments(matches), settings)
    arguments = list(_arguments(matches))
    arguments[4], arguments[5] = None, matches.keypoints0  # no rows, another grid
    _assert_same_of(tuple(arguments), settings)


def _assert_same_of(arguments: tuple[Any, ...], settings: tuple[Any, ...]) -> None:
    native, plain = (consensus_belief(*arguments, *settings, backend) for backend in ("native", "scipy"))
    assert native.dtype == plain.dtype == torch.float64
    # Exponentials that differ in the last bits; beliefs near zero are products of many.
    torch.testing.assert_close(native, plain, rtol=1e-12, atol=1e-14)


@NATIVE
@pytest.mark.parametrize("settings", [DEFAULTS, OTHERS, (*DEFAULTS[:-1], 0)])
@pytest.mark.parametrize("whole", [False, True])
def test_kernel_equals_plain_torch(whole: bool, settings: tuple[Any, ...]) -> None:
    for seed in range(5):
        matches = _matches(seed, whole=whole)
        group = torch.arange(matches.num_matches) % 3
        points = matches.keypoints0, matches.keypoints1, matches.ptr
        _assert_same(matches, settings)
        _assert_same(Matches(*points), settings)
        _assert_same(Matches(*points, matches.cost.float(), group), settings)
        _assert_same(Matches(*(p.float() for p in points[:2]), matches.ptr, torch.zeros_like(matches.cost)), settings)


@NATIVE
def test_kernel_equals_plain_torch_on_duplicate_and_few_matches() -> None:
    for lengths in ((), (0,), (1,), (2, 0, 1)):
        _assert_same(_matches(0, lengths), DEFAULTS)
    matches = _matches(1, (40, 40))
    same = torch.arange(80) // 4
    _assert_same(Matches(matches.keypoints0[same], matches.keypoints1[same], matches.ptr, matches.cost), DEFAULTS)
    origin = torch.zeros(80, 2)
    _assert_same(Matches(origin, origin, matches.ptr), DEFAULTS)


@NATIVE
@given(st.sampled_from(sorted(GENERATORS)), st.integers(0, 10**6), st.integers(1, 40))
def test_kernel_equals_plain_torch_on_degenerate_points(kind: str, seed: int, n: int) -> None:
    left = torch.from_numpy(distinct_points(kind, seed, n))
    right = left[torch.from_numpy(np.random.default_rng(seed).permutation(len(left)))]
    _assert_same(Matches(left, right, torch.tensor([0, len(left) // 3, len(left)])), DEFAULTS)


@pytest.mark.parametrize("backend", installed_backends())
@pytest.mark.parametrize("whole", [False, True])
def test_beliefs_are_those_of_least_squares_match_by_match(backend: str, whole: bool) -> None:
    matches = _matches(3, (60, 25), whole=whole)
    graphs = build_match_graphs(matches)
    belief = consensus_belief(*_arguments(matches, graphs), *DEFAULTS, backend)
    for start, stop in ((0, 60), (60, 85)):
        neighbors = [
            [[row - start for row in graph.neighbors(node).tolist()] for node in range(start, stop)]
            for graph in graphs[:2]
        ]
        views = [points[start:stop].numpy() for points in (matches.keypoints0, matches.keypoints1)]
        offset = _arguments(matches)[4][start:stop].numpy()
        expected = _believe(views, matches.cost[start:stop].numpy(), offset, neighbors)
        np.testing.assert_allclose(belief[start:stop].numpy(), expected, rtol=1e-9, atol=1e-15)


def _believe(
    views: list[np.ndarray], cost: np.ndarray, offset: np.ndarray, neighbors: list[list[list[int]]]
) -> np.ndarray:
    """The definition with the default settings: planes by numpy's least squares over stacked, weighted observations."""
    tolerance, whole_tolerance, row_tolerance, whole_row_tolerance, slope, reach, doubt, cost_weight, rounds = DEFAULTS
    columns = [view[:, k] for view in views for k in (0, 1)]
    *shares, last, moved_share = (float(abs(np.exp(2j * np.pi * x).mean())) for x in (*columns, columns[1] - offset))
    whole = math.prod(shares) * max(last, moved_share)
    sigma = (1 - whole) * tolerance + whole * whole_tolerance
    row_sigma = (1 - whole) * row_tolerance + whole * whole_row_tolerance
    level = np.log(cost + cost.mean() / 100)
    evidence = -np.log1p((offset / row_sigma) ** 2)
    evidence -= cost_weight * (level - level.mean()) / np.hypot(level.std(), 0.1)
    odds = np.exp(np.clip(evidence, -8, 8))
    middle, moved = (views[0] + views[1]) / 2 / sigma, (views[1] - views[0]) / sigma
    voters = [near0 + near1 for near0, near1 in zip(*neighbors, strict=True)]
    weights = []
    for node, (near0, near1) in enumerate(zip(*neighbors, strict=True)):
        squared = [
            ((view[k] - view[node]) ** 2).sum() for view, near in zip(views, (near0, near1), strict=True) for k in near
        ]
        weights.append(1 / (1 + np.array(squared) / (reach**2 * np.mean(squared))))
    belief = odds / (1 + odds)
    for _ in range(rounds):
        trust = [belief[near] * weight for near, weight in zip(voters, weights, strict=True)]
        planes = []
        for node, near in enumerate(voters):
            difference = moved[near] - moved[node]  # (K, 2)
            root = np.sqrt(trust[node] / (1 + (difference**2).sum(1)))[:, None]
            offsets = np.column_stack([np.ones(len(near)), middle[near] - middle[node]])
            prior = np.diag([1, 1 / slope, 1 / slope])  # the match itself, and flat slopes
            rows, values = np.vstack([root * offsets, prior]), np.vstack([root * difference, np.zeros((3, 2))])
            planes.append(np.linalg.lstsq(rows, values, rcond=None)[0])
        support = np.zeros_like(belief)
        for node, near in enumerate(voters):
            miss = [
                moved[k] + np.array([1, *(middle[node] - middle[k])]) @ planes[k] - moved[node]  # where k's plane is
                for k in near
            ]
            agreement = np.exp(-(np.array(miss) ** 2).sum(1) / 2)
            support[node] = (trust[node] * agreement).sum() / (trust[node].sum() + doubt)
        belief = support * odds / (support * odds + 1 - support)
    return belief


@NATIVE
@pytest.mark.parametrize("whole", [False, True])
def test_thread_count_and_batch_change_no_bit(whole: bool) -> None:
    matches = _matches(4, (3000, 0, 1, 4000, 2, 300), whole=whole)
    belief = consensus_belief(*_arguments(matches), *DEFAULTS, "native")
    before = torch.get_num_threads()
    try:
        for num_threads in (1, 2, 5):
            torch.set_num_threads(num_threads)
            assert torch.equal(consensus_belief(*_arguments(matches), *DEFAULTS, "native"), belief)
    finally:
        torch.set_num_threads(before)
    parts = [
        consensus_belief(*_arguments(select_pairs(matches, b, b + 1)), *DEFAULTS, "native")
        for b in range(matches.num_pairs)
    ]
    assert torch.equal(torch.cat(parts), belief)


@pytest.mark.parametrize("backend", installed_backends())
@pytest.mark.parametrize("has_cost", [False, True])
def test_gradients_are_those_of_plain_torch(backend: str, has_cost: bool) -> None:
    matches = _matches(5)
    fixed = _arguments(matches)
    inputs = [fixed[k] for k in ((0, 1, 4, 3) if has_cost else (0, 1, 4))]

    def gradients(function: Any) -> tuple[torch.Tensor, ...]:
        leaves = [values.clone().requires_grad_() for values in inputs]
        cost = leaves[3] if has_cost else None
        belief = function(*leaves[:2], matches.ptr, cost, leaves[2], *fixed[5:])
        weights = torch.linspace(-1, 1, len(belief), dtype=torch.float64)
        return torch.autograd.grad((weights * belief).sum(), leaves)

    ours = gradients(lambda *arguments: consensus_belief(*arguments, *DEFAULTS, backend))
    for got, expected in zip(
        ours, gradients(lambda *arguments: reference_consensus.consensus_belief(*arguments, *DEFAULTS)), strict=True
    ):
        assert torch.equal(got, expected)
        assert got.abs().sum() > 0


@pytest.mark.parametrize("backend", installed_backends())
def test_gradients_pass_through_keypoints_that_are_computed(backend: str) -> None:
    """As in every training loop: the second view follows from the first, and costs from both."""
    matches = _matches(6, (12, 8))
    keypoints0, keypoints1, ptr, cost, offset, found, *graphs = _arguments(matches)

    def believe(left: torch.Tensor, way: torch.Tensor) -> torch.Tensor:
        right = left + way
        asked = cost + (left - right).square().sum(1) - 300  # some below zero
        return consensus_belief(left, right, ptr, asked, offset, found, *graphs, *SMOOTH, backend)

    leaves = keypoints0.clone().requires_grad_(), (keypoints1 - keypoints0).requires_grad_()
    assert torch.autograd.gradcheck(believe, leaves)


@pytest.mark.parametrize("backend", installed_backends())
def test_beliefs_that_are_constant_have_gradient_zero(backend: str) -> None:
    keypoints0, keypoints1, ptr, _, _, found, *graphs = _arguments(_matches(6, (12, 8)))
    leaf = keypoints0.requires_grad_()
    settings = (*OTHERS[:-1], 0)
    belief = consensus_belief(leaf, keypoints1, ptr, None, None, found, *graphs, *settings, backend)
    assert belief.eq(0.5).all()
    if belief.requires_grad:
        belief.sum().backward()
    assert leaf.grad is None or leaf.grad.eq(0).all()


@pytest.mark.parametrize("backend", installed_backends())
def test_gradients_of_both_orders_are_those_of_finite_differences(backend: str) -> None:
    matches = _matches(6, (12, 8))
    keypoints0, keypoints1, ptr, cost, offset, found, *graphs = _arguments(matches)
    leaves = [values.clone().requires_grad_() for values in (keypoints0, keypoints1, cost, offset)]

    def believe(left: torch.Tensor, right: torch.Tensor, cost: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
        return consensus_belief(left, right, ptr, cost, offset, found, *graphs, *SMOOTH, backend)

    assert torch.autograd.gradcheck(believe, leaves)
    assert torch.autograd.gradgradcheck(believe, leaves)
    leaves[2] = (cost - 500).requires_grad_()  # costs below zero count from the least
    assert torch.autograd.gradcheck(believe, leaves)


@pytest.mark.parametrize("backend", installed_backends())
def test_gradients_reach_only_what_asks_for_them_and_keep_its_dtype(backend: str) -> None:
    keypoints0, keypoints1, ptr, cost, offset, found, *graphs = _arguments(_matches(7))
    leaf = keypoints1.float().requires_grad_()
    consensus_belief(keypoints0.float(), leaf, ptr, cost, offset, found, *graphs, *DEFAULTS, backend).sum().backward()
    assert leaf.grad.dtype == torch.float32
    assert leaf.grad.isfinite().all()
    assert not consensus_belief(
        keypoints0, keypoints1, ptr, cost, offset, found, *graphs, *DEFAULTS, backend
    ).requires_grad


@pytest.mark.slow  # compiles for ten seconds
@pytest.mark.parametrize("backend", installed_backends())
@pytest.mark.parametrize("has_cost", [False, True])
def test_operator_keeps_the_rules_of_torch_and_compiles(backend: str, has_cost: bool) -> None:
    left, right, ptr, cost, offset, found, *graphs = _arguments(_matches(8, (20, 9)))
    left, right = left.requires_grad_(), right.requires_grad_()
    arguments = (
        left,
        right,
        ptr,
        cost.requires_grad_() if has_cost else None,
        offset,
        found,
        *graphs,
        *DEFAULTS,
        backend,
    )
    torch.library.opcheck(torch.ops.tensor_stereo.consensus_belief.default, arguments)
    compiled = torch.compile(lambda: consensus_belief(*arguments) + 1, fullgraph=True, backend="aot_eager")
    found, expected = compiled(), consensus_belief(*arguments) + 1
    assert torch.equal(found, expected)
    for one, two in zip(*(torch.autograd.grad(value.sum(), (left, right)) for value in (found, expected)), strict=True):
        torch.testing.assert_close(one, two, rtol=1e-12, atol=1e-12)


@NATIVE
@pytest.mark.parametrize(
    ("position", "value", "message"),
    [
        (1, torch.zeros(3, 2), "same length"),
        (2, torch.tensor([0, 3]), "ptr must rise"),
        (3, torch.zeros(3), "cost must have"),
        (4, torch.zeros(3), "row_offset must have"),
        (5, torch.zeros(3, 2), "found1 must have"),
        (6, torch.tensor([0, 1]), "one row per match"),
        (8, torch.tensor([0, 2, 1, 1, 2]), "crow1 must rise"),
        (7, torch.tensor([1, 4]), "cols0 must name"),
        (9, torch.tensor([-1, 0]), "cols1 must name"),
        (18, -1, "num_rounds"),
    ],
)
def test_broken_input_is_refused(position: int, value: object, message: str) -> None:
    points, crow, cols = torch.rand(4, 2), torch.tensor([0, 1, 2, 2, 2]), torch.tensor([1, 0])
    arguments: list[Any] = [
        points,
        points,
        torch.tensor([0, 4]),
        None,
        None,
        None,
        crow,
        cols,
        crow,
        cols,
        *DEFAULTS,
        "native",
    ]
    assert consensus_belief(*arguments).shape == (4,)
    arguments[position] = value
    with pytest.raises(ValueError, match=message):
        consensus_belief(*arguments)
