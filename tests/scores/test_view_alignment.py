"""Map and epipolar lines of any two views: what is known is found, and what all matches share changes no score."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tensor_stereo import DelaunayFilter, Matches
from tensor_stereo.batching import collate_matches, select_pairs
from tensor_stereo.configs import PipelineConfig, SIFTConfig
from tensor_stereo.datasets import find_pairs, read_pair
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.pipeline import run_pipeline
from tensor_stereo.scores import DomainWarning, measure_images
from tensor_stereo.scores.alignment import Alignment, align_matches, estimate_alignment
from tensor_stereo.scores.alignment.form import epipolar_frames, map_points, no_alignment
from tensor_stereo.scores.domain import Domain

SIZE = torch.tensor([450.0, 370.0], dtype=torch.float64)
UNKNOWN = no_alignment(1, SIZE, rectified=False)


def random(count: int, seed: int, wide: int = 2) -> Tensor:
    return torch.rand(count, wide, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def turn(degrees: float, scale: float) -> Tensor:
    """(3, 3) about the middle of view 0, then somewhere else."""
    c, s = (scale * f(math.radians(degrees)) for f in (math.cos, math.sin))
    x, y = (SIZE / 2).tolist()
    shifted = torch.tensor([[1.0, 0, -x], [0, 1, -y], [0, 0, 1]], dtype=torch.float64)
    return torch.tensor([[c, -s, 900.0], [s, c, -40.0], [0, 0, 1]], dtype=torch.float64) @ shifted


def under(homography: Tensor, points: Tensor) -> Tensor:
    return map_points(homography[None], points, torch.zeros(len(points), dtype=torch.int64))


def plane(seed: int, homography: Tensor, wrong: float, count: int = 500, noise_px: float = 0.2) -> Matches:
    """Matches of a plane, the first of them wrong."""
    left = random(count, seed) * SIZE
    right = under(homography, left + noise_px * (random(count, seed + 1) - 0.5))
    right[: int(wrong * count)] = under(homography, random(int(wrong * count), seed + 2) * SIZE)
    return Matches(left, right, torch.tensor([0, count]))


def relief(seed: int, wrong: float = 0.3, count: int = 500) -> Matches:
    """Matches of a rectified pair of two wavy surfaces, the first of them wrong."""
    left = random(count, seed) * SIZE
    disparity = 20 + 10 * torch.sin(left[:, 0] / 80) + 15 * (left[:, 1] > 200)
    right = left - torch.stack([disparity, torch.zeros_like(disparity)], 1) + 0.4 * (random(count, seed + 1) - 0.5)
    right[: int(wrong * count)] = random(int(wrong * count), seed + 2) * SIZE
    return Matches(left, right, torch.tensor([0, count]))


def seen_under(homography: Tensor, matches: Matches) -> Matches:
    """The same with another view 1."""
    return replace(matches, keypoints1=under(homography, matches.keypoints1))


def estimate(matches: Matches, rectified: object = False) -> Alignment:
    return estimate_alignment(matches, build_match_graphs(matches), rectified=rectified)  # type: ignore[arg-type]


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.floats(-180, 180), st.floats(0.5, 2), st.sampled_from([0.0, 0.5, 0.8]))
def test_rotation_and_scale_are_found_among_wrong_matches(
    seed: int, degrees: float, scale: float, wrong: float
) -> None:
    matches = plane(seed, turn(degrees, scale), wrong)
    found = estimate(matches)
    assert found.fitted.all()
    assert not found.rectified.any()
    right = slice(int(wrong * 500), None)
    miss = epipolar_frames(matches, found).partners[right] - matches.keypoints0[right]
    assert torch.hypot(*miss.unbind(1)).max() < 0.6  # noise of .14 px at most, and what the fit makes of it


@settings(max_examples=20)
@given(st.integers(0, 10**6), st.floats(-3e-4, 3e-4), st.floats(-3e-4, 3e-4), st.floats(-0.2, 0.2))
def test_perspective_and_shear_are_found_too(seed: int, g: float, h: float, shear: float) -> None:
    bent = torch.tensor([[1.0, shear, 0], [0, 1, 0], [g, h, 1]], dtype=torch.float64)
    matches = plane(seed, turn(30, 1.2) @ bent, 0.4)
    found = estimate(matches)
    miss = epipolar_frames(matches, found).partners[200:] - matches.keypoints0[200:]
    assert torch.hypot(*miss.unbind(1)).median() < 0.3


@pytest.mark.parametrize("degrees", [0.0, 35.0, 90.0, -150.0])
@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_lines_of_a_turned_pair_are_its_rows(degrees: float, scale: float) -> None:
    matches = seen_under(turn(degrees, scale), relief(1))
    found = estimate(matches)
    assert found.has_rows.all()
    frames = epipolar_frames(matches, found)
    off = frames.moved[150:, 1].abs()
    assert off.median() < 0.15  # .2 px at most in the data
    assert off.quantile(0.98) < 1
    assert (frames.along - torch.tensor([1.0, 0.0])).abs().max() < 0.05  # rows of view 0
    disparity = -frames.moved[150:, 0]
    truth = (relief(1).keypoints0 - relief(1).keypoints1)[150:, 0]
    # the map takes a smooth part of it out, the step between the surfaces stays
    slopes = torch.cat([matches.keypoints0[150:], torch.ones(350, 1, dtype=torch.float64)], 1)
    plane_of = torch.linalg.lstsq(slopes, (truth - disparity)[:, None]).solution
    assert ((truth - disparity)[:, None] - slopes @ plane_of).abs().median() < 0.5


def test_lines_may_meet_in_the_image() -> None:
    """A camera that moves forward: what is nearer moves farther from the middle."""
    left = random(600, 5) * SIZE
    middle = SIZE / 2
    depth = 4 + torch.sin(left[:, :1] / 60) + 2 * (left[:, 1:] > 200)
    right = middle + (left - middle) * (1 + 0.4 / depth)
    right[:150] = random(150, 6) * SIZE
    matches = Matches(left, right, torch.tensor([0, 600]))
    found = estimate(matches)
    assert found.has_rows.all()
    frames = epipolar_frames(matches, found)
    assert frames.spread > 0.8
    with pytest.warns(DomainWarning, match="meet among the keypoints"):
        assert DelaunayFilter(rectified=False)(matches).domain.tolist() == [Domain.EPIPOLE]
    assert frames.moved[150:, 1].abs().median() < 0.2
    outward = left - middle
    far = torch.hypot(*outward.unbind(1)) > 60
    cosine = (frames.along * outward).sum(1).abs() / torch.hypot(*outward.unbind(1))
    assert cosine[far].median() > 0.98


def test_nothing_in_common_is_no_alignment() -> None:
    for count in (0, 1, 2, 3, 11, 200):
        matches = Matches(random(count, 1) * SIZE, random(count, 2) * SIZE, torch.tensor([0, count]))
        found = estimate(matches)
        assert not found.fitted.any()
        assert not found.has_rows.any()
        assert torch.equal(found.to_view0, UNKNOWN.to_view0)
        torch.testing.assert_close(align_matches(matches, found).keypoints1, matches.keypoints1)
    with pytest.warns(DomainWarning, match="hardly do"):
        output = DelaunayFilter(rectified=False)(matches)
    assert output.domain.tolist() == [Domain.AGREEMENT]
    assert output.inlier.float().mean() < 0.05


@pytest.mark.parametrize("count", [4, 40])
def test_points_on_a_line_and_in_one_place_stay_finite(count: int) -> None:
    t = torch.arange(count, dtype=torch.float64)
    line = torch.stack([3 * t, 2 * t], 1)
    for left, right in ((line, line), (line, line.flip(1)), (line, line * 0), (line * 0, line * 0)):
        matches = Matches(left, right, torch.tensor([0, count]))
        found = estimate(matches)
        assert all(values.isfinite().all() for values in found)
        assert align_matches(matches, found).keypoints1.isfinite().all()


def pairs_of_all_kinds() -> list[Matches]:
    empty = Matches(
        torch.zeros(0, 2, dtype=torch.float64), torch.zeros(0, 2, dtype=torch.float64), torch.tensor([0, 0])
    )
    return [
        relief(1),
        seen_under(turn(40, 0.8), relief(2)),
        empty,
        plane(3, turn(170, 1.5), 0.5),
        Matches(random(30, 7) * SIZE, random(30, 8) * SIZE, torch.tensor([0, 30])),
        relief(4, count=90),
    ]


@pytest.mark.parametrize("rectified", [False, "auto"])
def test_a_batch_equals_the_loop_over_its_pairs(rectified: object) -> None:
    matches = collate_matches(pairs_of_all_kinds())
    found = estimate(matches, rectified)
    if rectified == "auto":
        assert found.rectified.tolist() == [True, False, False, False, False, True]
    for b in range(matches.num_pairs):
        alone = estimate(select_pairs(matches, b, b + 1), rectified)
        for whole, part in zip(found, alone, strict=True):
            assert torch.equal(whole[b], part[0])


@pytest.mark.parametrize("score", ["learned", "consensus"])
@pytest.mark.filterwarnings("ignore::tensor_stereo.scores.DomainWarning")
def test_scores_of_a_mixed_batch_are_those_of_the_loop(score: str) -> None:
    pairs = pairs_of_all_kinds()
    filter_ = DelaunayFilter(score=score, rectified="auto")
    whole = filter_(collate_matches(pairs))
    parts = [filter_(one) for one in pairs]
    torch.testing.assert_close(whole.score, torch.cat([one.score for one in parts]), rtol=0, atol=1e-5)
    assert torch.equal(whole.domain, torch.cat([one.domain for one in parts]))
    for rectified in (True, False):  # and as if the setting had said so
        told = DelaunayFilter(score=score, rectified=rectified)
        for one, pair in zip(parts, pairs, strict=True):
            if bool(one.alignment.rectified.all()) == rectified and pair.num_matches:
                assert torch.equal(one.score, told(pair).score)


@pytest.mark.parametrize("score", ["learned", "consensus"])
@settings(max_examples=12)
@given(st.integers(0, 1000), st.floats(-180, 180), st.floats(0.5, 2))
def test_turning_and_scaling_view_1_changes_no_score(score: str, seed: int, degrees: float, scale: float) -> None:
    matches = relief(seed)
    filter_ = DelaunayFilter(score=score, rectified=False)
    before, after = filter_(matches).score, filter_(seen_under(turn(degrees, scale), matches)).score
    # near ties of the graph may fall otherwise
    assert (before - after).abs().quantile(0.98) < 1e-3


@pytest.mark.parametrize("score", ["learned", "consensus"])
def test_rows_and_lines_of_one_pair_lead_to_like_verdicts(score: str) -> None:
    matches = relief(3)
    of_rows = DelaunayFilter(score=score)(matches)
    turned = DelaunayFilter(score=score, rectified="auto")(seen_under(turn(70, 1.4), matches))
    assert turned.alignment.rectified.tolist() == [False]
    assert (of_rows.inlier == turned.inlier).float().mean() > 0.95
    assert turned.inlier[150:].float().mean() > 0.9
    assert turned.inlier[:150].float().mean() < 0.05


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_a_tolerance_is_in_px_of_view_0(scale: float) -> None:
    """Half of the matches lie 2 px of view 0 off; of view 1 these are 2 times its scale."""
    left = random(600, 9) * SIZE
    off = torch.zeros_like(left)
    angle = random(300, 10, 1)[:, 0] * 2 * math.pi
    off[::2] = 2 * torch.stack([angle.cos(), angle.sin()], 1)
    matches = Matches(left, under(turn(25, scale), left + off), torch.tensor([0, 600]))
    output = DelaunayFilter(rectified=False)(matches)
    assert output.probability(5)[::2].median() > 0.8
    assert output.probability(1)[::2].median() < 0.3


def test_matches_are_aligned_with_gradients_and_the_alignment_has_none() -> None:
    matches = seen_under(turn(30, 1.3), relief(6, count=60))
    found = estimate(seen_under(turn(30, 1.3), relief(6)))

    def aligned(left: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
        result = align_matches(Matches(left, right, matches.ptr), found)
        return result.keypoints0, result.keypoints1

    leaves = [view.clone().requires_grad_() for view in (matches.keypoints0, matches.keypoints1)]
    moved = aligned(*leaves)
    way = torch.autograd.grad(moved[1].sum(), leaves[1], retain_graph=True)[0]
    step = torch.zeros_like(way)
    step[0, 0] = 1e-4
    change = aligned(leaves[0], leaves[1] + step)[1] - moved[1]
    torch.testing.assert_close(change.sum() / 1e-4, way[0, 0], rtol=1e-3, atol=1e-4)
    for score in ("learned", "consensus"):
        output = DelaunayFilter(score=score, rectified=False)(Matches(*leaves, matches.ptr))
        assert not any(values.requires_grad for values in output.alignment)
        gradients = torch.autograd.grad(output.score.sum(), leaves)
        assert all(gradient.isfinite().all() and gradient.abs().sum() > 0 for gradient in gradients)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 180.0])
def test_images_of_turned_views_say_what_those_of_rectified_ones_say(degrees: float) -> None:
    """View 1 is turned in truth; some matches lie 3 px off along their line, and the windows of both tell."""
    from kornia.geometry.transform import warp_perspective

    from tensor_stereo.datasets.synthetic.rendering import render_pair

    pair = render_pair(3)
    height, width = pair.image0.shape[-2:]
    left = 30 + random(300, 11) * torch.tensor([width - 60.0, height - 60.0], dtype=torch.float64)
    x, y = left.round().long().unbind(1)
    left = torch.stack([x, y], 1).double()
    disparity = pair.disparity_gt[y, x].double()
    known = disparity.isfinite() & (left[:, 0] - disparity > 20)
    left, disparity = left[known], disparity[known]
    off = torch.zeros_like(disparity)
    off[::3] = 3
    right = left - torch.stack([disparity + off, torch.zeros_like(off)], 1)
    homography = turn(degrees, 1.0)
    homography[:2, 2] += torch.tensor([-600.0, 300.0])
    size = (int(height * 2.2), int(width * 2.2))
    image1 = warp_perspective(pair.image1[None].double() / 255, homography[None], size, align_corners=True)[0].float()
    matches = Matches(left, under(homography, right), torch.tensor([0, len(left)]))
    graphs = build_match_graphs(matches)
    alignment = estimate_alignment(matches, graphs, rectified=False)
    evidence = measure_images([pair.image0], [image1], matches, graphs, alignment)
    straight = Matches(left, right, matches.ptr)
    of_rows = measure_images([pair.image0], [pair.image1], straight, build_match_graphs(straight))
    # the disparity at which the windows fit best, in the mean of both views, and what it costs to be elsewhere
    assert ((evidence.offset - of_rows.offset).abs() < 0.5).float().mean() > 0.85
    assert (of_rows.offset[::3] < -1).float().mean() > 0.5  # the test can fail
    similar = torch.corrcoef(torch.stack([evidence.values[:, 28], of_rows.values[:, 28]]))[0, 1]  # log SSD at the match
    assert similar > 0.9


def test_a_match_without_lines_is_held_against_a_disc() -> None:
    image = torch.rand(1, 60, 80, generator=torch.Generator().manual_seed(0))
    left = 20 + random(5, 12) * torch.tensor([40.0, 20.0], dtype=torch.float64)
    matches = Matches(left, left, torch.tensor([0, 5]))
    evidence = measure_images([image], [image], matches, build_match_graphs(matches), UNKNOWN)
    assert evidence.num_columns.tolist() == [9] * 5
    torch.testing.assert_close(evidence.first, torch.full((5,), -4.0))
    assert evidence.curve0.argmin(2).eq(4).all()  # where the match is


@pytest.mark.parametrize("wrong", [0.0, 0.5, 0.8])
def test_auto_takes_rectified_pairs_for_such(wrong: float) -> None:
    for seed in range(4):
        pair = relief(seed, wrong)
        for shift, drift in ((0.0, 0.0), (2.0, 0.0), (-3.0, 0.002)):
            rows = pair.keypoints1[:, 1] + shift + drift * pair.keypoints0[:, 0]
            moved = replace(pair, keypoints1=torch.stack([pair.keypoints1[:, 0], rows], 1))
            assert estimate(moved, "auto").rectified.tolist() == [True]


@pytest.mark.parametrize("wrong", [0.0, 0.5, 0.8])
@pytest.mark.parametrize(("degrees", "scale"), [(3.0, 1.0), (180.0, 1.0), (-90.0, 1.0), (0.0, 1.1), (25.0, 0.7)])
def test_auto_takes_other_pairs_for_such(degrees: float, scale: float, wrong: float) -> None:
    for seed in range(4):
        assert estimate(seen_under(turn(degrees, scale), relief(seed, wrong)), "auto").rectified.tolist() == [False]


@pytest.mark.parametrize("detector", ["sift", "fast"])
def test_auto_takes_no_published_pair_for_the_wrong_kind(data_root: Path, detector: str) -> None:
    config = PipelineConfig(detector=detector, sift=SIFTConfig(backend="opencv"), score="consensus", rectified="auto")
    for files in find_pairs(data_root):
        pair = read_pair(files)
        output = run_pipeline([(pair.image0, pair.image1)], config)
        assert output.alignment.rectified.all(), files.scene


def test_auto_asks_for_disparities_that_agree_as_well() -> None:
    left = random(600, 3) * SIZE
    for right_x in (SIZE[0] - left[:, 0], 2.5 * left[:, 0]):
        matches = Matches(left, torch.stack([right_x, left[:, 1]], 1), torch.tensor([0, 600]))
        assert estimate(matches, "auto").rectified.tolist() == [False]


@pytest.mark.parametrize(("count", "wrong"), [(20, 0.6), (40, 0.8), (160, 0.8)])
def test_auto_takes_few_matches_on_rows_for_a_rectified_pair(count: int, wrong: float) -> None:
    for seed in range(6):
        pair = relief(seed, wrong, count)
        assert estimate(pair, "auto").rectified.tolist() == [True]
        assert estimate(seen_under(turn(40, 1.2), pair), "auto").rectified.tolist() == [False]


def test_view_1_is_resampled_where_it_is_known_alone() -> None:
    """Keypoints that a wrong match takes far away do not make the image larger than view 1 is in view 0."""
    from tensor_stereo.scores.samplers import warp_view

    image = torch.rand(40, 60)
    far = torch.tensor([[0.0, 0.0], [59.0, 39.0], [900.0, 700.0], [-800.0, -500.0]])
    warped = warp_view(image, image, torch.eye(3, dtype=torch.float64), far)
    assert warped.image1.shape <= (40 + 2 * 14 + 1, 60 + 2 * 14 + 1)
    assert warped.known1.sum() == 40 * 60
