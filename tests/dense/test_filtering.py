from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tensor_stereo import DelaunayFilter, Matches
from tensor_stereo.dense.filtering import filter_disparity
from tensor_stereo.modules import FilterOutput


def plane(a: float, b: float, c: float, height: int = 60, width: int = 90) -> Tensor:
    """(1, 1, H, W) float64 disparity a x + b y + c."""
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    return (a * x + b * y + c)[None, None]


def smooth_filter(matches: Matches) -> FilterOutput:
    """The verdicts of DelaunayFilter with a score that depends smoothly on the keypoints of view 1."""
    return replace(DelaunayFilter()(matches), score=torch.sigmoid(matches.keypoints1[:, 0] / 50))


@given(st.integers(-40, 40), st.integers(1, 7), st.sampled_from(["adjacency", "cardinality"]))
def test_constant_disparity_keeps_every_match(value: int, stride: int, restriction: str) -> None:
    disparity = plane(0, 0, value)
    result = filter_disparity(disparity, stride, filter=DelaunayFilter(verdict=restriction))
    x, y = result.grid.unbind(-1)
    assert torch.equal(result.mask[0, 0], (x - value >= 0) & (x - value <= 89))
    assert bool(result.mask.any())
    assert torch.equal(result.inlier, result.mask)
    assert bool((result.score[result.mask] > 0).all())
    assert bool((result.score[~result.mask] == 0).all())
    assert torch.equal(y[:, 0], torch.arange(0, 60, stride).double())
    assert result.inlier.shape == (1, 1, *disparity[0, 0, ::stride, ::stride].shape)


@given(st.integers(-30, 30), st.integers(-30, 30), st.integers(2, 6))
def test_slanted_plane_keeps_every_match(a: int, b: int, stride: int) -> None:
    result = filter_disparity(plane(a / 100, b / 100, 0), stride)
    assert int(result.mask.sum()) > 50
    assert torch.equal(result.inlier, result.mask)


@pytest.mark.parametrize("sign", [1, -1])
def test_patch_of_wrong_disparities_is_rejected_and_the_rest_kept(sign: int) -> None:
    disparity = plane(0.05, 0.0, 8 * sign)
    generator = torch.Generator().manual_seed(0)
    disparity[0, 0, 20:40, 40:60] += 8 + 20 * torch.rand(20, 20, dtype=torch.float64, generator=generator)
    result = filter_disparity(disparity, 4, filter=DelaunayFilter(verdict="cardinality"))
    x, y = result.grid.unbind(-1)
    wrong = (x >= 40) & (x < 60) & (y >= 20) & (y < 40)
    assert not bool(result.inlier[0, 0][wrong].any())
    # The probability keeps none of them, and is a little too careful: the training had no scene as easy as a plane.
    by_score = filter_disparity(disparity, 4)
    assert float(by_score.inlier[0, 0][wrong].double().mean()) == 0
    precision = float((~wrong)[by_score.inlier[0, 0]].double().mean())
    assert precision == pytest.approx(float(by_score.score[by_score.inlier].mean()), abs=0.08)
    # Beyond the columns that the patch covers in either view, nothing has changed.
    far = result.mask[0, 0] & ((y < 14) | (y > 46))
    assert bool(result.inlier[0, 0][far].all())


def test_nan_infinite_and_masked_disparities_are_no_matches() -> None:
    disparity = plane(0, 0, 4)
    disparity[0, 0, 0, 8], disparity[0, 0, 4, 8], disparity[0, 0, 8, 8] = torch.nan, torch.inf, -torch.inf
    keep = torch.ones_like(disparity, dtype=torch.bool)
    keep[0, 0, 12, 8] = False
    result = filter_disparity(disparity, 4, mask=keep)
    expected = torch.ones(15, 23, dtype=torch.bool)
    expected[:, 0] = False  # x = 0 leaves the image
    expected[:4, 2] = False
    assert torch.equal(result.mask[0, 0], expected)
    assert not bool(result.inlier[~result.mask].any())
    assert bool(torch.isfinite(result.score).all())
    known = disparity.nan_to_num(0, 0, 0)
    unknown = keep & torch.isfinite(disparity)
    same = filter_disparity(known, 4, mask=unknown)
    assert torch.equal(same.inlier, result.inlier)


