"""What the learned score sees of matches and edges is what loops over sets of neighbours say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.scores.image_evidence import NUM_VALUES, ImageEvidence
from tensor_stereo.scores.learned_inputs import Quantities, find_receivers, measure_quantities
from tensor_stereo.types import Adjacency, Matches
from tests.scores.learned_oracle import random_evidence, random_pairs, see

# Coordinates from the mean of a pair are below 100 px: float32 keeps them to 100 * 2^-24 = 6e-6 px. The steepest
# quantity, exp(-8 gap / length), has slope 8 / length: 1e-4 on edges of half a pixel, and few are shorter.
ATOL = 2e-4


def assert_same(q: Quantities, matches: Matches, evidence: ImageEvidence | None = None) -> None:
    seen = see(matches, evidence)
    count = matches.num_matches
    i, j = q.i.numpy(), q.j.numpy()
    found = np.zeros((count, count), int)
    np.add.at(found, (i, j), 1)
    assert (i < j).all()
    np.testing.assert_array_equal(found, np.triu(seen.linked))  # every pair of neighbours once
    same = seen.pair[:, None] == seen.pair
    expected = {
        "nodes": seen.nodes,
        "disparity": seen.disparity - (seen.disparity @ same / same.sum(0)),
        "refined": seen.refined - (seen.disparity @ same / same.sum(0)),
        "edges": seen.edges[i, j],
        "odd": seen.odd[i, j],
        "step": seen.step[i, j],
        "image_i": seen.edge_image[i, j],
        "image_j": seen.edge_image[j, i],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(q, name), values, rtol=0, atol=ATOL, err_msg=name)
    for name in (*expected, "cost", "image", "has_cost", "has_image", "share", "degree"):
        assert getattr(q, name).dtype == torch.float32, name
    np.testing.assert_array_equal(q.batch, seen.pair)
    np.testing.assert_array_equal(q.degree[:, 0], np.maximum(seen.linked.sum(1), 1))
    np.testing.assert_allclose(q.share[:, 0], 1 / np.bincount(seen.pair)[seen.pair], rtol=1e-6)
    np.testing.assert_allclose(q.cost[seen.has_cost], seen.cost[seen.has_cost], rtol=0, atol=1e-5)
    np.testing.assert_array_equal(q.has_cost[:, 0], seen.has_cost)
    assert q.cost.isfinite().all()
    np.testing.assert_array_equal(q.has_image[:, 0], seen.has_image)
    np.testing.assert_array_equal(q.image, np.zeros((count, NUM_VALUES)) if evidence is None else seen.image)
    assert q.num_pairs == matches.num_pairs


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("whole", [False, True])
def test_quantities_are_those_of_loops_over_matches_and_edges(whole: bool, dtype: torch.dtype) -> None:
    for seed in range(3):
        matches = random_pairs(seed, whole=whole, dtype=dtype)
        bare = replace(matches, cost=None, group=None)
        for given, evidence in (
            (matches, None),
            (bare, random_evidence(seed, matches)),
            (replace(matches, group=None), random_evidence(seed + 1, matches, seen=0.5)),
        ):
            assert_same(measure_quantities(given, build_match_graphs(given), evidence), given, evidence)


@pytest.mark.parametrize("lengths", [(), (0,), (1,), (2, 0, 1), (3, 3)])
def test_few_matches(lengths: tuple[int, ...]) -> None:
    matches = random_pairs(5, lengths)
    evidence = random_evidence(5, matches)
    nothing = evidence._replace(
        curve0=evidence.curve0[..., :0], curve1=evidence.curve1[..., :0], num_columns=torch.zeros(matches.num_matches)
    )
    for seen in (evidence, nothing):
        assert_same(measure_quantities(matches, build_match_graphs(matches), seen), matches, seen)


def test_costs_below_zero_and_infinite_ones() -> None:
    matches = random_pairs(3, (12, 9, 12, 2))
    cost = matches.cost.abs() + 1
    cost[:12] -= 100
    cost[13], cost[34] = torch.inf, -torch.inf
    matches = replace(matches, cost=cost)
    q = measure_quantities(matches, build_match_graphs(matches))
    assert_same(q, matches)
    assert q.has_cost[12:21].sum() == q.has_cost[33:].sum() == 0
    whole = replace(matches, cost=torch.arange(35) // 2 - 9)
    assert_same(measure_quantities(whole, build_match_graphs(whole)), whole)


def test_common_shift_costs_no_digits() -> None:
    matches = random_pairs(0)
    away = torch.tensor([2.0**22, -(2.0**21)], dtype=torch.float64)  # there float32 tells half pixels only
    shifted = replace(matches, keypoints0=matches.keypoints0 + away, keypoints1=matches.keypoints1 + away)
    assert_same(measure_quantities(shifted, build_match_graphs(shifted)), matches)


def test_edges_of_almost_no_length_count_as_a_thousandth_of_a_pixel() -> None:
    tiny = 2.0**-12
    left = torch.tensor([[tiny, 0], [-tiny, 0], [0, 4], [0, -4.0]])  # the mean is zero, so float32 is exact here
    matches = Matches(left, left * torch.tensor([3.0, 1.0]), torch.tensor([0, 4]))
    q = measure_quantities(matches, build_match_graphs(matches))
    assert_same(q, matches)
    assert float(q.edges[:, 10].min()) == pytest.approx(0.5 * np.log(1e-6 + 4 * tiny**2), abs=1e-5)


def test_neighbors_of_one_view_only() -> None:
    matches = random_pairs(1, (12,))
    ptr, empty = matches.ptr, torch.zeros(0, dtype=torch.int64)
    none = Adjacency(torch.zeros(13, dtype=torch.int64), empty, ptr)
    some = build_match_graphs(matches).adjacency0
    for graphs in (MatchGraphs(some, none, empty), MatchGraphs(none, some, empty), MatchGraphs(none, none, empty)):
        q, seen = measure_quantities(matches, graphs), see(matches, graphs=graphs)
        np.testing.assert_allclose(q.edges, seen.edges[q.i, q.j], rtol=0, atol=ATOL)
        np.testing.assert_allclose(q.nodes, seen.nodes, rtol=0, atol=ATOL)


def test_windows_are_asked_from_half_a_pixel_on_and_within_their_range() -> None:
    left = torch.tensor([[0.0, 0.0], [8.0, 0.0], [0.0, 8.0], [8.0, 9.0]])
    disparity = torch.tensor([[2.0, 0.0], [2.5, 0.0], [2.25, 0.0], [5.0, 0.0]])
    matches = Matches(left, left - disparity, torch.tensor([0, 4]))
    curve = torch.arange(12.0).reshape(4, 3) + 1
    first, count = torch.tensor([2.0, 2.0, 3.0, 2.0]), torch.tensor([2, 3, 3, 1])
    curves = [torch.stack([sign * curve, 20 * sign * curve], 1) for sign in (1, -1)]
    evidence = ImageEvidence(torch.zeros(4, NUM_VALUES), *curves, first, count, torch.zeros(4))
    q = measure_quantities(matches, build_match_graphs(matches), evidence)
    assert_same(q, matches, evidence)
    told = {}
    for i, j, to_i, to_j in zip(q.i.tolist(), q.j.tolist(), q.image_i.tolist(), q.image_j.tolist(), strict=True):
        told[i, j], told[j, i] = to_i[:5], to_j[:5]
    assert told[0, 1] == [1, 20, -1, -20, 1]  # half a pixel away, between columns 0 and 1: the even one
    assert told[0, 2] == [0, 0, 0, 0, 1]  # a quarter of a pixel is the match's own disparity
    assert told[2, 0] == [0, 0, 0, 0, 0]  # before the first column
    assert told[1, 3] == [0, 0, 0, 0, 0]  # behind the last column
    assert told[3, 1] == [10, 200, -10, -200, 1]


def test_sums_reach_either_end() -> None:
    i, j = torch.tensor([0, 0, 1, 3]), torch.tensor([4, 1, 4, 4])
    to_i, to_j = torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(0)).unbind()
    expected = torch.zeros(6, 3).index_add(0, i, to_i).index_add(0, j, to_j)
    np.testing.assert_allclose(find_receivers(i, j, 6).sum(to_i, to_j), expected, rtol=0, atol=1e-6)


def test_no_gradient_through_cost() -> None:
    matches = random_pairs(2)
    matches = replace(matches, cost=matches.cost.requires_grad_())
    assert not measure_quantities(matches, build_match_graphs(matches)).cost.requires_grad
