"""Repaired matches are right more often than not, keep their place, and are judged as any other."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tensor_stereo import DelaunayFilter, Matches
from tensor_stereo.batching import collate_matches, select_pairs
from tensor_stereo.scores import Origin, repair_matches
from tests.scores.test_refine import rendered, visible_keypoints


def partly_wrong(seed: int) -> tuple[Matches, Tensor, Tensor]:
    """Matches of which every third is wrong, the truth of view 1, and which are right."""
    points, disparity = visible_keypoints(seed)
    truth = points - torch.stack([disparity, torch.zeros_like(disparity)], 1)
    right, is_right = truth.clone(), torch.arange(len(points)) % 3 > 0
    right[~is_right] = right[~is_right].flip(0)
    return Matches(points, right, torch.tensor([0, len(points)])), truth, is_right


def images(*seeds: int) -> tuple[list[Tensor], list[Tensor]]:
    return [rendered(seed).image0 for seed in seeds], [rendered(seed).image1 for seed in seeds]


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_most_wrong_matches_find_their_partner(seed: int) -> None:
    matches, truth, is_right = partly_wrong(seed)
    found = repair_matches(matches, *images(seed), is_right)
    assert torch.equal(found.rows, torch.arange(matches.num_matches))
    assert torch.equal(found.origin == int(Origin.REPAIRED), ~is_right)
    assert torch.equal(found.matches.keypoints1[is_right], matches.keypoints1[is_right])
    off = (found.matches.keypoints1 - truth)[~is_right].abs()
    assert (off[:, 0] < 1).double().mean() > 0.75
    assert off[:, 1].max() < 1e-4  # rows of a rectified pair
    assert found.matches.cost[~is_right].isinf().all()
    assert found.matches.cost[is_right].eq(0).all()


def test_keypoints_without_a_partner_get_one_behind_those_of_their_pair() -> None:
    pairs, frees, truths = [], [], []
    for seed in (0, 2):
        points, disparity = visible_keypoints(seed)
        truth = points - torch.stack([disparity, torch.zeros_like(disparity)], 1)
        given = torch.arange(len(points)) % 2 == 0
        pairs.append(Matches(points[given], truth[given], torch.tensor([0, int(given.sum())])))
        frees.append(torch.cat([points, points[:5]]))  # all of them, some twice: those of matches are left out
        truths.append(truth[~given])
    whole = collate_matches(pairs)
    ptr0 = torch.tensor([0, *map(len, frees)]).cumsum(0)
    kept = torch.ones(whole.num_matches, dtype=torch.bool)
    found = repair_matches(whole, *images(0, 2), kept, keypoints0=torch.cat(frees), ptr0=ptr0)
    for b, (pair, truth) in enumerate(zip(pairs, truths, strict=True)):
        mine = select_pairs(found.matches, b, b + 1)
        rows = found.rows[found.matches.ptr[b] : found.matches.ptr[b + 1]]
        assert torch.equal(
            rows, torch.cat([torch.arange(pair.num_matches) + whole.ptr[b], torch.full((len(truth),), -1)])
        )
        assert ((mine.keypoints1[pair.num_matches :] - truth)[:, 0].abs() < 1).double().mean() > 0.75


def test_a_batch_equals_the_loop_over_its_pairs() -> None:
    pairs, masks = [], []
    for seed in (0, 3):
        matches, _, is_right = partly_wrong(seed)
        pairs.append(matches)
        masks.append(is_right)
    few = Matches(pairs[0].keypoints0[:3], pairs[0].keypoints1[:3], torch.tensor([0, 3]))
    nothing = torch.zeros(0, 2, dtype=torch.float64)
    pairs += [few, Matches(nothing, nothing, torch.tensor([0, 0]))]
    masks += [torch.ones(3, dtype=torch.bool), torch.ones(0, dtype=torch.bool)]
    views = images(0, 3, 0, 0)
    whole = repair_matches(collate_matches(pairs), *views, torch.cat(masks))
    for b, (pair, mask) in enumerate(zip(pairs, masks, strict=True)):
        alone = repair_matches(pair, views[0][b : b + 1], views[1][b : b + 1], mask)
        assert torch.equal(select_pairs(whole.matches, b, b + 1).keypoints1, alone.matches.keypoints1)
    assert torch.equal(
        repair_matches(few, *images(0), torch.zeros(3, dtype=torch.bool)).matches.keypoints1, few.keypoints1
    )


def test_an_output_repairs_what_it_rejects_and_judges_it_anew() -> None:
    matches, truth, is_right = partly_wrong(0)
    views = images(0)
    output = DelaunayFilter()(matches, images0=views[0], images1=views[1])
    assert output.inlier[~is_right].double().mean() < 0.1
    more = output.repair(*views).refine(*views)
    assert torch.equal(more.rows, torch.arange(matches.num_matches))
    assert more.inlier.sum() > 1.2 * output.inlier.sum()
    correct = (more.matches.keypoints1 - truth).abs().amax(1) <= 1
    assert correct[more.inlier].double().mean() > 0.93
    assert set(more.origin.tolist()) == {0, 1, 2}
    assert (more.score[~more.inlier] < 0.5).all()


def test_hidden_points_come_out_rejected() -> None:
    """Keypoints of view 0 that view 1 does not see have no right partner."""
    pair = rendered(0)
    matches, _, _ = partly_wrong(0)
    y, x = (pair.occluded & pair.disparity_gt.isfinite()).nonzero().double().unbind(1)
    hidden = torch.stack([x, y], 1)[::7]
    output = DelaunayFilter()(matches, images0=[pair.image0], images1=[pair.image1])
    found = output.repair([pair.image0], [pair.image1], keypoints0=hidden)
    kept = found.inlier[found.rows < 0]
    assert len(kept) > 50
    assert kept.double().mean() < 0.3


def test_wrong_arguments_are_named() -> None:
    matches, _, is_right = partly_wrong(0)
    views = images(0)
    with pytest.raises(TypeError, match="kept"):
        repair_matches(matches, *views, is_right.long())
    two = collate_matches([matches, matches])
    with pytest.raises(ValueError, match="ptr0 must be given"):
        repair_matches(two, *images(0, 0), torch.cat([is_right, is_right]), keypoints0=matches.keypoints0)
    with pytest.raises(ValueError, match=r"keypoints0 must have shape \(N, 2\)"):
        repair_matches(matches, *views, is_right, keypoints0=matches.keypoints0[:, 0])
    with pytest.raises(ValueError, match="ptr0 must be offsets of 1 pairs"):
        repair_matches(matches, *views, is_right, keypoints0=matches.keypoints0[:4], ptr0=torch.tensor([0, 2, 4]))
    with pytest.raises(ValueError, match="ptr0"):
        repair_matches(
            matches, *views, is_right, keypoints0=matches.keypoints0, ptr0=torch.tensor([0, matches.num_matches - 1])
        )
    output = DelaunayFilter(score="consensus")(matches)
    with pytest.raises(ValueError, match="judge"):
        replace(output, judge=None).repair(*views)