@given(st.integers(0, 10**6), st.integers(1, 5), st.booleans())
def test_batch_equals_loop(seed: int, stride: int, masked: bool) -> None:
    generator = torch.Generator().manual_seed(seed)
    disparity = 6 + 4 * torch.rand(3, 1, 24, 32, generator=generator).round()
    disparity[1, 0, :10] = torch.nan
    disparity[2] = torch.nan
    mask = torch.rand(3, 1, 24, 32, generator=generator) < 0.8 if masked else None
    for run in (DelaunayFilter(score="consensus"), None):
        batched = filter_disparity(disparity, stride, mask=mask, filter=run)
        assert not bool(batched.mask[2].any())
        for b in range(3):
            alone = filter_disparity(disparity[b, 0], stride, mask=None if mask is None else mask[b, 0], filter=run)
            assert torch.equal(alone.mask, batched.mask[b, 0])
            if run is not None:
                assert torch.equal(alone.inlier, batched.inlier[b, 0])
                assert torch.equal(alone.score, batched.score[b, 0])
            torch.testing.assert_close(alone.score, batched.score[b, 0], rtol=0, atol=1e-4)  # learned, in float32


def test_verdicts_are_those_of_the_filter_on_the_listed_matches() -> None:
    disparity = plane(0.1, 0.05, 3) + 2 * torch.randn(60, 90, generator=torch.Generator().manual_seed(0)).double()
    result = filter_disparity(disparity, 5)
    rows = [(x, y, disparity[0, 0, y, x].item()) for y in range(0, 60, 5) for x in range(0, 90, 5)]
    rows = [row for row in rows if 0 <= row[0] - row[2] <= 89]
    left = torch.tensor([[x, y] for x, y, _ in rows], dtype=torch.float64)
    right = torch.tensor([[x - d, y] for x, y, d in rows], dtype=torch.float64)
    expected = DelaunayFilter()(Matches(left, right, torch.tensor([0, len(rows)])))  # without costs
    assert 0 < int(expected.inlier.sum()) < len(rows)
    assert torch.equal(result.inlier[result.mask], expected.inlier)
    assert torch.equal(result.score[result.mask], expected.score)


def wall(height: int = 60) -> Tensor:
    """A near wall before a far one, with noise in steps of 1/4 px; many points meet in view 1."""
    disparity = plane(0, 0, 4, height)
    disparity[..., 40:60] = 20  # its partners are columns 20..39, where the background's 24..43 lie too
    noise = torch.randint(-6, 7, disparity.shape, generator=torch.Generator().manual_seed(0))
    return disparity + torch.where(noise.abs() < 4, 0, noise) / 4


@pytest.mark.parametrize("sign", [1, -1])
def test_of_points_that_meet_in_view_1_the_nearest_surface_is_seen(sign: int) -> None:
    given = []

    def listening(matches: Matches) -> FilterOutput:
        given.append(matches)
        return DelaunayFilter()(matches)

    disparity = torch.cat([wall(), wall().flip(2)]) - (0 if sign > 0 else 30)
    result = filter_disparity(disparity, 4, filter=listening)
    seen = torch.zeros_like(result.mask)
    expected = []
    for b in range(2):
        nearest: dict[tuple[float, float], tuple[float, int, int]] = {}
        for row, column in result.mask[b, 0].nonzero().tolist():
            d = disparity[b, 0, 4 * row, 4 * column].item()
            place = (4 * row, 4 * column - d)
            nearest[place] = max(nearest.get(place, (-torch.inf, 0, 0)), (d, row, column))
        for _, row, column in nearest.values():
            seen[b, 0, row, column] = True
        expected.append(len(nearest))
    assert int(seen.sum()) < int(result.mask.sum()) - 20
    assert given[0].ptr.diff().tolist() == expected
    assert given[0].cost is None
    assert torch.equal(given[0].keypoints0, result.grid.expand(2, *result.grid.shape)[seen[:, 0]])
    plain = DelaunayFilter()(given[0])
    for name in ("inlier", "score"):
        values = getattr(result, name)
        assert torch.equal(values[seen], getattr(plain, name)), name
        assert not bool(values[~seen].any()), name
    assert 0 < int(result.inlier.sum()) < int(seen.sum())


