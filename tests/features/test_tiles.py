from __future__ import annotations

from functools import partial

import pytest
import torch
from kornia.feature import SIFTFeatureScaleSpace
from torch import Tensor

from tensor_stereo.configs import SIFTConfig, SyntheticConfig
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tensor_stereo.features import tiles, to_gray
from tensor_stereo.features.images import map_images
from tensor_stereo.features.sift import _detect_kornia, _detect_opencv
from tensor_stereo.features.tiles import ScaledFeatures, detect_in_tiles


def nearest(found: ScaledFeatures, expected: ScaledFeatures) -> tuple[Tensor, Tensor]:
    """Distance from every expected keypoint to the nearest found one of like scale and descriptor, and its row."""
    distance = torch.cdist(expected.keypoints.double(), found.keypoints.double())
    far = torch.cdist(expected.descriptors.double(), found.descriptors.double()) > 0.3  # another orientation
    return distance.masked_fill(far, torch.inf).min(1)


@pytest.mark.parametrize("backend", ["kornia", "opencv"])
def test_keypoints_of_tiles_are_those_of_the_whole_image(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pair = render_pair(5, SyntheticConfig(width_px=1000, height_px=760))
    image = to_gray(pair.image0[None])[0, 0].float()
    module = SIFTFeatureScaleSpace(20000, rootsift=False, descriptor_backend="pyramid", descriptor_layout="opencv")
    everything = SIFTConfig(backend="opencv", max_keypoints=20000)
    detect = {
        "kornia": partial(_detect_kornia, module=module),
        "opencv": partial(_detect_opencv, config=everything),
    }[backend]
    whole = detect_in_tiles(detect, image)
    monkeypatch.setattr(tiles, "MAX_PIXELS", 2**19)
    found = detect_in_tiles(detect, image)

    distance, row = nearest(found, whole)
    small = whole.sigma < tiles._MAX_SIGMA_PX
    assert int(small.sum()) > 500
    assert int((~small).sum()) > 20
    assert (distance[small] < 0.01).double().mean() > 0.999  # flat extrema move by a little with the rounding
    same = small & (distance < 0.01)
    assert torch.allclose(found.scores[row[same]], whole.scores[same], atol=1e-5)
    difference = (found.descriptors[row[same]] - whole.descriptors[same]).abs().amax(1)
    assert (difference < 0.01).double().mean() > 0.99  # keypoints of one place may differ in orientation alone
    assert (distance[~small] < 0.05 * whole.sigma[~small]).double().mean() > 0.85
    assert abs(len(found.keypoints) - len(whole.keypoints)) < 0.01 * len(whole.keypoints)


def test_tiles_cover_an_axis_once_and_see_what_their_keypoints_see() -> None:
    for size in (1, 300, 1648, 1649, 5000, 12345):
        cut = list(tiles._tiles(size))
        assert [k for tile in cut for k in range(size)[tile.inner]] == list(range(size))
        for tile in cut:
            assert tile.outer.start == max(0, tile.inner.start - tiles._HALO_PX)
            assert tile.outer.stop == min(size, tile.inner.stop + tiles._HALO_PX)
            assert (tile.outer.stop - tile.outer.start) ** 2 <= tiles.MAX_PIXELS


def test_thin_images_are_halved_too() -> None:
    assert torch.allclose(tiles._half(torch.ones(1, 9)), torch.ones(1, 5))


def test_half_size_keeps_the_place_of_the_first_pixel() -> None:
    ramp = torch.arange(40.0).expand(30, 40)
    assert torch.allclose(tiles._half(ramp)[:, 3:-3], ramp[::2, ::2][:, 3:-3], atol=1e-4)


def test_large_images_are_taken_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[int | None] = []
    monkeypatch.setattr(
        "tensor_stereo.features.images.map_threads", lambda function, items, max_workers: limits.append(max_workers)
    )
    map_images(len, torch.empty(2, 1, 2100, 2100, dtype=torch.uint8))
    map_images(len, torch.empty(2, 1, 1000, 1000, dtype=torch.uint8))
    map_images(len, torch.empty(2, 1, 1000, 1000, dtype=torch.uint8), max_workers=2)
    assert limits == [1, 4, 2]
