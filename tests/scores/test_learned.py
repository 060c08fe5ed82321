"""Laws of the learned score: what may change nothing, what may be missing, what must stay finite."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from tensor_stereo.batching import collate_matches
from tensor_stereo.configs import PipelineConfig
from tensor_stereo.datasets import render_pair
from tensor_stereo.features import to_gray
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.pipeline import Stopwatch, match_pairs
from tensor_stereo.scores.image_evidence import (
    MAX_DISPARITIES,
    NUM_VALUES,
    ImageEvidence,
    measure_images,
    search_ranges,
)
from tensor_stereo.scores.learned import load_learned, score_learned
from tensor_stereo.types import Matches, StereoPair

ROUNDING = 1e-3  # of a logit, of log SSDs; sums of float32 in another order


@cache
def rendered(k: int) -> tuple[StereoPair, Matches]:
    pair = render_pair((4, k))
    matches = match_pairs([(to_gray(pair.image0[None]), to_gray(pair.image1[None]))], PipelineConfig(), Stopwatch())
    wide = {name: getattr(matches, name).double() for name in ("keypoints0", "keypoints1")}
    return pair, replace(matches, **wide)


def evidence_of(matches: Matches, *pairs: StereoPair) -> ImageEvidence:
    images0, images1 = [p.image0 for p in pairs], [p.image1 for p in pairs]
    return measure_images(images0, images1, matches, build_match_graphs(matches))


def logits(matches: Matches, evidence: ImageEvidence | None = None) -> Tensor:
    with torch.no_grad():
        return load_learned()(matches, build_match_graphs(matches), evidence)[0]


def reorder(matches: Matches, order: Tensor) -> Matches:
    return Matches(matches.keypoints0[order], matches.keypoints1[order], matches.ptr, cost=matches.cost[order])


def assert_same(given: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(given, expected, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("with_images", [True, False])
def test_order_of_the_matches_does_not_matter(with_images: bool) -> None:
    pair, matches = rendered(0)
    order = torch.randperm(matches.num_matches, generator=torch.Generator().manual_seed(0))
    other = reorder(matches, order)
    before = logits(matches, evidence_of(matches, pair) if with_images else None)
    assert_same(logits(other, evidence_of(other, pair) if with_images else None), before[order])


def test_order_of_equal_costs_does_not_matter() -> None:
    _, matches = rendered(0)
    matches = replace(matches, cost=torch.ones_like(matches.cost))
    order = torch.arange(matches.num_matches).flip(0)
    assert_same(logits(reorder(matches, order)), logits(matches)[order])


@pytest.mark.parametrize("with_images", [True, False])
def test_batch_is_the_loop_over_its_pairs(with_images: bool) -> None:
    pairs, items = zip(*(rendered(k) for k in range(3)), strict=True)
    whole = collate_matches(items)
    found = logits(whole, evidence_of(whole, *pairs) if with_images else None)
    loop = [logits(m, evidence_of(m, p) if with_images else None) for p, m in zip(pairs, items, strict=True)]
    assert_same(found, torch.cat(loop))


def test_runs_of_pairs_join_to_the_whole() -> None:
    items = [rendered(k % 3)[1] for k in range(9)]
    whole = collate_matches(items)
    found = torch.cat([score_learned(m, build_match_graphs(m)) for m in items])
    torch.testing.assert_close(score_learned(whole, build_match_graphs(whole)), found, rtol=0, atol=ROUNDING)


def test_shift_of_both_views_or_of_one_along_the_rows_does_not_matter() -> None:
    _, matches = rendered(1)
    both, along = torch.tensor([4096.0, -512.0]), torch.tensor([-64.0, 0.0])
    shifted = replace(matches, keypoints0=matches.keypoints0 + both, keypoints1=matches.keypoints1 + both)
    assert_same(logits(shifted), logits(matches))
    assert_same(logits(replace(matches, keypoints1=matches.keypoints1 + along)), logits(matches))


def test_pair_without_image_beside_one_with_image_is_scored_as_without() -> None:
    (pair0, matches0), (pair1, matches1) = rendered(0), rendered(1)
    whole = collate_matches([matches0, matches1])
    seen = evidence_of(whole, pair0, pair1)
    hidden = torch.arange(whole.num_matches) >= matches0.num_matches
    values = seen.values.masked_fill(hidden[:, None], 7.0)  # whatever stands there must not count
    seen = seen._replace(values=values, num_columns=seen.num_columns.masked_fill(hidden, 0))
    assert_same(logits(whole, seen), torch.cat([logits(matches0, evidence_of(matches0, pair0)), logits(matches1)]))


def test_score_tells_correct_from_wrong_better_with_images() -> None:
    pair, matches = rendered(2)
    x, y = matches.keypoints0.round().long().unbind(1)
    correct = (pair.disparity_gt[y, x] - matches.disparity).abs() <= 1
    areas = []
    for evidence in (None, evidence_of(matches, pair)):
        score = score_learned(matches, build_match_graphs(matches), evidence)
        areas.append(float((score[correct][:, None] > score[~correct]).float().mean()))
    assert 0.8 < areas[0] < areas[1]


def test_gradients_are_finite() -> None:
    _, matches = rendered(0)
    left, right = (x.clone().requires_grad_() for x in (matches.keypoints0, matches.keypoints1))
    score_learned(replace(matches, keypoints0=left, keypoints1=right), build_match_graphs(matches)).sum().backward()
    assert left.grad.isfinite().all()
    assert right.grad.isfinite().all()
    assert right.grad.abs().max() > 0


def test_gradients_are_finite_where_all_disparities_agree() -> None:
    y, x = torch.meshgrid(torch.arange(9.0) * 8, torch.arange(9.0) * 8, indexing="ij")
    left = torch.stack([x.reshape(-1), y.reshape(-1)], 1).requires_grad_()
    matches = Matches(left, left.detach() - torch.tensor([8.0, 0.0]), torch.tensor([0, 81]))
    score_learned(matches, build_match_graphs(matches)).sum().backward()
    assert left.grad.isfinite().all()


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_pairs_of_few_matches_are_scored(count: int) -> None:
    points = torch.arange(2.0 * count).reshape(count, 2)
    matches = Matches(points, points, torch.tensor([0, 0, count]))
    image = torch.zeros(1, 20, 30, dtype=torch.uint8)
    graphs = build_match_graphs(matches)
    for evidence in (None, measure_images([image, image], [image, image], matches, graphs)):
        score = score_learned(matches, graphs, evidence)
        assert score.shape == (count,)
        assert score.isfinite().all()


def test_duplicates_and_keypoints_far_outside_are_scored() -> None:
    pair, matches = rendered(0)
    points = matches.keypoints0.clone()
    points[1], points[2] = points[0], 1e7
    matches = replace(matches, keypoints0=points)
    assert score_learned(matches, build_match_graphs(matches), evidence_of(matches, pair)).isfinite().all()


def test_number_of_images_must_fit() -> None:
    _, matches = rendered(0)
    with pytest.raises(ValueError, match=r"images0 must hold one image per pair \(1\), got 0"):
        measure_images([], [], matches, build_match_graphs(matches))


def test_mirrored_views_change_places() -> None:
    """Seen in a mirror the right view is the left one; evidence that tells them apart would be wrong in one of them."""
    pair, matches = rendered(1)
    width = pair.image0.shape[2]

    def mirror(points: Tensor) -> Tensor:
        return torch.stack([width - 1 - points[:, 0], points[:, 1]], 1)

    twin = Matches(mirror(matches.keypoints1), mirror(matches.keypoints0), matches.ptr, matches.cost)
    turned = replace(pair, image0=pair.image1.flip(2), image1=pair.image0.flip(2))
    found, expected = evidence_of(twin, turned), evidence_of(matches, pair)
    # log SSDs are compared with each other: twice the rounding of one
    for curve, twin_curve in ((found.curve0, expected.curve1), (found.curve1, expected.curve0)):
        torch.testing.assert_close(curve, twin_curve, rtol=0, atol=2 * ROUNDING)
    torch.testing.assert_close(found.offset, expected.offset, rtol=0, atol=2 * ROUNDING)
    size = (NUM_VALUES - 2) // 2  # of one view; there the left and the right half windows change places
    halves = [52, 53, 56, 57]
    rest = [k for k in range(size) if k not in halves]
    own, other = (values.values[:, : 2 * size].reshape(-1, 2, size) for values in (found, expected))
    torch.testing.assert_close(own[..., rest], other.flip(1)[..., rest], rtol=0, atol=2 * ROUNDING)
    swapped = other.flip(1)[..., [53, 52, 57, 56]]
    torch.testing.assert_close(own[..., halves], swapped, rtol=0, atol=2 * ROUNDING)


def test_equal_rivals_do_not_hang_on_rounding() -> None:
    """Under a pattern that repeats exactly, many places are equally good."""
    y, x = torch.meshgrid(torch.arange(80), torch.arange(160), indexing="ij")
    pattern = (((x // 4) + (y // 4)) % 2 * 200).to(torch.uint8)[None]
    rng = torch.Generator().manual_seed(0)
    left = torch.rand(60, 2, generator=rng, dtype=torch.float64) * torch.tensor([80.0, 50.0]) + torch.tensor(
        [60.0, 15.0]
    )
    matches = Matches(left, left - torch.tensor([20.0, 0.0]), torch.tensor([0, 60]), torch.rand(60, generator=rng))
    pair = StereoPair("pattern", pattern, pattern.roll(-20, 2))
    order = torch.randperm(60, generator=rng)
    shuffled = reorder(matches, order)
    assert_same(logits(shuffled, evidence_of(shuffled, pair)), logits(matches, evidence_of(matches, pair))[order])


def test_wide_ranges_are_searched_where_most_matches_are() -> None:
    rng = torch.Generator().manual_seed(0)
    left = torch.rand(300, 2, generator=rng, dtype=torch.float64) * 1000
    disparity = torch.where(left[:, 0] < 300, 700, 40 + 0.1 * left[:, 0])
    right = left - torch.stack([disparity, torch.zeros(300)], 1)
    matches = Matches(left, right, torch.tensor([0, 300]))
    ((first, count),) = search_ranges(matches, build_match_graphs(matches))
    assert count == MAX_DISPARITIES
    assert first <= 70
    assert first + count > 140


def test_costs_of_any_sign_are_evidence_and_infinite_ones_are_none() -> None:
    _, matches = rendered(0)
    assert_same(
        logits(replace(matches, cost=matches.cost - 1e6)),
        logits(replace(matches, cost=matches.cost - matches.cost.min())),
    )
    endless = matches.cost.clone()
    endless[3] = torch.inf
    assert_same(logits(replace(matches, cost=endless)), logits(replace(matches, cost=None)))


def test_modes_of_torch_change_nothing() -> None:
    pair, matches = rendered(0)
    expected, evidence = logits(matches), evidence_of(matches, pair)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(logits(matches), expected)
        for found, wanted in zip(evidence_of(matches, pair), evidence, strict=True):
            assert torch.equal(found, wanted)
    load_learned.cache_clear()
    with torch.inference_mode():
        assert torch.equal(logits(matches), expected)
    leaf = matches.keypoints1.clone().requires_grad_()  # the network of the inference mode takes part in gradients
    score_learned(replace(matches, keypoints1=leaf), build_match_graphs(matches)).sum().backward()
    assert leaf.grad.abs().sum() > 0
    torch.set_default_dtype(torch.float64)
    try:
        load_learned.cache_clear()
        assert torch.equal(logits(matches), expected)
    finally:
        torch.set_default_dtype(torch.float32)


def test_graphs_and_evidence_of_other_matches_are_refused() -> None:
    pair, matches = rendered(0)
    few = replace(
        matches,
        **{n: getattr(matches, n)[:50] for n in ("keypoints0", "keypoints1", "cost")},
        ptr=torch.tensor([0, 50]),
    )
    graphs = build_match_graphs(few)
    with pytest.raises(ValueError, match=r"graphs\.adjacency0 must have"):
        score_learned(matches, graphs)
    with pytest.raises(ValueError, match=r"graphs\.adjacency0 must have"):
        measure_images([pair.image0], [pair.image1], matches, graphs)
    with pytest.raises(ValueError, match="evidence must be that of 50 matches"):
        score_learned(few, graphs, evidence_of(matches, pair))
