"""The network is what whole (M, M) arrays in float64 say, for random weights and for those of the package."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tensor_stereo.batching import lengths_to_ptr
from tensor_stereo.configs import FilterConfig
from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.scores import learned
from tensor_stereo.scores.image_evidence import ImageEvidence
from tensor_stereo.scores.learned import LearnedScore, learned_probabilities, load_learned, score_learned
from tensor_stereo.scores.learned_inputs import Quantities, measure_quantities
from tensor_stereo.scores.tolerance import TOLERANCES_PX, probability_within
from tensor_stereo.types import Adjacency, Matches
from tests.scores.learned_oracle import calibrate, infer, random_evidence, random_pairs, see, weights_of

# Quantities differ by some 1e-5 (test_learned_inputs.py). The weights below keep the gain of each layer near one,
# LayerNorm that of a round: the logits, which are of size one, differ as little. A step that is left out, a wrong sign
# or another constant changes some of them by far more.
ATOL = 1e-4


def random_network(seed: int, num_rounds: int = 3) -> LearnedScore:
    """All numbers random: no path is unseen because its weights are zero, no normalisation does nothing."""
    rng = torch.Generator().manual_seed(seed)
    network = LearnedScore(width=10, edge_width=6, num_rounds=num_rounds)
    state = {}
    for name, values in network.state_dict().items():
        noise = torch.randn(values.shape, generator=rng)
        if values.ndim == 2:
            state[name] = noise * 1.4 / values.shape[1] ** 0.5
        else:
            offset = 1.0 if name.endswith(("_scale", "norm.weight")) else 0.0
            state[name] = offset + 0.3 * noise
    state["calibration"] = torch.tensor([[0.7, -0.4], [0.9, 0.1], [0.8, -0.2], [1.1, 0.3], [0.7, 0.5]])
    network.load_state_dict(state)
    return network.eval().requires_grad_(False)


def assert_same(
    network: LearnedScore, matches: Matches, evidence: ImageEvidence | None = None, graphs: MatchGraphs | None = None
) -> None:
    graphs = graphs or build_match_graphs(matches)
    seen = see(matches, evidence, graphs)
    logit, beliefs = network.infer(measure_quantities(matches, graphs, evidence))
    expected, between = infer(weights_of(network), seen, len(network.rounds))
    np.testing.assert_allclose(torch.stack(beliefs), between, rtol=0, atol=ATOL)
    np.testing.assert_allclose(logit, expected, rtol=0, atol=ATOL)
    again, probability = network(matches, graphs, evidence)
    assert torch.equal(again, logit)
    np.testing.assert_allclose(probability, calibrate(weights_of(network), expected), rtol=0, atol=ATOL)


@pytest.mark.parametrize("shown", ["cost", "images", "both", "some images", "nothing"])
@pytest.mark.parametrize("seed", range(4))
def test_random_weights(seed: int, shown: str) -> None:
    matches = random_pairs(seed, (26, 0, 1, 34), whole=seed % 2 == 1)
    evidence = None
    if shown in ("images", "both", "some images"):
        evidence = random_evidence(seed, matches, seen=0.5 if shown == "some images" else 1.0)
    if shown in ("images", "nothing"):
        matches = replace(matches, cost=None)
    assert_same(random_network(seed), matches, evidence)


@pytest.mark.parametrize("num_rounds", [1, 2, 4])
def test_planes_enter_from_the_third_round_on(num_rounds: int) -> None:
    network = random_network(9, num_rounds)
    assert [messages.plane for messages in network.rounds] == [False, False, True, True][:num_rounds]
    assert_same(network, random_pairs(9), random_evidence(9, random_pairs(9)))


def test_neighbors_many_mean_distances_away() -> None:
    matches = random_pairs(3, (40,))
    side = torch.arange(40) % 2
    far = side[:, None] * torch.tensor([300.0, 200.0], dtype=torch.float64)
    moved = [view / 30 + far for view in (matches.keypoints0, matches.keypoints1)]
    matches = replace(matches, keypoints0=moved[0], keypoints1=moved[1])
    linked = (side[:, None] == side).fill_diagonal_(False)  # two crowds, and two edges between them
    for i, j in ((4, 7), (9, 12)):  # there and back
        linked[i, j] = linked[j, i] = True
    crow, col = lengths_to_ptr(linked.sum(1)), linked.nonzero()[:, 1]
    adjacency = Adjacency(crow, col, matches.ptr)
    graphs = MatchGraphs(adjacency, adjacency, torch.full((40,), 40))
    step = see(matches, graphs=graphs).step
    assert (step[4, 7] > 4).all()
    assert (step[9, 12] < -4).all()
    for seed in range(3):
        assert_same(random_network(seed), matches, graphs=graphs)


def test_untrained_network_needs_no_calibration() -> None:
    logit = torch.linspace(-3, 3, 35).reshape(7, 5)
    assert torch.equal(LearnedScore().calibrate(logit), logit.sigmoid())


def test_doubted_neighbors_leave_the_plane_at_the_match() -> None:
    matches = random_pairs(4, (30,))
    for belief in (-12.0, -3.0, 12.0):
        network = random_network(4)
        network.rounds[2].belief.bias.fill_(belief)
        assert_same(network, matches)


@pytest.mark.parametrize("shown", [True, False])
def test_gradients_are_the_central_differences_of_the_definition(shown: bool) -> None:
    matches = random_pairs(6, (24,))
    evidence = random_evidence(6, matches) if shown else None
    network, graphs = random_network(6), build_match_graphs(matches)
    leaf = torch.cat([matches.keypoints0, matches.keypoints1], 1).requires_grad_()
    moved = replace(matches, keypoints0=leaf[:, :2], keypoints1=leaf[:, 2:])
    network(moved, graphs, evidence)[0].sum().backward()
    weights = weights_of(network)

    def total(points: torch.Tensor) -> float:
        given = replace(matches, keypoints0=points[:, :2], keypoints1=points[:, 2:])
        return float(infer(weights, see(given, evidence, graphs))[0].sum())

    for row, column in [(0, 0), (3, 1), (7, 2), (11, 3), (15, 0), (19, 1), (21, 2), (23, 3)]:
        step = torch.zeros_like(matches.keypoints0).repeat(1, 2)
        step[row, column] = 1e-6
        with torch.no_grad():
            slope = (total(leaf + step) - total(leaf - step)) / 2e-6
        assert float(leaf.grad[row, column]) == pytest.approx(slope, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("shown", [True, False])
def test_weights_of_the_package_run_by_run(shown: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = []

    def measure(matches: Matches, *rest: object) -> Quantities:
        sizes.append(matches.num_matches)
        return measure_quantities(matches, *rest)

    monkeypatch.setattr(learned, "_MATCHES_AT_ONCE", 40)
    monkeypatch.setattr(learned, "measure_quantities", measure)
    matches = random_pairs(8, (25, 15, 1, 45, 2, 0, 3))
    evidence = random_evidence(8, matches, seen=0.7) if shown else None
    for given in (matches, replace(matches, cost=None)):
        seen, network = see(given, evidence), load_learned()
        logit, _ = infer(weights_of(network), seen)
        found = learned_probabilities(given, build_match_graphs(given), evidence, FilterConfig(backend="scipy"))
        # these weights tell by disparities: a logit changes by up to 10 times the difference of a quantity
        np.testing.assert_allclose(found, calibrate(weights_of(network), logit), rtol=0, atol=1e-3)
    assert sizes == [40, 1, 45, 5] * 2


def test_no_pairs_have_no_score() -> None:
    matches = random_pairs(0, ())
    graphs = build_match_graphs(matches)
    score = score_learned(matches, graphs)
    assert score.shape == (0,)
    assert score.dtype == torch.float32
    assert learned_probabilities(matches, graphs).shape == (0, 5)


@pytest.mark.parametrize("max_error_px", [0.5, 1.0, 1.25, 4.0, 5.0])
def test_the_score_is_the_probability_at_the_tolerance_of_the_settings(max_error_px: float) -> None:
    matches = random_pairs(2)
    graphs, config = build_match_graphs(matches), FilterConfig(max_error_px=max_error_px)
    score = score_learned(matches, graphs, config=config, network=random_network(2))
    cumulative = learned_probabilities(matches, graphs, config=config, network=random_network(2))
    assert (cumulative.diff(dim=1) >= 0).all()
    assert torch.equal(score, probability_within(cumulative, max_error_px))
    table = [np.interp(max_error_px, TOLERANCES_PX, row) for row in cumulative.double().numpy()]
    np.testing.assert_allclose(score, table, rtol=0, atol=1e-6)
