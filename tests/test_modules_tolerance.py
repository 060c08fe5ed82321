"""One forward pass gives the probability at every tolerance."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import tensor_stereo as ts
from tensor_stereo.batching import collate_matches
from tensor_stereo.scores import TOLERANCES_PX, score_matches
from tests.interop.matchers import scene

SCORES = ("learned", "consensus")


def pairs(*, dtype: torch.dtype = torch.float32) -> ts.Matches:
    """A pair, one that is UNTESTED, an empty one, another."""
    parts = []
    for seed, count in enumerate((90, 3, 0, 60)):
        left, right = (points.to(dtype) for points in scene(seed, count))
        parts.append(ts.Matches(left, right, torch.tensor([0, count])))
    return collate_matches(parts)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("score", SCORES)
@given(max_error_px=st.floats(0.5, 5))
@settings(max_examples=10)
def test_it_is_the_score_of_that_tolerance_bit_for_bit(score: str, dtype: torch.dtype, max_error_px: float) -> None:
    matches = pairs(dtype=dtype)
    output = ts.DelaunayFilter(score=score)(matches)
    asked = ts.DelaunayFilter(score=score, max_error_px=max_error_px)(matches)
    assert output.score.dtype == output.probability(max_error_px).dtype == dtype
    assert torch.equal(asked.score, output.probability(max_error_px))
    assert torch.equal(asked.probability(1.0), output.score)
    tested = asked.relation != 0
    assert torch.equal(asked.inlier, tested & (asked.score >= 0.5))
    assert not output.probability(max_error_px)[~tested].any()
    assert (~tested).sum() >= 3


@pytest.mark.parametrize("score", SCORES)
def test_it_never_falls_with_the_tolerance(score: str) -> None:
    output = ts.DelaunayFilter(score=score)(pairs())
    assert output.cumulative.shape == (153, len(TOLERANCES_PX))
    steps = torch.linspace(0.5, 5, 91).tolist()
    found = torch.stack([output.probability(e) for e in steps])
    assert (found.diff(dim=0) >= 0).all()
    assert ((found >= 0) & (found <= 1)).all()


@pytest.mark.parametrize("score", SCORES)
def test_padding_is_zero_and_the_rest_as_in_the_ragged_batch(score: str) -> None:
    left, right = (torch.stack([scene(seed, 50)[view] for seed in range(3)]) for view in (0, 1))
    mask = torch.rand(3, 50, generator=torch.Generator().manual_seed(0)) < 0.8
    module = ts.DelaunayFilter(score=score)
    padded = module(left, right, mask)
    ragged = module(padded.matches)
    assert padded.cumulative.shape == (3, 50, 5)
    assert torch.equal(padded.cumulative[mask], ragged.cumulative)
    assert torch.equal(padded.probability(2.5)[mask], ragged.probability(2.5))
    assert not padded.probability(5)[~mask].any()
    one = module(left[0], right[0])
    assert one.cumulative.shape == (50, 5)
    assert one.probability(3).shape == one.score.shape == (50,)


@pytest.mark.parametrize("score", SCORES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_autocast_rounds_it_as_it_rounds_the_score(score: str, dtype: torch.dtype) -> None:
    module = ts.DelaunayFilter(score=score, max_error_px=2.5)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        low = module(pairs(dtype=dtype))
    assert low.score.dtype == low.probability(1).dtype == torch.bfloat16
    assert torch.equal(low.probability(2.5), low.score)


@pytest.mark.parametrize("score", SCORES)
def test_gradients_flow_from_every_tolerance(score: str) -> None:
    matches = pairs()
    right = matches.keypoints1.clone().requires_grad_()
    output = ts.DelaunayFilter(score=score)(ts.Matches(matches.keypoints0, right, matches.ptr))
    gradients = [torch.autograd.grad(output.probability(e).sum(), right, retain_graph=True)[0] for e in (0.5, 1, 4)]
    assert all(gradient.isfinite().all() and gradient.any() for gradient in gradients)
    assert not any(gradient[90:93].any() for gradient in gradients)  # untested
    assert torch.equal(gradients[1], torch.autograd.grad(output.score.sum(), right)[0])


def test_straight_through_concerns_the_score_alone() -> None:
    output = ts.DelaunayFilter(straight_through=True)(pairs())
    soft = ts.DelaunayFilter()(pairs())
    assert torch.equal(output.score, output.inlier.to(output.score.dtype))
    assert torch.equal(output.probability(1), soft.score)


@pytest.mark.parametrize("given", [{"verdict": "cardinality"}, {"verdict": "cardinality", "score": "none"}])
def test_what_is_no_probability_has_none(given: dict[str, str]) -> None:
    output = ts.DelaunayFilter(**given)(pairs())
    assert output.cumulative is None
    with pytest.raises(ValueError, match="score must be 'learned' or 'consensus'"):
        output.probability(1.0)


@pytest.mark.parametrize("max_error_px", [0.49, 5.01, float("nan")])
def test_other_tolerances_are_refused(max_error_px: float) -> None:
    with pytest.raises(ValueError, match=r"max_error_px must lie between 0\.5 and 5 px"):
        ts.DelaunayFilter()(pairs()).probability(max_error_px)
    with pytest.raises(ValueError, match="max_error_px must lie in"):
        ts.DelaunayFilter(max_error_px=max_error_px)


@pytest.mark.parametrize("score", SCORES)
def test_the_state_does_not_depend_on_the_tolerance(score: str) -> None:
    state = ts.DelaunayFilter(score=score).state_dict()
    wide = ts.DelaunayFilter(score=score, max_error_px=3)
    wide.load_state_dict(state)
    assert torch.equal(wide(pairs()).score, ts.DelaunayFilter(score=score)(pairs()).probability(3))


def test_score_matches_returns_what_the_scores_rest_on() -> None:
    matches = pairs()
    for score in SCORES:
        found = score_matches(matches, ts.FilterConfig(score=score, max_error_px=2))
        assert found.cumulative.shape == (153, 5)
        assert torch.equal(found.score, found.cumulative[:, 2])
        assert found.alignment.coefficients.shape == (4, 4)
        assert found.domain.shape == (4,)
    found = score_matches(matches, ts.FilterConfig(score="topology", threshold=0.5))
    assert found.cumulative is found.alignment is found.domain is None
    assert torch.equal(found.within(3), found.score)
