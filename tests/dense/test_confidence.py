from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tensor_stereo.configs import SyntheticConfig
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tensor_stereo.dense import DisparityConfidence, ScoredDisparity, match_semi_global, score_disparity
from tensor_stereo.dense.confidence import load_confidence, read_maps
from tensor_stereo.dense.confidence_network import TOLERANCES_PX
from tensor_stereo.dense.map_evidence import NUM_PLANES


class Case:
    """A rendered pair, its semi-global maps, and the errors of that of view 0."""

    def __init__(self, seed: int) -> None:
        pair = render_pair(seed, SyntheticConfig(width_px=320, height_px=240, noise_levels=6.0))
        self.images = pair.image0[None], pair.image1[None]
        maps = match_semi_global(*self.images)
        assert maps.disparity1 is not None
        self.disparity, self.disparity1 = maps.disparity0[0], maps.disparity1[0]
        assert pair.disparity_gt is not None
        self.error = (self.disparity - pair.disparity_gt).abs()

    def score(self, **settings: Any) -> ScoredDisparity:
        return score_disparity(self.disparity, *self.images, self.disparity1, **settings)


@pytest.fixture(scope="module")
def case() -> Case:
    return Case(7)


def area_under_roc(score: Tensor, correct: Tensor) -> float:
    """How often a correct pixel has a higher score than a wrong one, by counting."""
    rng = torch.Generator().manual_seed(0)
    right, wrong = score[correct], score[~correct]
    pairs = (values[torch.randint(len(values), (20000,), generator=rng)] for values in (right, wrong))
    a, b = pairs
    return float(((a > b).double() + 0.5 * (a == b).double()).mean())


def test_it_sorts_better_than_the_left_right_check_and_its_probabilities_hold() -> None:
    scores, checks, correct = [], [], []
    for seed in (7, 8, 9):
        case = Case(seed)
        found = case.score()
        known = found.known[0, 0] & case.error.isfinite()
        columns = torch.arange(case.disparity.shape[1])
        partner = (columns - case.disparity).nan_to_num(0).round().long().clamp(0, len(columns) - 1)
        gap = (case.disparity1.gather(1, partner) - case.disparity).abs().nan_to_num(99)
        scores.append(found.probability[0, 0][known])
        checks.append(-gap[known])
        correct.append(case.error[known] <= 1)
    score, check, right = torch.cat(scores), torch.cat(checks), torch.cat(correct)
    assert area_under_roc(score, right) > area_under_roc(check, right) + 0.02
    assert abs(float(score.mean()) - float(right.double().mean())) < 0.05


def test_without_the_map_of_view_1_it_still_sorts(case: Case) -> None:
    found = score_disparity(case.disparity, *case.images)
    known = found.known[0, 0] & case.error.isfinite()
    assert area_under_roc(found.probability[0, 0][known], case.error[known] <= 1) > 0.85


def test_probabilities_grow_with_the_tolerance(case: Case) -> None:
    found = case.score()
    assert (found.cumulative.diff(dim=1) >= 0).all()
    last = torch.zeros_like(found.probability)
    for tolerance in (0.5, 0.75, 1.0, 2.5, 4.0, 12.0):
        probability = found.within(tolerance)
        assert (probability >= last - 1e-6).all()
        last = probability
    assert torch.equal(found.within(1.0), found.probability)
    assert torch.equal(found.within(3.0), found.cumulative[:, 3:4])


def test_share_of_the_estimate_is_a_tolerance_of_each_pixel() -> None:
    cumulative = torch.linspace(0.1, 0.7, 7).view(1, 7, 1, 1).expand(1, 7, 1, 4)
    disparity = torch.tensor([20.0, 80.0, 160.0, 900.0]).view(1, 1, 1, 4)
    found = ScoredDisparity(cumulative[:, :1], disparity > 0, disparity, cumulative, 1)
    # tolerances of 3, 4, 8 and 12 px: KITTI's rule, and at most what is predicted
    assert torch.allclose(found.within(3.0, 0.05).flatten(), torch.tensor([0.4, 0.45, 0.6, 0.7]))


def test_unknown_disparities_have_no_confidence(case: Case) -> None:
    disparity = case.disparity.clone()
    disparity[100:120, 60:200] = math.nan
    disparity[30, 40] = math.inf
    found = score_disparity(disparity, *case.images)
    unknown = ~disparity.isfinite()
    assert (found.probability[0, 0][unknown] == 0).all()
    assert torch.equal(found.known[0, 0], ~unknown)
    assert found.disparity[0, 0][unknown].isnan().all()
    assert not found.keep(threshold=0.0)[0, 0][unknown].any()
    nothing = score_disparity(torch.full_like(disparity, math.nan), *case.images)
    assert (nothing.probability == 0).all()


def test_integers_of_opencv_are_read_by_their_scale(case: Case) -> None:
    raw = (case.disparity * 16).nan_to_num(-16).round().to(torch.int16)
    expected = score_disparity((raw / 16).where(raw >= 0, math.nan), *case.images)
    found = score_disparity(raw, *case.images, scale=16, unknown=-16)
    assert torch.equal(found.probability, expected.probability)
    with pytest.raises(TypeError, match="scale must be given for disparity of torch"):
        score_disparity(raw, *case.images)


