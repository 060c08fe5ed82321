from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tensor_stereo import DelaunayFilter, Matches
from tensor_stereo.batching import collate_matches
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.scores import measure_images
from tensor_stereo.scores.alignment import Alignment, align_matches, estimate_alignment, fit_alignment
from tensor_stereo.scores.alignment.form import no_alignment

SIZE = torch.tensor([450.0, 370.0], dtype=torch.float64)


def surface(
    seed: int,
    count: int = 600,
    wrong: float = 0.5,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    noise_px: float = 0.2,
    *,
    whole: bool = False,
) -> Matches:
    """Matches of two wavy surfaces, one before the other, some of them wrong; the last ones are right."""
    rng = torch.Generator().manual_seed(seed)
    left = torch.rand(count, 2, generator=rng, dtype=torch.float64) * SIZE
    left = left.round() if whole else left
    disparity = 20 + 10 * torch.sin(left[:, 0] / 80) + 15 * (left[:, 1] > 200)
    right = left - torch.stack([disparity, torch.zeros_like(disparity)], 1)
    right = right + torch.randn(count, 2, generator=rng, dtype=torch.float64) * noise_px
    right = right.round() if whole else right
    right[: int(wrong * count)] = torch.rand(int(wrong * count), 2, generator=rng, dtype=torch.float64) * SIZE
    return moved(Matches(left, right, torch.tensor([0, count])), shift)


def moved(matches: Matches, shift: tuple[float, float, float]) -> Matches:
    """The same with the rows of view 1 moved by a + b x + c y."""
    a, b, c = shift
    x, y = matches.keypoints0.unbind(1)
    rows = matches.keypoints1[:, 1] + a + b * x + c * y
    return replace(matches, keypoints1=torch.stack([matches.keypoints1[:, 0], rows], 1))


def estimate(matches: Matches) -> Alignment:
    return estimate_alignment(matches, build_match_graphs(matches))


@given(
    st.integers(0, 10**6),
    st.sampled_from([0.0, 0.5, 0.8]),
    st.floats(-100, 100),
    st.floats(-0.02, 0.02),
    st.floats(-0.02, 0.02),
)
@settings(max_examples=30)
def test_offset_and_drift_are_found_among_many_wrong_matches(
    seed: int, wrong: float, a: float, b: float, c: float
) -> None:
    matches = surface(seed, 800, wrong, (a, b, c))
    alignment = estimate(matches)
    assert alignment.fitted.all()
    x, y = matches.keypoints0.unbind(1)
    # the mean of 160 rows with noise of .2 px is off by .02 px; at the border four times as much, and .1 px is none
    right = slice(int(wrong * 800), None)
    assert (alignment.row_shift(matches) - (a + b * x + c * y))[right].abs().max() < 0.35


@given(st.integers(0, 10**6), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02))
@settings(max_examples=20)
def test_a_camera_that_is_turned_moves_near_and_far_surfaces_apart(seed: int, b: float, c: float, e: float) -> None:
    """View 1 is moved along its own columns and rows, and the baseline is not level: disparities from 5 to 130 px."""
    rng = torch.Generator().manual_seed(seed)
    left = torch.rand(800, 2, generator=rng, dtype=torch.float64) * SIZE
    disparity = torch.where(left[:, 0] < 225, 5 + left[:, 1] / 20, 130 - left[:, 0] / 20)
    right = torch.stack([left[:, 0] - disparity, left[:, 1] + e * disparity], 1)
    right[:, 1] += 4 + b * right[:, 0] + c * right[:, 1]
    right[:, 1] += 0.2 * torch.randn(800, generator=rng, dtype=torch.float64)
    rows = right[:, 1].clone()
    right[:240] = torch.rand(240, 2, generator=rng, dtype=torch.float64) * SIZE
    matches = Matches(left, right, torch.tensor([0, 800]))
    alignment = estimate(matches)
    assert alignment.fitted.all()
    miss = (rows - left[:, 1] - alignment.row_shift(matches))[240:]
    assert miss.abs().median() < 0.25  # of noise of .2 px .135 would be left by the true rows


