from __future__ import annotations

import dataclasses
import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.autograd import forward_ad

from tensor_stereo import ConsensusConfig, FilterConfig, Matches
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.scores.alignment.form import Alignment, no_alignment
from tensor_stereo.scores.calibration import calibrate_consensus
from tensor_stereo.scores.consensus import consensus_belief, consensus_probabilities, consensus_score
from tensor_stereo.scores.tolerance import probability_within
from tests.oracles import installed_backends

BACKENDS = installed_backends()


def _matches(seed: int, num_matches: int, *, whole: bool = False) -> Matches:
    rng = torch.Generator().manual_seed(seed)
    left, other = (torch.rand(num_matches, 2, generator=rng, dtype=torch.float64) * 300 for _ in range(2))
    shift = torch.stack([20 + 0.1 * left[:, 0] + 0.02 * left[:, 1], torch.zeros(num_matches)], 1)
    right = torch.where(torch.rand(num_matches, 1, generator=rng) < 0.3, other, left - shift)
    if whole:
        left, right = left.round(), right.round()
    cost = torch.rand(num_matches, generator=rng, dtype=torch.float64)
    return Matches(left, right, torch.tensor([0, num_matches // 3, num_matches]), cost)


def _belief(matches: Matches, backend: str, alignment: Alignment | None = None, **settings: float) -> torch.Tensor:
    config = FilterConfig(consensus=ConsensusConfig(**settings), backend=backend)  # type: ignore[arg-type]
    return consensus_belief(matches, build_match_graphs(matches), config, alignment)


@pytest.mark.parametrize("backend", BACKENDS)
@given(st.integers(0, 10**6), st.integers(1, 60), st.booleans())
def test_order_shift_and_exchange_of_views_change_nothing(backend: str, seed: int, n: int, whole: bool) -> None:
    matches = _matches(seed, n, whole=whole)
    if whole:  # which duplicate is kept depends on the order, for equal costs
        matches = dataclasses.replace(matches, cost=torch.arange(n, dtype=torch.float64) / n)
    score = _belief(matches, backend)
    assert score.min() >= 0
    assert score.max() <= 1
    bounds = matches.ptr.tolist()
    rng = torch.Generator().manual_seed(seed)
    order = torch.cat([a + torch.randperm(b - a, generator=rng) for a, b in itertools.pairwise(bounds)])
    shuffled = Matches(matches.keypoints0[order], matches.keypoints1[order], matches.ptr, matches.cost[order])
    moved = dataclasses.replace(matches, keypoints0=matches.keypoints0 + 1024, keypoints1=matches.keypoints1 + 1024)
    for other, expected in ((shuffled, score[order]), (moved, score), (matches.swap(), score)):
        torch.testing.assert_close(_belief(other, backend), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("settings", [ConsensusConfig(slope=0.3), ConsensusConfig(row_tolerance_px=2)])
def test_the_score_is_the_calibrated_belief_of_its_own_settings(backend: str, settings: ConsensusConfig) -> None:
    matches, config = _matches(5, 60), FilterConfig(consensus=settings, backend=backend)  # type: ignore[arg-type]
    graphs = build_match_graphs(matches)
    belief, score = consensus_belief(matches, graphs, config), consensus_score(matches, graphs, config)
    cumulative = consensus_probabilities(matches, graphs, config)
    assert torch.equal(cumulative, calibrate_consensus(belief))
    assert torch.equal(score, cumulative[:, 1])
    wide = dataclasses.replace(config, max_error_px=2.5)
    assert torch.equal(consensus_score(matches, graphs, wide), probability_within(cumulative, 2.5))
    assert not torch.equal(belief, consensus_belief(matches, graphs))


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_quarter_turn_changes_nothing_where_no_row_is_known(backend: str) -> None:
    matches = _matches(0, 90)
    turn = torch.tensor([-1.0, 1.0])
    turned = dataclasses.replace(
        matches, keypoints0=matches.keypoints0.flip(1) * turn, keypoints1=matches.keypoints1.flip(1) * turn
    )
    no_rows = no_alignment(matches.num_pairs, matches.keypoints0, rectified=False)
    found, expected = (_belief(m, backend, no_rows) for m in (turned, matches))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
def test_equal_displacements_are_believed_and_equal_costs_say_nothing(backend: str) -> None:
    points = _matches(1, 90).keypoints0
    none = Matches(points, points - torch.tensor([7.0, 0.0]), torch.tensor([0, 30, 90]))
    equal = dataclasses.replace(none, cost=torch.full((90,), 5.0))
    assert _belief(none, backend).min() > 0.5
    torch.testing.assert_close(_belief(equal, backend), _belief(none, backend), rtol=0, atol=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_score_has_the_dtype_of_the_keypoints_and_finite_gradients(backend: str, dtype: torch.dtype) -> None:
    for points, cost in (
        (_matches(2, 50).keypoints0, torch.zeros(50)),
        (_matches(2, 50, whole=True).keypoints0, torch.ones(50)),
        (torch.zeros(50, 2), torch.rand(50)),
        (torch.zeros(0, 2), torch.zeros(0)),
    ):
        left, right = (points.to(dtype).requires_grad_(), (points + 3).to(dtype).requires_grad_())
        matches = Matches(left, right, torch.tensor([0, len(points)]), cost.to(dtype).requires_grad_())
        score = _belief(matches, backend)
        assert score.dtype == dtype
        for gradient in torch.autograd.grad(score.sum(), (left, right, matches.cost)):
            assert gradient.dtype == dtype
            assert gradient.isfinite().all()


def test_what_does_not_fit_is_refused() -> None:
    matches = _matches(3, 30)
    graphs = build_match_graphs(matches)
    with pytest.raises(ValueError, match="adjacency0 must have 30 nodes, got 12"):
        consensus_belief(matches, build_match_graphs(_matches(3, 12)))
    with pytest.raises(ValueError, match="adjacency1 must have 30 nodes, got 12"):
        consensus_belief(matches, graphs._replace(adjacency1=build_match_graphs(_matches(3, 12)).adjacency1))


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")  # torch's own forward mode
def test_a_tangent_is_refused_instead_of_dropped() -> None:
    matches = _matches(4, 30)
    graphs = build_match_graphs(matches)
    for name in ("keypoints0", "keypoints1", "cost"):
        values = getattr(matches, name)
        with forward_ad.dual_level():
            dual = forward_ad.make_dual(values, torch.ones_like(values))
            with pytest.raises(NotImplementedError, match=f"{name} carries a tangent"):
                consensus_belief(dataclasses.replace(matches, **{name: dual}), graphs)


@pytest.mark.parametrize("backend", BACKENDS)
def test_costs_of_any_sign_are_evidence_and_infinite_ones_are_none(backend: str) -> None:
    matches = _matches(3, 60)
    assert matches.cost is not None
    below = dataclasses.replace(matches, cost=matches.cost - 5)
    least = dataclasses.replace(matches, cost=matches.cost - matches.cost.min())
    assert _belief(below, backend).isfinite().all()
    first = slice(0, 20)  # the pairs have their own least cost
    alone = [
        Matches(m.keypoints0[first], m.keypoints1[first], torch.tensor([0, 20]), m.cost[first]) for m in (below, least)
    ]
    alone[1] = dataclasses.replace(alone[1], cost=alone[0].cost - alone[0].cost.min())
    torch.testing.assert_close(_belief(alone[0], backend), _belief(alone[1], backend), rtol=0, atol=1e-12)
    endless = matches.cost.clone()
    endless[[3, 30]] = torch.tensor([torch.inf, 1.7e308], dtype=endless.dtype)
    found = _belief(dataclasses.replace(matches, cost=endless), backend, cost_weight=0.5)
    order = dataclasses.replace(matches, cost=(endless > 1e300).double())  # the same duplicates
    torch.testing.assert_close(found, _belief(order, backend, cost_weight=0.0), rtol=0, atol=1e-12)
