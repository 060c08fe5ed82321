"""Refined matches lie nearer to exact truth, never farther than allowed and never where the images fit worse."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from tensor_stereo import DelaunayFilter, Matches, StereoPair
from tensor_stereo.batching import collate_matches
from tensor_stereo.configs import PipelineConfig
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tensor_stereo.features import detect_features, to_gray
from tensor_stereo.scores import Origin, refine_matches
from tensor_stereo.scores.alignment.form import map_points, no_alignment


@cache
def rendered(seed: int) -> StereoPair:
    return render_pair(seed)


def visible_keypoints(seed: int) -> tuple[Tensor, Tensor]:
    """GFTT keypoints of view 0 that view 1 sees, on whole px, and their exact disparity."""
    pair = rendered(seed)
    points = detect_features(to_gray(pair.image0[None]), PipelineConfig(detector="gftt")).keypoints.double().round()
    x, y = points.long().unbind(1)
    disparity = pair.disparity_gt[y, x].double()
    seen = ~pair.occluded[y, x] & (points[:, 0] - disparity > 10)
    return points[seen], disparity[seen]


def whole_disparities(seed: int) -> tuple[Matches, Tensor]:
    """Right matches but for the fraction of their disparity, and the true keypoints of view 1."""
    points, disparity = visible_keypoints(seed)
    zero = torch.zeros_like(disparity)
    truth = points - torch.stack([disparity, zero], 1)
    right = points - torch.stack([disparity.round(), zero], 1)
    return Matches(points, right, torch.tensor([0, len(points)])), truth


def refine(seed: int, matches: Matches, **settings: float) -> Matches:
    pair = rendered(seed)
    kept = torch.ones(matches.num_matches, dtype=torch.bool)
    return refine_matches(matches, [pair.image0], [pair.image1], kept, **settings)


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_fractions_of_the_disparity_are_found(seed: int) -> None:
    matches, truth = whole_disparities(seed)
    before = (matches.keypoints1 - truth)[:, 0].abs()
    after = (refine(seed, matches).keypoints1 - truth)[:, 0].abs()
    assert before.median() > 0.2  # fractions are spread evenly
    assert after.median() < 0.5 * before.median()
    assert after.mean() < before.mean()


def test_no_keypoint_moves_farther_than_allowed_nor_one_that_is_not_kept() -> None:
    matches, _ = whole_disparities(0)
    right = matches.keypoints1 + torch.tensor([0.0, 0.4])  # off their rows
    matches = replace(matches, keypoints1=right)
    for limit in (0.1, 0.3, 1.0):
        moved = refine(0, matches, max_shift_px=limit)
        way = torch.hypot(*(moved.keypoints1 - right).unbind(1))
        assert way.max() <= limit + 1e-5
        assert way.max() > 0.9 * limit
    kept = torch.arange(matches.num_matches) % 2 == 0
    moved = refine_matches(matches, [rendered(0).image0], [rendered(0).image1], kept)
    assert torch.equal(moved.keypoints1[~kept], right[~kept])
    assert torch.equal(moved.keypoints0, matches.keypoints0)


def test_partners_move_onto_their_rows() -> None:
    matches, truth = whole_disparities(1)
    off = replace(matches, keypoints1=matches.keypoints1 + torch.tensor([0.0, 0.5]))
    moved = refine(1, off)
    assert ((moved.keypoints1 - truth)[:, 1].abs() < 1e-4).double().mean() > 0.7


def test_a_batch_equals_the_loop_and_pairs_may_be_empty() -> None:
    pairs = [whole_disparities(seed)[0] for seed in (0, 1)]
    empty = Matches(
        torch.zeros(0, 2, dtype=torch.float64), torch.zeros(0, 2, dtype=torch.float64), torch.tensor([0, 0])
    )
    few = Matches(pairs[0].keypoints0[:2], pairs[0].keypoints1[:2], torch.tensor([0, 2]))
    batch = [pairs[0], empty, pairs[1], few]
    images = [[getattr(rendered(seed), name) for seed in (0, 0, 1, 0)] for name in ("image0", "image1")]
    whole = collate_matches(batch)
    kept = torch.ones(whole.num_matches, dtype=torch.bool)
    found = refine_matches(whole, *images, kept)
    parts = [
        refine_matches(one, [images[0][k]], [images[1][k]], torch.ones(one.num_matches, dtype=torch.bool)).keypoints1
        for k, one in enumerate(batch)
    ]
    assert torch.equal(found.keypoints1, torch.cat(parts))


def test_constant_images_and_borders_move_nothing_far() -> None:
    flat = torch.full((1, 40, 60), 90, dtype=torch.uint8)
    left = torch.tensor([[0.0, 0.0], [59.0, 39.0], [30.0, 20.0], [5.0, 39.0]], dtype=torch.float64)
    matches = Matches(left, left, torch.tensor([0, 4]))
    moved = refine_matches(matches, [flat], [flat], torch.ones(4, dtype=torch.bool))
    assert torch.equal(moved.keypoints1, matches.keypoints1)


def test_turned_views_are_refined_along_their_lines() -> None:
    """A half turn of view 1, image and keypoints, whose alignment is known."""
    matches, truth = whole_disparities(2)
    pair = rendered(2)
    height, width = pair.image1.shape[-2:]
    turn = torch.tensor([[-1.0, 0, width - 1], [0, -1, height - 1], [0, 0, 1]], dtype=torch.float64)
    batch = torch.zeros(matches.num_matches, dtype=torch.int64)
    turned, true = (map_points(turn[None], points, batch) for points in (matches.keypoints1, truth))
    along_rows = torch.tensor([[[0.0, 0, 0], [0, 0, -1], [0, 1, 0]]], dtype=torch.float64)
    known = no_alignment(1, turned, rectified=False)._replace(to_view0=turn[None], lines=along_rows)
    kept = torch.ones(matches.num_matches, dtype=torch.bool)
    moved = refine_matches(replace(matches, keypoints1=turned), [pair.image0], [pair.image1.flip(1, 2)], kept, known)
    before, after = ((points - true)[:, 0].abs() for points in (turned, moved.keypoints1))
    assert after.median() < 0.5 * before.median()
    straight = refine(2, matches)
    expected = map_points(turn[None], straight.keypoints1, batch)
    assert ((moved.keypoints1 - expected).abs().amax(1) < 0.02).double().mean() > 0.95


def test_gradients_pass_to_the_keypoints_as_if_shifts_were_constant() -> None:
    matches, _ = whole_disparities(0)
    left, right = matches.keypoints0.clone().requires_grad_(), matches.keypoints1.clone().requires_grad_()
    moved = refine(0, Matches(left, right, matches.ptr))
    way = torch.autograd.grad(moved.keypoints1.sum(), right)[0]
    assert way.eq(1).all()


def test_an_output_refines_what_it_keeps() -> None:
    matches, truth = whole_disparities(0)
    wrong = matches.keypoints1.clone()
    wrong[::4] = wrong[::4].flip(0)
    pair = rendered(0)
    images = pair.image0[None], pair.image1[None]
    output = DelaunayFilter()(matches.keypoints0, wrong, images0=pair.image0, images1=pair.image1)
    finer = output.refine(*images)
    kept = output.inlier
    assert torch.equal(finer.inlier, kept)
    assert torch.equal(finer.score, output.score)
    assert torch.equal(finer.matches.keypoints1[~kept], wrong[~kept])
    moved = finer.origin == int(Origin.REFINED)
    assert torch.equal(moved, (finer.matches.keypoints1 != wrong).any(1))
    right = kept & ((wrong - truth).abs().amax(1) < 1)
    assert (finer.matches.keypoints1 - truth)[right, 0].abs().median() < (wrong - truth)[right, 0].abs().median()


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"max_shift_px": 0.0}, "max_shift_px must be positive"), ({"max_shift_px": float("nan")}, "max_shift_px")],
)
def test_bad_settings_are_refused(settings: dict[str, float], message: str) -> None:
    matches, _ = whole_disparities(0)
    with pytest.raises(ValueError, match=message):
        refine(0, matches, **settings)
    with pytest.raises(TypeError, match="kept"):
        refine_matches(matches, [rendered(0).image0], [rendered(0).image1], torch.ones(matches.num_matches))
    with pytest.raises(ValueError, match="images0"):
        refine_matches(matches, [], [rendered(0).image1], torch.ones(matches.num_matches, dtype=torch.bool))