def test_maps_of_a_batch_do_not_depend_on_each_other(case: Case) -> None:
    flipped = [image.flip(2) for image in case.images]
    maps = torch.stack([case.disparity, case.disparity.flip(0)])[:, None]
    maps1 = torch.stack([case.disparity1, case.disparity1.flip(0)])[:, None]
    views = [torch.cat([a, b]) for a, b in zip(case.images, flipped, strict=True)]
    both = score_disparity(maps, *views, maps1)
    assert torch.equal(both.probability[:1], case.score().probability)
    other = score_disparity(maps[1, 0], *flipped, maps1[1, 0])
    assert torch.equal(both.probability[1:], other.probability)
    assert both.probability.shape == (2, 1, 240, 320)


def test_a_stride_judges_some_pixels_much_like_all(case: Case) -> None:
    whole, grid = case.score(), case.score(stride=4)
    assert grid.probability.shape == (1, 1, 60, 80)
    assert torch.equal(grid.known, whole.known[..., ::4, ::4])
    assert (grid.probability - whole.probability[..., ::4, ::4]).abs().mean() < 0.15
    known = grid.known[0, 0] & case.error[::4, ::4].isfinite()
    assert area_under_roc(grid.probability[0, 0][known], case.error[::4, ::4][known] <= 1) > 0.85


def test_kept_pixels_have_the_expected_precision(case: Case) -> None:
    found = case.score()
    kept = found.keep(min_precision=0.95)
    chosen = found.probability[kept]
    assert float(chosen.double().mean()) >= 0.95
    rest = found.probability[found.known & ~kept]
    assert float(rest.max()) <= float(chosen.min())
    assert torch.equal(found.filter(min_precision=0.95).isfinite(), kept)
    assert torch.equal(found.keep(), found.known & (found.probability >= 0.5))
    with pytest.raises(ValueError, match="threshold must be None beside min_precision"):
        found.keep(threshold=0.5, min_precision=0.9)
    with pytest.raises(ValueError, match="threshold must lie in"):
        found.keep(threshold=1.5)
    with pytest.raises(ValueError, match="min_precision must lie in"):
        found.keep(min_precision=-0.1)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"disparity": torch.zeros(2, 8, 9)}, ValueError, r"disparity must have shape \(B, 1, H, W\)"),
        ({"disparity": torch.zeros(8, 9, dtype=torch.bool)}, TypeError, "disparity must hold"),
        ({"disparity": [[1.0]]}, TypeError, "disparity must be a torch"),
        ({"images0": torch.zeros(1, 8, 8)}, ValueError, r"images0\[0\] must have the size \(8, 9\)"),
        ({"images1": torch.zeros(2, 1, 8, 9)}, ValueError, "images1 must hold one image per pair"),
        ({"disparity1": torch.zeros(8, 8)}, ValueError, "disparity1 must have the shape"),
        ({"stride": 0}, ValueError, "stride must be at least 1"),
        ({"stride": 2.0}, TypeError, "stride must be an integer"),
        ({"max_error_px": 0.1}, ValueError, "max_error_px must lie between 0.5 and 12 px"),
        ({"max_error_share": 1.0}, ValueError, "max_error_share must lie in"),
        ({"scale": 0.0}, ValueError, "scale must be a positive number"),
    ],
)
def test_bad_input_is_named(changes: dict[str, Any], error: type[Exception], message: str) -> None:
    given: dict[str, Any] = {"disparity": torch.zeros(8, 9), "images0": torch.zeros(1, 8, 9)}
    given["images1"] = given["images0"]
    with pytest.raises(error, match=message):
        score_disparity(**(given | changes))


def test_maps_are_read_as_px() -> None:
    raw = torch.tensor([[0.0, 512.0, math.nan, 65535.0]])
    assert read_maps("disparity", raw, 256, 65535).flatten().tolist()[:2] == [0.0, 2.0]
    assert read_maps("disparity", raw, 256, 65535).isnan().flatten().tolist() == [False, False, True, True]


def test_logits_do_not_fall_and_odd_sizes_are_kept() -> None:
    network = load_confidence()
    planes = torch.randn(2, NUM_PLANES, 13, 7, generator=torch.Generator().manual_seed(0))
    planes[:, 0] = 1
    logits = network(planes)
    assert logits.shape == (2, len(TOLERANCES_PX), 13, 7)
    assert (logits.diff(dim=1) >= 0).all()


def test_what_is_unknown_does_not_matter() -> None:
    network = load_confidence()
    planes = torch.randn(1, NUM_PLANES, 20, 24, generator=torch.Generator().manual_seed(1))
    planes[:, 0] = (planes[:, 0] > 0).float()
    changed = torch.where(planes[:, :1] > 0, planes, torch.cat([planes[:, :1], 9 * planes[:, 1:]], 1))
    assert torch.equal(network(planes), network(changed))


def test_the_module_is_a_module(case: Case) -> None:
    module = DisparityConfidence(3.0, 0.05, stride=2)
    assert "max_error_share=0.05" in repr(module)
    assert not any(p.requires_grad for p in module.parameters())
    found = module(case.disparity, *case.images)
    assert torch.equal(found.probability, found.within(3.0, 0.05))
    assert np.isfinite(found.probability.numpy()).all()
