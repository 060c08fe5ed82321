"""Correct matches: disparity and row agree with ground truth, but for what all rows of a pair share."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from tensor_stereo.evaluation.truth import matches_against_gt
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
