from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo.features.images import join_images, map_images, strongest_first, to_gray


def test_gray_uint8_is_returned_as_it_is() -> None:
    images = torch.arange(24, dtype=torch.uint8).view(2, 1, 3, 4)
    assert to_gray(images) is images


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_level_survives_floating_point(dtype: torch.dtype) -> None:
    levels = torch.arange(256, dtype=torch.uint8).view(1, 1, 16, 16)
    assert torch.equal(to_gray(levels.to(dtype) / 255), levels)


def test_colour_agrees_with_opencv_to_one_level() -> None:
    colour = np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    expected = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY).astype(int)  # fixed-point weights
    gray = to_gray(torch.from_numpy(colour).permute(2, 0, 1)[None])
    assert gray.shape == (1, 1, 64, 64)
    assert np.abs(gray[0, 0].numpy().astype(int) - expected).max() <= 1


def test_luma_is_rounded_to_the_nearest_level() -> None:
    colour = torch.from_numpy(np.random.default_rng(2).integers(0, 256, (1, 3, 40, 50)).astype(np.uint8))
    exact = (colour.double() * torch.tensor([0.299, 0.587, 0.114]).double().view(3, 1, 1)).sum(1, keepdim=True)
    assert (to_gray(colour) - exact).abs().max() <= 0.5 + 1e-4


def test_float_colour_equals_uint8_colour() -> None:
    colour = torch.from_numpy(np.random.default_rng(1).integers(0, 256, (2, 3, 20, 30)).astype(np.uint8))
    difference = to_gray(colour).int() - to_gray(colour.double() / 255).int()
    assert difference.abs().max() <= 1  # a luma of n + 1/2 can round to either side
    assert (difference != 0).float().mean() < 0.01


def test_gray_colour_keeps_its_level() -> None:
    levels = torch.arange(256, dtype=torch.uint8).view(1, 1, 16, 16)
    assert torch.equal(to_gray(levels.expand(1, 3, 16, 16)), levels)


def test_batch_without_images() -> None:
    assert to_gray(torch.zeros(0, 3, 4, 5)).shape == (0, 1, 4, 5)


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (torch.zeros(4, 5), r"images must have shape .* got \(4, 5\)"),
        (torch.zeros(1, 2, 4, 5), r"images must have shape"),
        (torch.zeros(1, 1, 0, 5), r"images must have at least one pixel"),
        (torch.full((1, 1, 2, 2), 1.5), r"images must lie in \[0, 1\].*1\.5"),
        (torch.full((1, 1, 2, 2), -0.1), r"images must lie in \[0, 1\]"),
        (torch.tensor([[[[0.5, float("nan")]]]]), r"images must lie in \[0, 1\] without NaN"),
    ],
)
def test_unfit_images_are_named(images: torch.Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        to_gray(images)


def test_other_integers_are_refused() -> None:
    with pytest.raises(TypeError, match=r"images must be uint8 or floating point, got torch\.int32"):
        to_gray(torch.zeros(1, 1, 2, 2, dtype=torch.int32))


def test_map_keeps_the_order_of_images() -> None:
    images = torch.arange(40, dtype=torch.uint8).view(10, 1, 2, 2)
    expected = [int(image.sum()) for image in images]
    for workers in (None, 1, 2):
        assert map_images(lambda image: int(image.sum()), images, max_workers=workers) == expected
    assert map_images(lambda image: int(image.sum()), images[:0]) == []


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(0, 2)), max_size=30), st.integers(1, 40))
def test_strongest_first_is_a_lexicographic_order(rows: list[tuple[int, int, int]], limit: int) -> None:
    table = np.array(rows, dtype=np.float32).reshape(-1, 3)
    expected = np.lexsort((table[:, 0], table[:, 1], -table[:, 2]))[:limit]
    order = strongest_first(torch.from_numpy(table[:, :2]), torch.from_numpy(table[:, 2]), limit)
    assert order.tolist() == expected.tolist()


def test_join_of_no_image_has_the_right_shapes() -> None:
    (keypoints, descriptors), ptr = join_images([], [(2,), (7,)], torch.device("cpu"))
    assert keypoints.shape == (0, 2)
    assert descriptors.shape == (0, 7)
    assert ptr.tolist() == [0]
    assert ptr.dtype == torch.int64
