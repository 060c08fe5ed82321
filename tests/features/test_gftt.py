from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from kornia.feature import gftt_response
from torch import Tensor

from tensor_stereo.configs import GFTTConfig
from tensor_stereo.features import detect_gftt


def maxima(image: Tensor, config: GFTTConfig) -> list[tuple[int, int]]:
    """The definition, one pixel at a time, on kornia's responses; strongest first."""
    response = gftt_response(image[None].float())[0, 0].numpy()
    height, width = response.shape
    radius = max(config.min_distance_px - 1, 1)
    kept = []
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            rows = slice(max(y - radius, 0), y + radius + 1)
            columns = slice(max(x - radius, 0), x + radius + 1)
            window = response[rows, columns]
            first = np.unravel_index(window.argmax(), window.shape)  # the first by row, then column
            if response[y, x] <= np.float32(config.quality_level) * response.max():
                continue
            if (rows.start + first[0], columns.start + first[1]) == (y, x):
                kept.append((-response[y, x], y, x))
    return [(x, y) for _, y, x in sorted(kept)][: config.max_keypoints]


@pytest.mark.parametrize(
    "config",
    [
        GFTTConfig(),
        GFTTConfig(quality_level=0.3),
        GFTTConfig(max_keypoints=25),
        GFTTConfig(min_distance_px=0),
        GFTTConfig(min_distance_px=8),
    ],
)
def test_keypoints_are_the_strongest_local_maxima(textures: Tensor, config: GFTTConfig) -> None:
    image = textures[0, :, :50, :60]
    found = detect_gftt(image[None], config).keypoints.int().tolist()
    assert [tuple(p) for p in found] == maxima(image, config)
    assert len(found) > 5


def test_equal_maxima_keep_the_first_by_row_then_column() -> None:
    image = torch.zeros(1, 1, 41, 41, dtype=torch.uint8)
    image[..., 20, 20] = 255  # the four maxima around a dot are equal and closer to each other than 8 px
    assert len(detect_gftt(image, GFTTConfig(min_distance_px=2, quality_level=0.99)).keypoints) >= 1
    response = gftt_response(image.float())[0, 0]
    first = (response == response.max()).nonzero()[0].flip(0)
    assert detect_gftt(image, GFTTConfig(min_distance_px=12)).keypoints.tolist() == [first.tolist()]


@pytest.mark.parametrize("distance", [2, 5, 9])
def test_no_two_keypoints_are_closer_than_the_minimum(textures: Tensor, distance: int) -> None:
    points = detect_gftt(textures[:1], GFTTConfig(min_distance_px=distance)).keypoints
    gaps = (points[:, None] - points).abs().amax(2)
    assert gaps[~torch.eye(len(points), dtype=torch.bool)].min() >= distance


def test_opencv_backend_is_opencvs_detector(textures: Tensor) -> None:
    features = detect_gftt(textures[:1], GFTTConfig(backend="opencv", max_keypoints=40))
    expected = cv2.goodFeaturesToTrack(textures[0, 0].numpy(), 40, 0.01, 3)[:, 0]
    assert {tuple(p) for p in features.keypoints.tolist()} == {tuple(p) for p in expected.tolist()}


def test_backends_find_the_same_isolated_corners() -> None:
    image = torch.zeros(1, 1, 64, 64, dtype=torch.uint8)
    image[..., 20:40, 24:50] = 180
    corners = torch.tensor([[24.0, 20], [49, 20], [24, 39], [49, 39]])
    for backend in ("kornia", "opencv"):
        found = detect_gftt(image, GFTTConfig(backend=backend, quality_level=0.5, min_distance_px=5)).keypoints
        assert (found[:, None] - corners).norm(dim=2).amin(0).max() <= 2**0.5


def test_whole_pixel_shift_of_the_image_shifts_keypoints(textures: Tensor) -> None:
    large, (dx, dy), margin = textures[:1], (3, 5), 12
    config = GFTTConfig(quality_level=0.02)
    a, b = detect_gftt(large[..., :-dy, :-dx], config), detect_gftt(large[..., dy:, dx:], config)
    size = torch.tensor([large.shape[3] - dx, large.shape[2] - dy])
    shift = torch.tensor([dx, dy])
    floor = 0.03 * max(a.scores.max(), b.scores.max())  # above either image's own quality threshold

    def interior(points: Tensor, scores: Tensor) -> set[tuple[float, ...]]:
        keep = (points >= margin).all(1) & (points < size - shift - margin).all(1) & (scores > floor)
        return {tuple(p) for p in points[keep].tolist()}

    moved = interior(a.keypoints - shift, a.scores)
    assert len(moved) > 20
    assert moved == interior(b.keypoints, b.scores)
