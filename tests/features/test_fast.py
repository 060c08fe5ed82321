from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from tensor_stereo.configs import FASTConfig
from tensor_stereo.features import detect_fast
from tensor_stereo.features.fast import corner_score


def is_corner(image: np.ndarray, x: int, y: int, threshold: int) -> bool:
    """The segment test as its authors put it, one pixel at a time."""
    circle = [
        (0, -3), (1, -3), (2, -2), (3, -1), (3, 0), (3, 1), (2, 2), (1, 3),
        (0, 3), (-1, 3), (-2, 2), (-3, 1), (-3, 0), (-3, -1), (-2, -2), (-1, -3),
    ]  # fmt: skip
    levels = [int(image[y + dy, x + dx]) for dx, dy in circle]
    centre = int(image[y, x])
    for start in range(16):
        arc = [levels[(start + k) % 16] for k in range(9)]
        if all(level > centre + threshold for level in arc) or all(level < centre - threshold for level in arc):
            return True
    return False


@pytest.mark.parametrize("threshold", [5, 20, 60])
def test_keypoints_without_suppression_are_all_pixels_that_pass_the_segment_test(
    textures: Tensor, threshold: int
) -> None:
    image = textures[:1, :, :40, :50]
    features = detect_fast(image, FASTConfig(threshold=threshold, nonmax_suppression=False))
    found = {(int(x), int(y)) for x, y in features.keypoints.tolist()}
    gray = image[0, 0].numpy()
    assert found == {(x, y) for y in range(3, 37) for x in range(3, 47) if is_corner(gray, x, y, threshold)}


def test_score_is_the_largest_threshold_that_a_corner_passes(textures: Tensor) -> None:
    gray = textures[1, 0].numpy()
    features = detect_fast(textures[1:2], FASTConfig(nonmax_suppression=False, max_keypoints=60))
    for (x, y), score in zip(features.keypoints.int().tolist(), features.scores.int().tolist(), strict=True):
        assert is_corner(gray, x, y, score)
        assert not is_corner(gray, x, y, score + 1)


def test_score_is_opencvs_response(textures: Tensor) -> None:
    found = cv2.FastFeatureDetector.create(10).detect(textures[2, 0].numpy())
    pixels = torch.tensor([[int(v) for v in keypoint.pt] for keypoint in found])
    assert len(pixels) > 100
    assert corner_score(textures[2, 0], pixels).tolist() == [keypoint.response for keypoint in found]


def test_flat_pixel_is_a_corner_at_no_threshold() -> None:
    assert corner_score(torch.full((7, 7), 9, dtype=torch.uint8), torch.tensor([[3, 3]])).tolist() == [-1]


def test_whole_pixel_shift_of_the_image_shifts_keypoints_and_keeps_windows(textures: Tensor) -> None:
    large, (dx, dy), margin = textures[:1], (3, 5), 9
    a, b = detect_fast(large[..., :-dy, :-dx]), detect_fast(large[..., dy:, dx:])
    shift = torch.tensor([dx, dy])
    size = torch.tensor([large.shape[3] - dx, large.shape[2] - dy])

    def interior(features: object, offset: Tensor) -> dict[tuple[float, ...], list[float]]:
        rows = zip(features.keypoints - offset, features.descriptors, features.scores, strict=True)  # type: ignore[attr-defined]
        return {
            tuple(p.tolist()): [*d.tolist(), s.item()]
            for p, d, s in rows
            if (p >= margin).all() and (p < size - shift - margin).all()
        }

    moved = interior(a, shift)
    assert len(moved) > 30
    assert moved == interior(b, torch.zeros(2))
