"""Semi-global matching: shifted images, rendered scenes with exact truth, and images of any size."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tensor_stereo import MatchingConfig, PipelineConfig, SGBMConfig, StereoPair, run_pipeline, sample_disparity
from tensor_stereo.configs import DETECTORS, Detector
from tensor_stereo.datasets import SyntheticDataset
from tensor_stereo.dense import SemiGlobalMaps, match_semi_global
from tensor_stereo.evaluation import matches_against_gt
from tensor_stereo.features import detect_features
from tensor_stereo.matching import match_features
from tensor_stereo.sampling import sample_nearest

MODES = ("sgbm", "3way", "hh")
SGBM = PipelineConfig(matching=MatchingConfig(method="sgbm"), verdict="cardinality")


@pytest.fixture(scope="module")
def scenes() -> list[StereoPair]:
    return list(SyntheticDataset(4))


def noise(height: int, width: int, seed: int = 0) -> Tensor:
    """(1, H, W) uint8 grey levels, smooth enough for sub-pixel steps and different everywhere."""
    rng = np.random.default_rng(seed)
    levels = cv2.GaussianBlur(rng.integers(0, 256, (height, width)).astype(np.float32), (0, 0), 1.0)
    return torch.from_numpy(cv2.normalize(levels, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8))[None]


def correct_share(pair: StereoPair, config: PipelineConfig) -> tuple[float, int]:
    matches = run_pipeline([(pair.image0, pair.image1)], config).matches
    correct, valid = matches_against_gt(matches, [pair.disparity_gt])  # type: ignore[list-item]
    return float(correct[valid].float().mean()), int(correct.sum())


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("shift", [0, 1, 7, 40])
def test_a_shifted_image_has_exactly_that_disparity(mode: Any, shift: int) -> None:
    scene = noise(80, 200)
    image0, image1 = scene[..., : 200 - shift], scene[..., shift:]  # what is at x in view 0 is at x - shift in view 1
    maps = match_semi_global(image0, image1, SGBMConfig(num_disparities_px=64, mode=mode))
    assert maps.disparity1 is not None
    width = 200 - shift
    for disparity in (maps.disparity0[0][:, shift + 5 : width - 5], maps.disparity1[0][:, 5 : width - shift - 5]):
        assert ((disparity - shift).abs() <= 1 / 16).float().mean() > 0.999  # the parabola through noise
        assert (disparity == shift).float().mean() > 0.98
    output = run_pipeline([(image0, image1)], replace(SGBM, sgbm=SGBMConfig(num_disparities_px=64, mode=mode)))
    x = output.matches.keypoints0[:, 0]
    inside = (x >= shift + 5) & (x < width - 5)
    assert inside.sum() > 100
    same = output.matches.disparity[inside] == shift
    assert same.float().mean() > 0.98
    assert (output.matches.cost[inside][same] == 0).float().mean() > 0.98
    assert output.matches.cost[inside].max() <= 1 / 8


@pytest.mark.parametrize("shift", [-9, -30])
def test_disparities_may_be_negative(shift: int) -> None:
    scene = noise(60, 160)
    image0, image1 = scene[..., -shift:], scene[..., : 160 + shift]
    config = SGBMConfig(min_disparity_px=-32, num_disparities_px=32)
    output = run_pipeline([(image0, image1)], replace(SGBM, sgbm=config))
    inside = output.matches.keypoints0[:, 0] < 160 + 2 * shift - 5
    assert inside.sum() > 50
    assert (output.matches.disparity[inside] == shift).float().mean() > 0.98


def test_disparities_at_the_left_border_are_searched_as_elsewhere() -> None:
    scene = noise(80, 200)
    image0, image1 = scene[..., :196], scene[..., 4:]
    config = SGBMConfig()
    raw = cv2.StereoSGBM.create(0, 128, 5, 200, 800, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    usual = raw.compute(image0[0].numpy(), image1[0].numpy()) / 16
    assert (usual[:, :128] < 0).all()  # OpenCV alone leaves the whole range out
    found = match_semi_global(image0, image1, config).disparity0[0]
    assert (found[:, 10:128] == 4).float().mean() > 0.99
    assert (found[:, 140:190].numpy() == usual[:, 140:190]).mean() > 0.99


def test_the_map_of_view_1_is_that_of_the_mirrored_pair(scenes: list[StereoPair]) -> None:
    pair = scenes[0]
    maps = match_semi_global(pair.image0, pair.image1)
    mirrored = match_semi_global(pair.image1.flip(-1), pair.image0.flip(-1))
    assert maps.disparity1 is not None
    assert torch.equal(maps.disparity1[0].nan_to_num(-1), mirrored.disparity0[0].flip(-1).nan_to_num(-1))
    known = maps.disparity0[0][maps.disparity0[0].isfinite()]
    assert torch.equal(known * 16, (known * 16).round())
    assert 0 <= float(known.min()) <= float(known.max()) <= 128


def test_more_fast_matches_are_correct_than_by_ssd(scenes: list[StereoPair]) -> None:
    for pair in scenes:
        (share, count), (share_ssd, count_ssd) = (
            correct_share(pair, replace(SGBM, matching=MatchingConfig(method=method))) for method in ("sgbm", "ssd")
        )
        assert share > share_ssd
        assert count > count_ssd


@pytest.mark.parametrize("detector", DETECTORS)
def test_keypoints_of_every_detector_have_partners_on_their_rows(detector: Detector, scenes: list[StereoPair]) -> None:
    pair = scenes[1]
    config = replace(SGBM, detector=detector)
    matches = run_pipeline([(pair.image0, pair.image1)], config).matches
    assert matches.num_matches > 100
    assert torch.equal(matches.keypoints0[:, 1], matches.keypoints1[:, 1])
    maps = match_semi_global(pair.image0, pair.image1)
    expected = sample_nearest(maps.disparity0, matches.keypoints0, matches.ptr)
    torch.testing.assert_close(matches.disparity, expected, rtol=0, atol=1e-4)
    for points in (matches.keypoints0, matches.keypoints1):
        assert len(points.unique(dim=0)) == len(points)
    keypoints = {tuple(point) for point in detect_features(pair.image0[None], config).keypoints.tolist()}
    assert {tuple(point) for point in matches.keypoints0.tolist()} <= keypoints
    by_ssd = replace(config, matching=MatchingConfig())
    assert correct_share(pair, config) > correct_share(pair, by_ssd)


def test_the_cost_marks_what_view_1_does_not_see(scenes: list[StereoPair]) -> None:
    hidden, seen = [], []
    for pair in scenes:
        maps = match_semi_global(pair.image0, pair.image1)
        y, x = torch.meshgrid(*(torch.arange(0, size, 3.0) for size in pair.image0.shape[1:]), indexing="ij")
        points = torch.stack([x, y], -1).reshape(-1, 2)
        matches = sample_disparity(maps.disparity0, points, torch.tensor([0, len(points)]), disparity1=maps.disparity1)
        occluded = sample_nearest([pair.occluded], matches.keypoints0, matches.ptr)  # type: ignore[list-item]
        correct, _ = matches_against_gt(matches, [pair.disparity_gt])  # type: ignore[list-item]
        hidden.append(matches.cost[occluded])
        seen.append(matches.cost[~occluded & correct])
    assert len(torch.cat(hidden)) > 300
    assert (torch.cat(hidden) > 1).float().mean() > 0.5  # others, at the rim, look as the near surface does
    assert (torch.cat(seen) > 1).float().mean() < 0.05


def test_matches_are_those_of_the_public_sampling(scenes: list[StereoPair]) -> None:
    pair = scenes[2]
    found = run_pipeline([(pair.image0, pair.image1)], SGBM).matches
    maps = match_semi_global(pair.image0, pair.image1)
    features = detect_features(pair.image0[None], SGBM)
    expected = sample_disparity(maps.disparity0, features.keypoints, features.ptr, disparity1=maps.disparity1)
    for name in ("keypoints0", "keypoints1", "ptr", "cost"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    alone = run_pipeline([(pair.image0, pair.image1)], replace(SGBM, sgbm=SGBMConfig(left_right=False))).matches
    assert alone.cost is None
    assert abs(alone.num_matches - found.num_matches) <= 5  # only of coinciding partners another one stays


def test_bounds_of_the_disparity_are_kept(scenes: list[StereoPair]) -> None:
    images = [(scenes[0].image0, scenes[0].image1)]
    every = run_pipeline(images, SGBM).matches
    bounds = MatchingConfig(method="sgbm", min_disparity_px=10, max_disparity_px=30.5)
    some = run_pipeline(images, replace(SGBM, matching=bounds)).matches
    inside = (every.disparity >= 10) & (every.disparity <= 30.5)
    assert 0 < inside.sum() < every.num_matches
    assert torch.equal(some.keypoints1, every.keypoints1[inside])
    assert torch.equal(some.cost, every.cost[inside])
    rows = MatchingConfig(method="sgbm", max_row_offset_px=0)
    assert torch.equal(run_pipeline(images, replace(SGBM, matching=rows)).matches.keypoints1, every.keypoints1)


def test_a_batch_of_several_sizes_is_the_loop_over_its_pairs(scenes: list[StereoPair]) -> None:
    pairs = [(pair.image0[:, 7 * k :, 11 * k :], pair.image1[:, 7 * k :, 11 * k :]) for k, pair in enumerate(scenes)]
    pairs.insert(2, (noise(1, 1), noise(1, 1)))
    config = replace(SGBM, verdict="score", score="consensus")
    batch, loop = run_pipeline(pairs, config), [run_pipeline([pair], config) for pair in pairs]
    assert batch.matches.ptr.diff().tolist() == [one.matches.num_matches for one in loop]
    for name in ("keypoints0", "keypoints1", "cost"):
        assert torch.equal(getattr(batch.matches, name), torch.cat([getattr(one.matches, name) for one in loop])), name
    relation = torch.cat([one.classification.relation for one in loop])
    assert torch.equal(batch.classification.relation, relation)
    one_size = [(pair.image0, pair.image1) for pair in scenes]
    stacked = match_semi_global(*(torch.stack(view) for view in zip(*one_size, strict=True)))
    for k, (image0, image1) in enumerate(one_size):
        assert torch.equal(
            stacked.disparity0[k].nan_to_num(-1), match_semi_global(image0, image1).disparity0[0].nan_to_num(-1)
        )


@settings(max_examples=150, deadline=None)
@given(
    st.tuples(st.integers(1, 24), st.integers(1, 40)),
    st.builds(
        SGBMConfig,
        window_px=st.sampled_from([1, 3, 5, 7, 9, 11]),
        step_penalty_levels=st.sampled_from([0.01, 8.0]),
        jump_penalty_levels=st.sampled_from([8.5, 100.0]),
        min_disparity_px=st.sampled_from([-1000, -40, -16, -3, 0, 5, 1000]),
        num_disparities_px=st.sampled_from([16, 48, 1024]),
        mode=st.sampled_from(MODES),
        left_right=st.booleans(),
    ),
    st.integers(0, 2**32 - 1),
)
def test_images_of_any_size_have_maps_within_the_range(size: tuple[int, int], config: SGBMConfig, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    images = torch.randint(0, 256, (2, 1, *size), generator=generator, dtype=torch.uint8)
    maps = match_semi_global(*images, config)
    assert isinstance(maps, SemiGlobalMaps)
    assert (maps.disparity1 is not None) == config.left_right
    for disparity in [*maps.disparity0, *(maps.disparity1 or [])]:
        assert disparity.shape == size
        known = disparity[disparity.isfinite()]
        assert disparity.isnan().sum() + len(known) == disparity.numel()
        low = config.min_disparity_px
        assert ((known >= low) & (known <= low + config.num_disparities_px)).all()


@pytest.mark.parametrize("detector", DETECTORS)
def test_constant_and_tiny_images_give_matches_or_none(detector: Detector) -> None:
    config = replace(SGBM, detector=detector, constrained=True)
    for size in ((64, 80), (1, 1), (3, 3), (7, 300), (300, 2)):
        constant = torch.full((1, *size), 90, dtype=torch.uint8)
        assert run_pipeline([(constant, constant)], config).matches.num_matches == 0
        output = run_pipeline([(noise(*size), noise(*size, seed=1))], config)
        assert len(output.classification.inlier) == output.matches.num_matches


def test_keypoints_at_the_borders_have_partners() -> None:
    scene = noise(40, 60)
    maps = match_semi_global(scene, scene)
    corners = torch.tensor([[0.0, 0.0], [59.0, 0.0], [0.0, 39.0], [59.4, 39.4], [-0.4, 20.0], [30.0, -0.4]])
    matches = sample_disparity(maps.disparity0, corners, disparity1=maps.disparity1)
    assert (matches.disparity == 0).all()
    assert torch.equal(matches.keypoints0, corners[[0, 1, 2, 5]])  # two partners lie outside of view 1
    assert (matches.cost == 0).all()


def test_colour_and_floating_point_are_taken(scenes: list[StereoPair]) -> None:
    grey0, grey1 = (image[:1] for image in (scenes[0].image0, scenes[0].image1))
    plain = match_semi_global(grey0, grey1).disparity0[0].nan_to_num(-1)
    colour = match_semi_global(grey0.expand(3, -1, -1), grey1 / 255).disparity0[0].nan_to_num(-1)
    assert torch.equal(plain, colour)


def test_other_views_than_rectified_ones_are_refused() -> None:
    for kind in (False, "auto"):
        with pytest.raises(ValueError, match=r"^rectified must be True where MatchingConfig\.method is 'sgbm', got"):
            replace(SGBM, rectified=kind)
    with pytest.raises(ValueError, match="images0 and images1 of pair 0 must be of one size"):
        match_semi_global(noise(20, 30), noise(20, 31))
    with pytest.raises(ValueError, match="images1 must hold one image per pair"):
        match_semi_global([noise(20, 30)] * 2, [noise(20, 30)])


def test_descriptors_are_not_matched_under_another_method(scenes: list[StereoPair]) -> None:
    features = detect_features(scenes[0].image0[None], SGBM)
    with pytest.raises(ValueError, match=r"MatchingConfig\.method must be 'ssd' where descriptors are matched"):
        match_features(features, features, SGBM)
