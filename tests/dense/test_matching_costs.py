from __future__ import annotations

import cv2
import numpy as np
import pytest

from tensor_stereo.dense.matching_costs import census, cost_curves, detail

SIZE = (26, 41)


def views(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    scene = cv2.GaussianBlur(rng.integers(0, 256, (SIZE[0], SIZE[1] + 6), dtype=np.uint8), (0, 0), 0.8)
    left = np.ascontiguousarray(scene[:, :-6])
    right = np.clip(scene[:, 6:].astype(int) + rng.integers(-3, 4, SIZE), 0, 255).astype(np.uint8)
    return left, right


def average(values: np.ndarray, box: int) -> np.ndarray:
    """Mean over a box with repeated borders, one pixel after the other."""
    radius = box // 2
    padded = np.pad(values.astype(float), radius, mode="edge")
    height, width = values.shape
    return np.array([[padded[y : y + box, x : x + box].mean() for x in range(width)] for y in range(height)])


def shifted(image: np.ndarray, d: int) -> np.ndarray:
    """Values of view 1 at x - d, outermost columns repeated."""
    columns = np.clip(np.arange(image.shape[1]) - d, 0, image.shape[1] - 1)
    return image[:, columns]


def bits_one_by_one(image: np.ndarray) -> list[np.ndarray]:
    padded = np.pad(image, 2, mode="edge").astype(int)
    height, width = image.shape
    around = [(y, x) for y in range(5) for x in range(5) if (y, x) != (2, 2)]
    return [padded[y : y + height, x : x + width] < image for y, x in around]


@pytest.mark.parametrize("first", [-4, 0, 3])
def test_costs_are_those_of_their_definition(first: int) -> None:
    left, right = views()
    curves = cost_curves(left, right, first, 9)
    bits0, bits1 = bits_one_by_one(left), bits_one_by_one(right)
    mean0, mean1 = (np.clip(np.rint(v - average(v, 9)) + 128, 0, 255) for v in (left, right))
    for k in range(9):
        d = first + k
        differ = sum((a != shifted(b, d)).astype(float) for a, b in zip(bits0, bits1, strict=True))
        assert np.abs(curves.costs[0][k] - 10 * average(differ, 5)).max() <= 0.5 + 1e-3
        levels = np.minimum(np.abs(mean0 - shifted(mean1, d)), 30)
        assert np.abs(curves.costs[1][k] - 8 * average(levels, 9)).max() <= 0.5 + 1e-3


def test_least_costs_of_both_views_are_those_of_all_disparities() -> None:
    left, right = views(1)
    first, count = -2, 12
    curves = cost_curves(left, right, first, count)
    for costs, best, best1, winner1 in zip(*curves[:4], strict=True):
        assert np.array_equal(best, costs.min(0))
        for x1 in range(SIZE[1]):
            seen = [(first + k, costs[k, :, x1 + first + k]) for k in range(count) if 0 <= x1 + first + k < SIZE[1]]
            values = np.stack([value for _, value in seen])
            assert np.array_equal(best1[:, x1], values.min(0))
            assert np.array_equal(winner1[:, x1], np.array([d for d, _ in seen])[values.argmin(0)])


def test_rows_of_a_stride_are_those_of_all_rows() -> None:
    left, right = views(2)
    whole, part = cost_curves(left, right, 0, 8), cost_curves(left, right, 0, 8, 3)
    for a, b in zip(whole.costs, part.costs, strict=True):
        assert np.array_equal(a[:, ::3], b)
    for a, b in zip(whole.winner1, part.winner1, strict=True):
        assert np.array_equal(a[::3], b)


def test_brightness_changes_nothing() -> None:
    left, right = views(3)
    darker = (right // 2 + 40).astype(np.uint8)
    assert np.array_equal(census(np.minimum(right, 200) + 55), census(np.minimum(right, 200)))
    assert np.abs(detail(np.minimum(right, 200) + 55).astype(int) - detail(np.minimum(right, 200))).max() <= 1
    assert cost_curves(left, darker, 0, 9).costs[0][6, 5:-5, 12:-5].mean() < 60  # of 240: the right one still
