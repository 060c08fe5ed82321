from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
import torch

from tensor_stereo import DelaunayFilter, Matches
from tensor_stereo.batching import select_matches
from tensor_stereo.interop.opencv import from_opencv, select_dmatches, to_opencv


@pytest.fixture(scope="module")
def orb() -> tuple[Any, Any, Any, Any, Any]:
    """Images with disparity 12 px, ORB's keypoints in both, and what the brute-force matcher makes of them."""
    noise = np.random.default_rng(0).integers(0, 256, (160, 212), dtype=np.uint8)
    texture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX)
    image0, image1 = np.ascontiguousarray(texture[:, :-12]), np.ascontiguousarray(texture[:, 12:])
    detector = cv2.ORB_create(300)
    keypoints0, descriptors0 = detector.detectAndCompute(image0, None)
    keypoints1, descriptors1 = detector.detectAndCompute(image1, None)
    dmatches = cv2.BFMatcher(cv2.NORM_HAMMING).match(descriptors0, descriptors1)
    return (image0, image1), keypoints0, keypoints1, dmatches, (descriptors0, descriptors1)


def test_rows_are_the_points_that_opencv_draws(orb: Any) -> None:
    _, keypoints0, keypoints1, dmatches, _ = orb
    matches = from_opencv(keypoints0, keypoints1, dmatches)
    assert matches.num_matches == len(dmatches) > 50
    assert matches.ptr.tolist() == [0, len(dmatches)]
    left = cv2.KeyPoint_convert(keypoints0, [match.queryIdx for match in dmatches])
    right = cv2.KeyPoint_convert(keypoints1, [match.trainIdx for match in dmatches])
    assert torch.equal(matches.keypoints0, torch.from_numpy(left))
    assert torch.equal(matches.keypoints1, torch.from_numpy(right))
    assert matches.cost is not None
    assert matches.cost.tolist() == [match.distance for match in dmatches]


def test_inliers_are_matches_of_the_same_lists_and_more_often_right(orb: Any) -> None:
    _, keypoints0, keypoints1, dmatches, _ = orb
    verdict = DelaunayFilter()(from_opencv(keypoints0, keypoints1, dmatches))
    kept = select_dmatches(dmatches, verdict.inlier)
    assert 0 < len(kept) < len(dmatches)
    again = from_opencv(keypoints0, keypoints1, kept)
    assert torch.equal(again.keypoints0, verdict.to_matches().keypoints0)
    assert torch.equal(again.keypoints1, verdict.to_matches().keypoints1)

    def precision(matches: Matches) -> float:
        return ((matches.disparity - 12).abs() < 2).float().mean().item()

    assert precision(again) > precision(verdict.matches)


def test_matches_come_back_and_opencv_draws_them(orb: Any) -> None:
    (image0, image1), keypoints0, keypoints1, dmatches, _ = orb
    matches = from_opencv(keypoints0, keypoints1, dmatches)
    made0, made1, made = to_opencv(matches, size_px=7)
    assert {point.size for point in made0} == {7.0}
    back = from_opencv(made0, made1, made)
    for name in ("keypoints0", "keypoints1", "cost", "ptr"):
        assert torch.equal(getattr(back, name), getattr(matches, name)), name
    drawn = cv2.drawMatches(image0, made0, image1, made1, made, None, matchColor=(0, 255, 0))
    assert bool((drawn[..., 1] > drawn[..., 0]).any())


def test_costs_are_optional_and_batches_are_refused() -> None:
    pair = Matches(torch.rand(4, 2, dtype=torch.float64), torch.rand(4, 2, dtype=torch.float64), torch.tensor([0, 4]))
    assert [match.distance for match in to_opencv(pair)[2]] == [0.0] * 4
    batch = Matches(pair.keypoints0, pair.keypoints1, torch.tensor([0, 1, 4]))
    with pytest.raises(ValueError, match="matches must hold one pair, got 2"):
        to_opencv(batch)


def test_no_matches_are_an_empty_pair() -> None:
    matches = from_opencv((), (), ())
    assert matches.ptr.tolist() == [0, 0]
    assert matches.keypoints0.shape == (0, 2)
    assert to_opencv(matches) == ([], [], [])
    assert select_dmatches([], torch.zeros(0, dtype=torch.bool)) == []
    assert to_opencv(select_matches(matches, torch.zeros(0, dtype=torch.bool)))[2] == []


def test_lists_of_knn_match_and_foreign_indices_are_refused(orb: Any) -> None:
    _, keypoints0, keypoints1, dmatches, (descriptors0, descriptors1) = orb
    nested = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(descriptors0, descriptors1, k=2)
    with pytest.raises(TypeError, match="dmatches must be a flat list"):
        from_opencv(keypoints0, keypoints1, nested)
    with pytest.raises(ValueError, match="of keypoints1"):
        from_opencv(keypoints0, keypoints1[:3], dmatches)
    with pytest.raises(ValueError, match="of keypoints0"):
        from_opencv(keypoints0, keypoints1, [cv2.DMatch(-1, 0, 1.0)])
    with pytest.raises(ValueError, match="inlier"):
        select_dmatches(dmatches, torch.ones(2, dtype=torch.bool))
    with pytest.raises(TypeError, match="inlier must be bool"):
        select_dmatches(dmatches, torch.ones(len(dmatches)))
