"""Slopes of the disparity are those of least squares over sets of neighbours, and of the surfaces that made them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.scores.slopes import estimate_slopes
from tensor_stereo.types import Matches
from tests.oracles import neighbor_sets
from tests.scores.evidence_oracle import slope_at
from tests.scores.learned_oracle import random_pairs


@pytest.mark.parametrize("whole", [False, True])
def test_slopes_match_by_match(whole: bool) -> None:
    matches = random_pairs(3, (40, 0, 1, 25), whole=whole)
    graphs = build_match_graphs(matches)
    near = [[*a, *b] for a, b in zip(*(neighbor_sets(adjacency) for adjacency in graphs[:2]), strict=True)]
    left, right = matches.keypoints0.numpy(), matches.keypoints1.numpy()
    expected = [slope_at(i, left, right, voters) for i, voters in enumerate(near)]
    np.testing.assert_allclose(estimate_slopes(matches, graphs), expected, rtol=0, atol=1e-6)  # float32 of at most .5


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.2, 0.0), (0.0, 0.33), (-0.15, 0.25)])
def test_slanted_surface_with_a_step(slope: tuple[float, float]) -> None:
    rng = np.random.default_rng(1)
    left = rng.random((600, 2)) * [400, 300]
    per_px0 = np.array(slope) / (1 + slope[0] / 2)  # of the left view
    disparity = 60 + left @ per_px0 + np.where(left[:, 0] < 200, 0, 40)
    wrong = rng.random(600) < 0.2
    disparity[wrong] = rng.random(wrong.sum()) * 90
    right = left - np.stack([disparity, np.zeros(600)], 1)
    matches = Matches(torch.from_numpy(left), torch.from_numpy(right), torch.tensor([0, 600]))
    found = estimate_slopes(matches, build_match_graphs(matches)).numpy()[~wrong]
    near = abs(found - slope).max(1) < 0.05
    assert near.mean() > 0.7  # at the step and beside wrong matches a few neighbours decide
    assert (abs(np.median(found, 0) - slope) < 0.03).all()


def test_matches_without_neighbours_are_level_and_nothing_is_too_steep() -> None:
    left = torch.tensor([[0.0, 0.0], [500.0, 500.0], [501.0, 500.0], [500.0, 501.0]])
    steep = left - torch.stack([torch.tensor([0.0, 0.0, 2.4, -2.4]), torch.zeros(4)], 1)
    matches = Matches(left, steep, torch.tensor([0, 1, 4]))
    found = estimate_slopes(matches, build_match_graphs(matches))
    assert not found[0].any()
    assert found.abs().max() <= 0.5
