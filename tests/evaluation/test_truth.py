"""Correct matches: disparity and row agree with ground truth, but for what all rows of a pair share.

Of views that are not rectified, the distance to the true partner counts.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tensor_stereo.batching import collate_matches
from tensor_stereo.evaluation.truth import errors_against_gt, errors_to_partners, matches_against_gt
from tensor_stereo.types import Matches


def two_matches(disparity: float, x: float = 2.0) -> Matches:
    left = torch.tensor([[x, 1.0], [x, 1.0]])
    right = left - torch.tensor([disparity, 0.0])
    return Matches(left, right, ptr=torch.tensor([0, 2]))


@pytest.mark.parametrize(
    ("disparity", "expected"), [(3.0, True), (4.0, True), (2.0, True), (4.0625, False), (1.9375, False)]
)
def test_error_of_just_one_pixel_is_correct(disparity: float, expected: bool) -> None:
    correct, valid = matches_against_gt(two_matches(disparity, x=5.0), torch.full((1, 3, 9), 3.0))
    assert correct.tolist() == [expected] * 2
    assert valid.all()


def test_max_error_is_respected() -> None:
    truth = torch.full((1, 3, 9), 3.0)
    assert matches_against_gt(two_matches(5.0), truth, max_error_px=2.0)[0].all()
    assert not matches_against_gt(two_matches(5.0), truth, max_error_px=1.5)[0].any()


@pytest.mark.parametrize("unknown", [math.nan, math.inf, -math.inf])
def test_unknown_ground_truth_is_neither_correct_nor_valid(unknown: float) -> None:
    for max_error_px in (1.0, math.inf):
        correct, valid = matches_against_gt(two_matches(0.0), torch.full((1, 3, 9), unknown), max_error_px=max_error_px)
        assert not correct.any()
        assert not valid.any()


def test_zero_is_a_known_disparity() -> None:
    correct, valid = matches_against_gt(two_matches(0.0), torch.zeros(1, 3, 9))
    assert correct.all()
    assert valid.all()


def test_ground_truth_is_read_at_the_nearest_left_pixel_of_the_own_pair() -> None:
    generator = torch.Generator().manual_seed(0)
    sizes, lengths = [(5, 9), (12, 4), (7, 7)], [40, 0, 60]
    maps = [torch.rand(size, generator=generator) * 4 for size in sizes]
    parts = zip(lengths, sizes, strict=True)
    left = torch.cat([torch.rand(n, 2, generator=generator) * torch.tensor([w - 1.0, h - 1.0]) for n, (h, w) in parts])
    right = left - torch.tensor([2.0, 0.0])
    correct, valid = matches_against_gt(Matches(left, right, torch.tensor([0, 40, 40, 100])), maps)
    expected = []
    for row, (x, y) in enumerate(left.double().tolist()):
        truth = maps[0 if row < 40 else 2][round(y), round(x)].item()
        expected.append(abs(truth - (left[row, 0].item() - right[row, 0].item())) <= 1)
    assert correct.tolist() == expected
    assert valid.all()
    assert 0 < sum(expected) < 100


def test_matches_against_gt_agrees_with_numpy_rounding_at_half_pixels() -> None:
    truth = torch.arange(9.0).expand(1, 3, 9)
    left = torch.tensor([[0.5, 0.0], [1.5, 0.0], [2.5, 0.0]])
    right = left - torch.from_numpy(np.stack([np.round([0.5, 1.5, 2.5]), np.zeros(3)], 1)).float()
    assert matches_against_gt(Matches(left, right, torch.tensor([0, 3])), truth, max_error_px=0.0)[0].all()


def test_matches_against_gt_names_what_is_wrong() -> None:
    matches = two_matches(0.0)
    with pytest.raises(ValueError, match="max_error_px"):
        matches_against_gt(matches, torch.zeros(1, 3, 9), max_error_px=-1.0)
    with pytest.raises(TypeError, match="disparity_gt of pair 0"):
        matches_against_gt(matches, torch.zeros(1, 3, 9, dtype=torch.uint8))
    with pytest.raises(ValueError, match="one map per pair"):
        matches_against_gt(matches, torch.zeros(2, 3, 9))
    with pytest.raises(ValueError, match="keypoints0"):
        matches_against_gt(two_matches(0.0, x=30.0), torch.zeros(1, 3, 9))


def rectified_pair(seed: int, count: int = 300, noise_px: float = 0.3) -> tuple[Matches, torch.Tensor]:
    """Matches of a wavy surface with errors of their own in both coordinates, a third of them far off; its truth."""
    rng = torch.Generator().manual_seed(seed)
    x = torch.arange(160, dtype=torch.float64)
    truth = (20 + 8 * torch.sin(x / 30)).expand(120, 160)
    left = (torch.rand(count, 2, generator=rng, dtype=torch.float64) * torch.tensor([159, 119])).round()
    disparity = truth[0][left[:, 0].long()]
    right = left - torch.stack([disparity, torch.zeros_like(disparity)], 1)
    right += torch.randn(count, 2, generator=rng, dtype=torch.float64) * noise_px
    right[: count // 3] = torch.rand(count // 3, 2, generator=rng, dtype=torch.float64) * torch.tensor([159, 119])
    return Matches(left, right, torch.tensor([0, count])), truth[None]


def lowered(matches: Matches, a: float, b: float = 0.0, c: float = 0.0) -> Matches:
    x, y = matches.keypoints0.unbind(1)
    shift = a + b * x + c * y
    return replace(matches, keypoints1=matches.keypoints1 + torch.stack([torch.zeros_like(shift), shift], 1))


@pytest.mark.parametrize("rows", [-5.0, 1.5, 5.0])
def test_a_match_on_another_row_is_wrong(rows: float) -> None:
    matches, truth = rectified_pair(0)
    correct, _ = matches_against_gt(matches, truth)
    right = matches.keypoints1.clone()
    chosen = correct.nonzero()[::7, 0]
    right[chosen, 1] = matches.keypoints0[chosen, 1] + rows
    found, valid = matches_against_gt(replace(matches, keypoints1=right), truth)
    assert valid.all()
    assert not found[chosen].any()
    correct[chosen] = False
    assert torch.equal(found, correct)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("shift", [(8.0, 0.02, 0.0), (-8.0, -0.01, 0.02), (0.6, 0.0, 0.0)])
def test_what_all_rows_share_is_no_error(seed: int, shift: tuple[float, float, float]) -> None:
    matches, truth = rectified_pair(seed)
    correct, _ = matches_against_gt(matches, truth)
    assert 0.5 < correct.double().mean() < 0.67
    for max_error_px in (0.5, 1.0, 3.0):
        expected, _ = matches_against_gt(matches, truth, max_error_px=max_error_px)
        found, _ = matches_against_gt(lowered(matches, *shift), truth, max_error_px=max_error_px)
        offset = (matches.keypoints1 - matches.keypoints0)[:, 1].abs()
        clear = (offset - max_error_px).abs() > 0.15  # the noise of the rows moves the fit a little
        assert torch.equal(found[clear], expected[clear])


def test_fewer_than_twelve_right_disparities_share_no_rows() -> None:
    matches, truth = rectified_pair(1, 40, noise_px=0.0)
    right = slice(13, None)
    for count, expected in ((11, 0), (12, 12)):
        few = Matches(matches.keypoints0[right][:count], matches.keypoints1[right][:count], torch.tensor([0, count]))
        assert matches_against_gt(few, truth)[0].all()
        assert int(matches_against_gt(lowered(few, 5.0), truth)[0].sum()) == expected


def test_rows_that_drift_too_much_are_taken_as_they_are() -> None:
    matches, truth = rectified_pair(2, noise_px=0.0)
    correct, _ = matches_against_gt(matches, truth)
    found, _ = matches_against_gt(lowered(matches, 0.0, 0.2), truth)
    on_their_rows = 0.2 * matches.keypoints0[:, 0] <= 1
    assert torch.equal(found, correct & on_their_rows)
    assert 0 < found.sum() < correct.sum()


def test_a_row_off_by_just_the_tolerance_is_correct() -> None:
    left = torch.tensor([[5.1, 1.3], [5.1, 1.3], [5.1, 1.3]])
    right = left - torch.tensor([[3.0, 1.0], [3.0, -1.0], [3.0, 1.0 + 2**-20]])
    right[:, 0] = left[:, 0] - 3
    correct, _ = matches_against_gt(Matches(left, right, torch.tensor([0, 3])), torch.full((1, 4, 9), 3.0))
    offset = (left[:, 1].double() - right[:, 1].double()).abs()  # of float32 coordinates, exact in float64
    assert correct.tolist() == (offset <= 1).tolist()
    whole = torch.tensor([[5.0, 2.0], [5.0, 2.0], [5.0, 2.0]])
    moved = whole - torch.tensor([[3.0, 1.0], [3.0, -1.0], [3.0, 1.0625]])
    correct, _ = matches_against_gt(Matches(whole, moved, torch.tensor([0, 3])), torch.full((1, 4, 9), 3.0))
    assert correct.tolist() == [True, True, False]


def test_a_row_that_is_no_number_is_wrong() -> None:
    matches, truth = rectified_pair(3)
    expected, _ = matches_against_gt(matches, truth)
    right = matches.keypoints1.clone()
    chosen = int(expected.nonzero()[0])
    right[chosen, 1] = math.nan
    found, _ = matches_against_gt(replace(matches, keypoints1=right), truth)
    assert not found[chosen]
    assert int((found != expected).sum()) <= 2  # the fit has one match fewer


def test_a_batch_is_the_loop_over_its_pairs() -> None:
    pairs = [rectified_pair(seed, 30 + 60 * seed) for seed in range(4)]
    given = [lowered(matches, 4.0 * k, 0.004 * k) for k, (matches, _) in enumerate(pairs)]
    batch, _ = matches_against_gt(collate_matches(given), torch.cat([truth for _, truth in pairs]))
    alone = [matches_against_gt(m, truth)[0] for m, (_, truth) in zip(given, pairs, strict=True)]
    assert torch.equal(batch, torch.cat(alone))


def random_matches(seed: int, count: int = 50) -> tuple[Matches, torch.Tensor]:
    """Matches of two pairs whose keypoints have nothing to do with each other; partners that are not theirs either."""
    rng = torch.Generator().manual_seed(seed)
    left, right, partners = (torch.rand(count, 2, generator=rng, dtype=torch.float64) * 400 for _ in range(3))
    return Matches(left, right, torch.tensor([0, count // 3, count])), partners


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_match_with_its_partner_has_no_error(dtype: torch.dtype) -> None:
    matches, _ = random_matches(0)
    matches = replace(matches, keypoints0=matches.keypoints0.to(dtype), keypoints1=matches.keypoints1.to(dtype))
    error = errors_to_partners(matches, matches.keypoints1)
    assert error.dtype == torch.float64
    assert torch.equal(error, torch.zeros(50, dtype=torch.float64))


def test_error_is_the_distance_to_the_partner() -> None:
    matches, partners = random_matches(1)
    expected = [math.dist(a, b) for a, b in zip(matches.keypoints1.tolist(), partners.tolist(), strict=True)]
    torch.testing.assert_close(errors_to_partners(matches, partners), torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("scale", [0.25, 1.0, 3.0])
def test_where_view_1_is_larger_more_of_its_pixels_are_allowed(scale: float) -> None:
    matches, partners = random_matches(2)
    larger = replace(matches, keypoints1=scale * matches.keypoints1)
    found = errors_to_partners(larger, scale * partners, torch.full((50,), scale))
    torch.testing.assert_close(found, errors_to_partners(matches, partners))


def test_each_match_has_the_scale_of_its_own_place() -> None:
    matches, partners = random_matches(3)
    scale = torch.linspace(0.5, 2, 50, dtype=torch.float64)
    expected = errors_to_partners(matches, partners) / scale
    torch.testing.assert_close(errors_to_partners(matches, partners, scale), expected)


@pytest.mark.parametrize("degrees", [30.0, 90.0, 180.0])
def test_turning_and_moving_view_1_changes_no_error(degrees: float) -> None:
    matches, partners = random_matches(4)
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn, shift = torch.tensor([[c, -s], [s, c]], dtype=torch.float64), torch.tensor([7.0, -300.0], dtype=torch.float64)
    turned = replace(matches, keypoints1=matches.keypoints1 @ turn.T + shift)
    expected = errors_to_partners(matches, partners)
    torch.testing.assert_close(errors_to_partners(turned, partners @ turn.T + shift), expected)


def test_errors_to_partners_of_a_rectified_pair_are_at_least_those_of_disparity_and_row() -> None:
    matches, truth = rectified_pair(5)
    x, y = matches.keypoints0.long().unbind(1)
    partners = matches.keypoints0 - torch.stack([truth[0, y, x], torch.zeros(len(x))], 1)
    larger = (matches.keypoints1 - partners).abs().amax(1)
    found = errors_to_partners(matches, partners)
    assert (found >= larger).all()
    assert (found <= math.sqrt(2) * larger + 1e-12).all()
    assert (found - errors_against_gt(matches, truth)).abs()[found < 1].max() < 0.5  # which takes shared rows out


@pytest.mark.parametrize("unknown", [math.nan, math.inf, -math.inf])
def test_an_unknown_partner_has_no_error(unknown: float) -> None:
    matches, partners = random_matches(6)
    partners[3, 0] = partners[4, 1] = unknown
    found = errors_to_partners(matches, partners)
    assert found.isnan().nonzero()[:, 0].tolist() == [3, 4]
    scale = torch.ones(50)
    scale[7] = math.nan
    assert errors_to_partners(matches, partners, scale).isnan().nonzero()[:, 0].tolist() == [3, 4, 7]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_keypoint_that_is_no_number_is_wrong_but_not_where_the_partner_is_unknown(bad: float) -> None:
    matches, partners = random_matches(7)
    left, right = matches.keypoints0.clone(), matches.keypoints1.clone()
    left[1, 0] = right[2, 1] = right[3, 0] = right[4, 0] = bad
    partners[3, 1] = math.nan
    scale = torch.ones(50)
    scale[4] = math.nan
    found = errors_to_partners(Matches(left, right, matches.ptr), partners, scale)
    assert found[1:3].tolist() == [math.inf, math.inf]
    assert found[3:5].isnan().all()
    assert int(found.isfinite().sum()) == 46


def test_errors_to_partners_of_no_match() -> None:
    nothing = Matches(torch.zeros(0, 2), torch.zeros(0, 2), torch.tensor([0, 0]))
    assert errors_to_partners(nothing, torch.zeros(0, 2), torch.zeros(0)).shape == (0,)


def test_errors_to_partners_has_no_gradient() -> None:
    matches, partners = random_matches(8)
    matches = replace(matches, keypoints1=matches.keypoints1.requires_grad_())
    assert not errors_to_partners(matches, partners.requires_grad_(), torch.ones(50, requires_grad=True)).requires_grad


def test_errors_to_partners_names_what_is_wrong() -> None:
    matches, partners = random_matches(9)
    with pytest.raises(ValueError, match=r"partners_gt must have shape \(N, 2\)"):
        errors_to_partners(matches, partners[:, 0])
    with pytest.raises(ValueError, match="partners_gt must have one row per match"):
        errors_to_partners(matches, partners[1:])
    with pytest.raises(TypeError, match="partners_gt"):
        errors_to_partners(matches, partners.long())
    with pytest.raises(ValueError, match="scale_gt must have shape"):
        errors_to_partners(matches, partners, torch.ones(50, 1))
    with pytest.raises(TypeError, match="scale_gt"):
        errors_to_partners(matches, partners, torch.ones(50, dtype=torch.int64))
    for bad in (0.0, -1.0, math.inf):
        with pytest.raises(ValueError, match="scale_gt must be positive"):
            errors_to_partners(matches, partners, torch.full((50,), bad))