@pytest.mark.parametrize("whole", [False, True])
def test_rows_that_agree_are_left_alone(whole: bool) -> None:
    for seed in range(5):
        alignment = estimate(surface(seed, 800, 0.4, noise_px=0.1, whole=whole))
        assert alignment.fitted.all()
        assert alignment.coefficients.eq(0).all()


def test_without_agreement_nothing_is_fitted() -> None:
    for matches in (
        surface(0, 300, 1.0),
        surface(0, 8, 0.0),
        surface(0, 0, 0.0),
        moved(surface(0, wrong=1.0), (5, 0, 0)),
    ):
        alignment = estimate(matches)
        assert not alignment.fitted.any()
        assert alignment.coefficients.eq(0).all()


def test_a_view_that_is_turned_does_not_fit() -> None:
    matches = surface(1, 600, 0.0)
    angle = torch.tensor(0.6, dtype=torch.float64)
    turn = torch.stack([torch.stack([angle.cos(), -angle.sin()]), torch.stack([angle.sin(), angle.cos()])])
    assert not estimate(replace(matches, keypoints1=matches.keypoints1 @ turn.T)).fitted.any()


def test_too_few_that_agree_and_rows_that_do_not_fit_are_told_apart() -> None:
    straight, random = surface(1, 600, 0.2), surface(0, 300, 1.0)
    steep = moved(surface(1, 600, 0.2), (0, 0.08, 0))
    alignment = estimate(collate_matches([straight, random, steep, surface(0, 0)]))
    assert alignment.fitted.tolist() == [True, False, False, False]
    assert alignment.unfit.tolist() == [False, False, True, False]
    assert (alignment.num_agreeing >= 12).tolist() == [True, False, True, False]


def test_the_fit_looks_at_the_chosen_matches_alone() -> None:
    matches = surface(2, 400, 0.5, (6, 0.01, 0.0))
    right = torch.arange(400) >= 200
    found = fit_alignment(matches, right)
    assert (found.fitted.item(), found.num_agreeing.item()) == (True, 200)
    shift = found.row_shift(matches)
    assert (shift - 6 - 0.01 * matches.keypoints0[:, 0])[right].abs().max() < 0.1
    right_alone = Matches(matches.keypoints0[200:], matches.keypoints1[200:], torch.tensor([0, 200]))
    alone = fit_alignment(right_alone, torch.ones(200, dtype=torch.bool))
    assert torch.equal(found.coefficients, alone.coefficients)
    assert not fit_alignment(matches, torch.arange(400) < 11).fitted
    with pytest.raises(TypeError, match="agreeing must be bool"):
        fit_alignment(matches, right.long())
    with pytest.raises(ValueError, match="agreeing"):
        fit_alignment(matches, right[1:])


def test_a_batch_is_the_loop_over_its_pairs() -> None:
    pairs = [surface(k, 20 + 90 * k, 0.1 * k, (3 * k - 8, 0.004 * k, -0.003 * k)) for k in range(6)]
    pairs.insert(2, surface(0, 0))
    batch = estimate(collate_matches(pairs))
    for k, matches in enumerate(pairs):
        alone = estimate(matches)
        assert torch.equal(batch.coefficients[k], alone.coefficients[0])
        assert torch.equal(batch.fitted[k], alone.fitted[0])
        part = batch.select(k, k + 1)
        assert torch.equal(part.coefficients, alone.coefficients)


def test_the_order_of_the_matches_changes_nothing_but_rounding() -> None:
    matches = surface(3, 500, 0.5, (4, 0.01, 0.01))
    order = torch.randperm(500, generator=torch.Generator().manual_seed(0))
    other = Matches(matches.keypoints0[order], matches.keypoints1[order], matches.ptr)
    torch.testing.assert_close(estimate(other).coefficients, estimate(matches).coefficients, rtol=1e-9, atol=1e-9)