def test_no_filter_is_the_default_filter() -> None:
    one, other = (filter_disparity(wall(), 4, filter=given) for given in (None, DelaunayFilter()))
    assert torch.equal(one.inlier, other.inlier)
    assert torch.equal(one.score, other.score)


@given(st.integers(-18, 24))
def test_depth_as_such_is_no_evidence(shift: int) -> None:
    disparity = wall()
    x = torch.arange(90)
    stays = ((x - disparity - max(shift, 0) >= 0) & (x - disparity - min(shift, 0) <= 89)).expand_as(disparity)
    one, other = (filter_disparity(given, 4, mask=stays) for given in (disparity, disparity + shift))
    assert int(one.mask.sum()) > 100
    assert torch.equal(one.mask, other.mask)
    assert torch.equal(one.inlier, other.inlier)
    torch.testing.assert_close(one.score, other.score, rtol=0, atol=1e-9)


def test_gradients_flow_to_the_disparities_of_seen_matches_only() -> None:
    disparity = wall()
    disparity[0, 0, 0, 8] = torch.nan
    disparity.requires_grad_()
    result = filter_disparity(disparity, 4, filter=smooth_filter)
    result.score.sum().backward()
    assert disparity.grad is not None
    expected = torch.zeros_like(disparity, dtype=torch.bool)
    expected[..., ::4, ::4] = result.score > 0
    assert 0 < int(expected.sum()) < int(result.mask.sum())
    assert torch.equal(disparity.grad != 0, expected)
    assert bool(torch.isfinite(disparity.grad).all())


def test_gradient_is_the_one_of_finite_differences() -> None:
    disparity = plane(0.05, 0.01, 2, 9, 12).requires_grad_()
    assert torch.autograd.gradcheck(lambda d: filter_disparity(d, 3, filter=smooth_filter).score, disparity)


def test_dtype_follows_the_input_and_empty_maps_pass() -> None:
    assert filter_disparity(plane(0, 0, 4).float(), 4).grid.dtype == torch.float32
    assert torch.equal(filter_disparity(plane(0, 0, 4).float(), 4).inlier, filter_disparity(plane(0, 0, 4), 4).inlier)
    assert filter_disparity(torch.zeros(0, 1, 8, 8), 4).inlier.shape == (0, 1, 2, 2)
    assert filter_disparity(torch.zeros(2, 1, 0, 8), 4).score.shape == (2, 1, 0, 2)


def test_bad_arguments_are_named() -> None:
    disparity = plane(0, 0, 4)
    with pytest.raises(ValueError, match="disparity must have shape"):
        filter_disparity(disparity[0], 4)
    with pytest.raises(TypeError, match="disparity must be float32 or float64"):
        filter_disparity(disparity.half(), 4)
    with pytest.raises(ValueError, match="stride must be at least 1"):
        filter_disparity(disparity, 0)
    with pytest.raises(TypeError, match=r"disparity must be a torch\.Tensor, got ndarray"):
        filter_disparity(disparity.numpy(), 4)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"stride must be an integer number of px, got 4\.0"):
        filter_disparity(disparity, 4.0)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"mask must be a torch\.Tensor, got ndarray"):
        filter_disparity(disparity, 4, mask=(disparity > 0).numpy())  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="mask must be bool"):
        filter_disparity(disparity, 4, mask=disparity)
    with pytest.raises(ValueError, match="mask must have the shape"):
        filter_disparity(disparity, 4, mask=torch.ones(1, 1, 15, 23, dtype=torch.bool))
