from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tensor_stereo.features.windows import extract_windows


@settings(max_examples=60)
@given(height=st.integers(1, 12), width=st.integers(1, 12), radius=st.integers(0, 8), seed=st.integers(0, 2**16))
def test_windows_are_those_of_an_image_with_a_reflected_border(height: int, width: int, radius: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    images = generator.integers(0, 256, (2, height, width)).astype(np.uint8)
    pixels = np.stack([generator.integers(0, width, 5), generator.integers(0, height, 5)], 1)
    owner = [0, 0, 1, 1, 1]
    expected = []
    for (x, y), b in zip(pixels, owner, strict=True):
        padded = cv2.copyMakeBorder(images[b], radius, radius, radius, radius, cv2.BORDER_REFLECT)
        expected.append(padded[y : y + 2 * radius + 1, x : x + 2 * radius + 1].ravel())
    windows = extract_windows(
        torch.from_numpy(images)[:, None],
        torch.from_numpy(pixels).float(),
        torch.tensor([0, 2, 5]),
        window_px=2 * radius + 1,
    )
    assert windows.dtype == torch.float32
    assert np.array_equal(windows.numpy(), np.array(expected, dtype=np.float32))


def test_window_is_centred_on_the_nearest_pixel() -> None:
    image = torch.arange(20, dtype=torch.uint8).view(1, 1, 4, 5)
    keypoints = torch.tensor([[1.4, 2.6], [-0.4, 3.4], [4.4, 0.4]])
    windows = extract_windows(image, keypoints, torch.tensor([0, 3]), window_px=1)
    assert windows[:, 0].tolist() == [16, 15, 4]


def test_no_keypoints_give_no_windows() -> None:
    windows = extract_windows(torch.zeros(2, 1, 3, 3, dtype=torch.uint8), torch.zeros(0, 2), torch.zeros(3).long())
    assert windows.shape == (0, 121)


def test_sums_of_squares_are_exact() -> None:
    extremes = torch.tensor([0, 255], dtype=torch.uint8).repeat(50)[:99].view(1, 1, 1, 99).expand(1, 1, 99, 99)
    a, b = extract_windows(extremes, torch.tensor([[48.0, 50], [49, 50]]), torch.tensor([0, 2]), window_px=15)
    assert (a - b).square().sum().item() == 15**2 * 255**2 <= 2**24


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"window_px": 10}, ValueError, "window_px must be odd"),
        ({"window_px": -1}, ValueError, "window_px must be odd"),
        ({"keypoints": torch.tensor([[5.0, 0.0]])}, ValueError, "keypoints must lie inside the images of 5 x 4 px"),
        ({"keypoints": torch.tensor([[float("nan"), 0.0]])}, ValueError, "keypoints must lie inside"),
        ({"images": torch.zeros(2, 1, 4, 5, dtype=torch.uint8)}, ValueError, r"images must have shape \(1, 1, H, W\)"),
        ({"images": torch.zeros(1, 1, 4, 5)}, TypeError, "images must be uint8"),
        ({"ptr": torch.tensor([0, 2])}, ValueError, "ptr must rise"),
    ],
)
def test_unfit_arguments_are_named(change: dict[str, object], error: type[Exception], message: str) -> None:
    arguments: dict[str, object] = {
        "images": torch.zeros(1, 1, 4, 5, dtype=torch.uint8),
        "keypoints": torch.zeros(1, 2),
        "ptr": torch.tensor([0, 1]),
        **change,
    }
    with pytest.raises(error, match=message):
        extract_windows(**arguments)  # type: ignore[arg-type]