def test_aligned_matches_lie_on_their_rows() -> None:
    matches = surface(4, 400, 0.0, (-7, 0.02, 0.01), noise_px=0.0)
    known = no_alignment(1, SIZE)._replace(coefficients=torch.tensor([[-7, 0.02, 0.01, 0.0]], dtype=torch.float64))
    aligned = align_matches(matches, known)
    torch.testing.assert_close(aligned.keypoints1[:, 1], matches.keypoints0[:, 1], rtol=0, atol=1e-9)
    assert torch.equal(aligned.keypoints1[:, 0], matches.keypoints1[:, 0])


@pytest.mark.parametrize("score", ["learned", "consensus"])
@pytest.mark.parametrize("shift", [(0.5, 0.0, 0.0), (1.0, 0.0, 0.0), (8.0, 0.02, -0.01), (-40.0, 0.0, 0.02)])
@pytest.mark.parametrize("whole", [False, True])
def test_what_all_rows_share_does_not_change_the_verdict(
    score: str, shift: tuple[float, float, float], whole: bool
) -> None:
    run = DelaunayFilter(score=score)
    straight = surface(5, 600, 0.4, whole=whole)
    before, after = run(straight), run(moved(straight, shift))
    assert before.inlier[240:].float().mean() > 0.9
    assert (before.inlier == after.inlier).float().mean() > 0.97
    assert (before.score - after.score).abs().median() < 0.03  # the bar of the moved scenes
    assert after.alignment is not None
    assert after.alignment.fitted.all()


def test_exact_matches_one_row_lower_are_kept() -> None:
    left = torch.rand(200, 2, generator=torch.Generator().manual_seed(0)) * SIZE
    right = left + torch.tensor([-12.0, 1.0])
    for score in ("learned", "consensus"):
        assert DelaunayFilter(score=score)(left.float(), right.float()).inlier.all()


def test_the_output_tells_what_was_taken_out() -> None:
    matches = surface(6, 300, 0.2, (3, 0, 0))
    padded = (matches.keypoints0[None], matches.keypoints1[None])
    for output in (DelaunayFilter()(matches), DelaunayFilter()(*padded), DelaunayFilter()(*(x[0] for x in padded))):
        assert output.alignment is not None
        assert output.alignment.coefficients.shape == (1, 4)
        assert output.alignment.coefficients[0, 0] == pytest.approx(3, abs=0.2)
    for run in (
        DelaunayFilter(verdict="cardinality", score="none"),
        DelaunayFilter(verdict="cardinality"),
    ):
        assert run(matches).alignment is None


def test_no_gradient_flows_through_the_alignment() -> None:
    matches = surface(7, 120, 0.2, (2, 0.01, 0))
    left, right = matches.keypoints0.clone().requires_grad_(), matches.keypoints1.clone().requires_grad_()
    asked = Matches(left, right, matches.ptr)
    assert not estimate(asked).coefficients.requires_grad
    for score in ("learned", "consensus"):
        output = DelaunayFilter(score=score)(asked)
        gradients = torch.autograd.grad(output.score.sum(), (left, right))
        assert all(gradient.isfinite().all() and gradient.abs().sum() > 0 for gradient in gradients)


def test_windows_are_compared_along_the_rows_of_the_alignment() -> None:
    """View 1 three rows lower, image and keypoints: the images say the same of every match away from the border."""
    from tensor_stereo.datasets.synthetic.rendering import render_pair

    pair = render_pair(0)
    height, width = pair.image0.shape[1:]
    rng = torch.Generator().manual_seed(0)
    left = torch.rand(60, 2, generator=rng) * torch.tensor([width - 80.0, height - 60.0]) + torch.tensor([50.0, 30.0])
    right = left - torch.tensor([14.0, 0.0])
    ptr = torch.tensor([0, 60])
    lowered = torch.cat([pair.image1[:, :3], pair.image1[:, :-3]], 1)
    straight, lower = Matches(left, right, ptr), Matches(left, right + torch.tensor([0.0, 3.0]), ptr)
    found = [
        measure_images(
            [pair.image0],
            [image],
            matches,
            build_match_graphs(matches),
            no_alignment(1, SIZE)._replace(coefficients=torch.tensor([[a, 0, 0, 0]]).double()),
        )
        for image, matches, a in ((pair.image1, straight, 0.0), (lowered, lower, 3.0))
    ]
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)  # float32 sums over other rows
