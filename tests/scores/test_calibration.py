"""Targets: what calibrated scores let expect, kept in every pair."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit, logit

import tensor_stereo as ts
from tensor_stereo.batching import collate_matches, split, split_matches
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.scores import calibration
from tensor_stereo.scores.calibration import calibrate_consensus, keep_by_target
from tensor_stereo.scores.consensus import consensus_belief
from tests.test_classification import random_pair

GRID = st.integers(0, 16).map(lambda k: k / 16)  # ties, sums and products of these are exact


def best_threshold(probability: list[float], wanted: str, target: float) -> list[bool]:
    """Every threshold tried: the one that keeps most of those that fulfil the target."""
    total = sum(1 - p for p in probability)
    kept = [False] * len(probability)
    for least in set(probability):
        these = [p >= least for p in probability]
        wrong = sum(1 - p for p, k in zip(probability, these, strict=True) if k)
        limit = (1 - target) * (total if wanted == "target_sensitivity" else sum(these))
        if wrong <= limit and sum(these) > sum(kept):
            kept = these
    return kept


@given(
    st.lists(st.lists(st.tuples(GRID, st.booleans()), max_size=12), max_size=5),
    st.sampled_from(["target_sensitivity", "min_precision"]),
    GRID,
)
def test_no_threshold_keeps_more_and_fulfils_the_target(
    pairs: list[list[tuple[float, bool]]], wanted: str, target: float
) -> None:
    rows = [row for pair in pairs for row in pair]
    probability = torch.tensor([p for p, _ in rows], dtype=torch.float64)
    tested = torch.tensor([t for _, t in rows], dtype=torch.bool)
    ptr = torch.tensor([0, *np.cumsum([len(pair) for pair in pairs])], dtype=torch.int64)
    kept = keep_by_target(probability, tested, ptr, **{wanted: target})
    assert not kept[~tested].any()
    for pair, found, seen in zip(pairs, split(kept, ptr), split(tested, ptr), strict=True):
        assert found[seen].tolist() == best_threshold([p for p, t in pair if t], wanted, target)


@given(st.integers(0, 10**6), st.sampled_from([0.5, 0.9, 0.96]))
def test_the_order_of_the_matches_does_not_matter(seed: int, target: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    probability = torch.rand(300, generator=generator, dtype=torch.float64)
    order, ptr = torch.randperm(300, generator=generator), torch.tensor([0, 300])
    tested = torch.rand(300, generator=generator) < 0.9
    for wanted in ("target_sensitivity", "min_precision"):
        kept = keep_by_target(probability, tested, ptr, **{wanted: target})
        assert torch.equal(keep_by_target(probability[order], tested[order], ptr, **{wanted: target}), kept[order])


def test_a_calibrated_score_reaches_its_target() -> None:
    """Truth drawn with the probabilities themselves: the law that calibration means."""
    generator = torch.Generator().manual_seed(3)
    probability = torch.rand(40_000, generator=generator, dtype=torch.float64)
    correct = torch.rand(40_000, generator=generator, dtype=torch.float64) < probability
    tested, ptr = torch.ones_like(correct), torch.tensor([0, 40_000])
    kept = keep_by_target(probability, tested, ptr, target_sensitivity=0.9)
    assert float((~kept & ~correct).sum() / (~correct).sum()) == pytest.approx(0.9, abs=4 * math.sqrt(0.09 / 20_000))
    kept = keep_by_target(probability, tested, ptr, min_precision=0.9)
    assert float(correct[kept].double().mean()) == pytest.approx(0.9, abs=4 * math.sqrt(0.09 / int(kept.sum())))


def test_calibration_is_a_logistic_regression_and_keeps_the_order() -> None:
    score = torch.linspace(0, 1, 10_001, dtype=torch.float64)
    for kind in (0, 1, 2):
        found = calibrate_consensus(score, torch.full(score.shape, kind))[:, 1].numpy()
        low, middle = found[[2000, 5000]]
        slope = (logit(middle) - logit(low)) / (logit(0.5) - logit(0.2))
        expected = expit(slope * logit(np.clip(score.numpy(), 1e-4, 1 - 1e-4)) + logit(middle))
        np.testing.assert_allclose(found, expected, rtol=0, atol=3e-6)  # linear between 2048 knots
        assert (np.diff(found[1:-1]) > 0).all()


@given(st.integers(1, 70), st.sampled_from([0, 1, 2, None]))
def test_a_probability_does_not_depend_on_the_length_of_its_vector(length: int, kind: int | None) -> None:
    generator = torch.Generator().manual_seed(length)
    belief = torch.rand(70, generator=generator, dtype=torch.float64)
    kinds = torch.randint(0, 3, (70,), generator=generator) if kind is None else torch.full((70,), kind)
    whole = calibrate_consensus(belief, kinds)
    assert torch.equal(calibrate_consensus(belief[:length], kinds[:length]), whole[:length])
    for k in range(3):  # each kind as if it were alone
        assert torch.equal(calibrate_consensus(belief, torch.full((70,), k))[kinds == k], whole[kinds == k])


def test_every_tolerance_has_its_own_regression_and_none_falls(monkeypatch: pytest.MonkeyPatch) -> None:
    table = ((0.9, -0.5), (0.7, 1.0), (0.6, 1.5), (0.5, 1.0), (0.4, 3.0))  # that of 3 px crosses that of 2 px
    monkeypatch.setattr(calibration, "_CONSENSUS", (table,) * 3)
    belief = torch.linspace(1e-4, 1 - 1e-4, 501, dtype=torch.float64)
    found = calibrate_consensus(belief)
    assert found.shape == (501, 5)
    assert (found.diff(dim=1) >= 0).all()
    expected = np.stack([expit(slope * logit(belief.numpy()) + bias) for slope, bias in table], 1)
    assert (np.diff(expected, axis=1) < 0).any()
    np.testing.assert_allclose(found, np.maximum.accumulate(expected, 1), rtol=0, atol=3e-6)


def test_calibration_has_the_slope_of_a_logistic_regression() -> None:
    belief = torch.tensor([1e-5, 1e-3, 0.2, 0.5, 0.9], dtype=torch.float64, requires_grad=True)
    probability = calibrate_consensus(belief)[:, 1]
    (slope,) = torch.autograd.grad(probability.sum(), belief)
    (at_one_px, _) = calibration._CONSENSUS[0][1]
    expected = at_one_px * probability * (1 - probability) / (belief * (1 - belief))  # in log-odds a straight line
    assert slope[0] == 0  # saturated
    torch.testing.assert_close(slope[1:], expected[1:].detach(), rtol=0.01, atol=0)


def test_the_module_aims_pair_by_pair() -> None:
    pairs = [random_pair("float", seed, n) for seed, n in enumerate((80, 0, 3, 200))]
    for settings in (
        {"min_precision": 0.9, "score": "consensus"},
        {"target_sensitivity": 0.8, "score": "consensus"},
        {"min_precision": 0.9},
    ):
        module = ts.DelaunayFilter(**settings)  # type: ignore[arg-type]
        output = module(collate_matches(pairs))
        alone = [module(one).inlier for one in split_matches(collate_matches(pairs))]
        assert torch.equal(output.inlier, torch.cat(alone))
        assert output.inlier.any()
        assert not output.inlier.all()


@pytest.mark.parametrize("wanted", ["target_sensitivity", "min_precision"])
def test_more_is_asked_fewer_are_kept(wanted: str) -> None:
    matches = random_pair("float", 5, 300)
    kept = [
        ts.DelaunayFilter(score="consensus", **{wanted: target})(matches).inlier for target in (0.0, 0.5, 0.9, 0.99)
    ]  # type: ignore[arg-type]
    for more, fewer in pairwise(kept):
        assert not (fewer & ~more).any()
    verdict = ts.classify_matches(matches)
    assert torch.equal(kept[0], verdict.relation != 0)
    assert kept[-1].sum() < kept[0].sum()


def test_pairs_that_are_not_rectified_have_a_calibration_of_their_own() -> None:
    matches = random_pair("float", 5, 300)
    output = ts.DelaunayFilter(score="consensus", rectified=False, min_precision=0.9)(matches)
    tested = output.relation != 0
    assert output.alignment is not None
    assert not output.alignment.rectified.any()
    belief = consensus_belief(matches, build_match_graphs(matches), alignment=output.alignment)
    kind = torch.where(output.alignment.has_rows, 1, 2).repeat_interleave(matches.ptr.diff())
    probability = calibrate_consensus(belief, kind)[:, 1].to(belief.dtype)
    assert torch.equal(output.score, torch.where(tested, probability, 0))
    assert torch.equal(output.inlier, keep_by_target(probability, tested, matches.ptr, min_precision=0.9))


def test_one_target_must_be_given() -> None:
    arguments = torch.ones(2), torch.ones(2, dtype=torch.bool), torch.tensor([0, 2])
    with pytest.raises(ValueError, match="give target_sensitivity or min_precision"):
        keep_by_target(*arguments)
    with pytest.raises(ValueError, match="give target_sensitivity or min_precision"):
        keep_by_target(*arguments, target_sensitivity=0.9, min_precision=0.9)
