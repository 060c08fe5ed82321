from __future__ import annotations

import numpy as np
import pytest

from tensor_stereo.dense import map_evidence
from tensor_stereo.dense.map_evidence import (
    MAX_DISPARITIES,
    NUM_OTHER,
    NUM_PLACE,
    NUM_PLANES,
    measure_map,
    search_range,
)
from tensor_stereo.dense.matching_costs import NUM_CURVES
from tests.dense.test_matching_costs import views


def noisy_map(seed: int, shape: tuple[int, int]) -> np.ndarray:
    rng = np.random.default_rng(seed)
    disparity = 6 + rng.normal(size=shape) * rng.choice([0.2, 4], shape)
    disparity[rng.random(shape) < 0.1] = np.nan
    return disparity.astype(np.float32)


def test_all_planes_are_finite_whatever_is_unknown() -> None:
    left, right = views()
    for disparity in (noisy_map(0, left.shape), np.full(left.shape, np.nan, np.float32)):
        for other in (None, noisy_map(1, left.shape)):
            for stride in (1, 3):
                planes = measure_map(disparity, left, right, other, stride)
                assert planes.shape == (NUM_PLANES, -(-left.shape[0] // stride), -(-left.shape[1] // stride))
                assert np.isfinite(planes).all()


def test_agreement_is_the_share_of_neighbours_within_a_pixel() -> None:
    left, right = views()
    disparity = noisy_map(2, left.shape)
    planes = measure_map(disparity, left, right)
    height, width = disparity.shape
    for plane, spread in zip(planes[1:5], (1, 2, 5, 10), strict=True):
        for y, x in ((0, 0), (9, 20), (height - 1, 3)):
            if np.isnan(disparity[y, x]):
                continue
            around = [
                (y + spread * dy, x + spread * dx)
                for dy in range(-2, 3) for dx in range(-2, 3) if (dy, dx) != (0, 0)
            ]  # fmt: skip
            inside = [p for p in around if 0 <= p[0] < height and 0 <= p[1] < width]
            agree = sum(abs(disparity[p] - disparity[y, x]) <= 1 for p in inside)
            assert plane[y, x] == pytest.approx(agree / 24)


def test_a_common_shift_of_view_1_changes_nothing_inside() -> None:
    rng = np.random.default_rng(5)
    scene = rng.integers(0, 256, (60, 400), dtype=np.uint8)
    disparity = noisy_map(3, (60, 300))
    left = np.ascontiguousarray(scene[:, 50:350])
    planes = []
    for shift in (0, 9):
        right = np.ascontiguousarray(scene[:, 56 + shift : 356 + shift])
        planes.append(measure_map(disparity + shift, left, right)[:, 25:35, 100:200])
    known = np.isfinite(disparity[25:35, 100:200])
    assert np.allclose(planes[0][:, known], planes[1][:, known], atol=2e-3)


def test_the_map_of_view_1_tells_how_far_both_disagree() -> None:
    left, right = views()
    disparity = np.full(left.shape, 6, np.float32)
    other = np.full(left.shape, 8, np.float32)
    other[:, 10] = np.nan
    has, known, gap, wide = measure_map(disparity, left, right, other)[-1 - NUM_OTHER : -1]
    assert (has == 1).all()
    assert (known[:, 16] == 0).all()
    assert (known[:, 17:] == 1).all()
    assert np.allclose(gap[:, 17:], np.tanh(2))
    assert np.allclose(wide[:, 17:], np.tanh(0.5))


def test_search_range_holds_the_map_and_is_bounded() -> None:
    first, count = search_range(np.linspace(-20, 30, 500, dtype=np.float32)[None])
    assert first <= -20
    assert first + count > 30
    assert search_range(np.linspace(0, 900, 500, dtype=np.float32)[None])[1] == MAX_DISPARITIES
    assert search_range(np.full((3, 3), np.nan, np.float32)) == (0, 1)


@pytest.mark.parametrize("stride", [1, 3])
def test_bands_of_rows_change_nothing(stride: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(8)
    scene = rng.integers(0, 256, (70, 90), dtype=np.uint8)
    left, right = np.ascontiguousarray(scene[:, :80]), np.ascontiguousarray(scene[:, 6:86])
    disparity = noisy_map(4, left.shape)
    whole = measure_map(disparity, left, right, None, stride)
    monkeypatch.setattr("tensor_stereo.dense.map_evidence._BAND_BYTES", 2 * 80 * search_range(disparity)[1] * 5)
    assert np.array_equal(measure_map(disparity, left, right, None, stride), whole)


def test_a_wide_map_is_searched_where_most_pixels_are() -> None:
    disparity = np.full((40, 900), 6, np.float32)
    disparity[:2] = 850
    first, count = search_range(disparity)
    assert count == MAX_DISPARITIES
    assert first <= 6 < first + count


def test_huge_values_leave_the_others_as_they_are() -> None:
    left, right = views()
    disparity = np.full(left.shape, 6, np.float32)
    expected = measure_map(disparity, left, right)
    for value in (3e38, -1e12, 5000):
        disparity[0, 0] = value
        planes = measure_map(disparity, left, right)
        assert np.isfinite(planes).all()
        first = map_evidence._NUM_OF_MAP + NUM_PLACE
        costs = slice(first, first + NUM_CURVES * map_evidence._NUM_OF_COSTS)
        near = (costs, slice(0, 4), slice(25, 38))  # away from the pixel
        assert np.allclose(planes[near], expected[near])


@pytest.mark.parametrize("box", [5, 11])
@pytest.mark.parametrize("pixel", [(30, 40), (0, 0), (2, 88)])
def test_the_plane_of_a_box_is_that_of_least_squares(box: int, pixel: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    known = rng.random((60, 90)) > 0.3
    level = np.where(known, 5 * rng.random((60, 90)), 0).astype(np.float32)
    distance, spread, slope_x, slope_y = map_evidence._of_plane(level, known.astype(np.float32), box)
    y, x = pixel
    rows, columns = (slice(max(k - box // 2, 0), k + box // 2 + 1) for k in pixel)
    inside = known[rows, columns]
    at_y, at_x = (axis[rows, columns][inside] for axis in np.indices(known.shape))
    target = level[rows, columns][inside].astype(np.float64)
    system = np.stack([at_x - x, at_y - y, np.ones(len(target))], 1)
    plane, residual, *_ = np.linalg.lstsq(system, target, rcond=None)
    found = [2 * np.arctanh(distance[pixel]), np.expm1(spread[pixel])]
    assert np.allclose(found, [level[pixel] - plane[2], np.sqrt(residual[0] / len(target))], atol=2e-3)
    assert np.allclose(np.arctanh([slope_x[pixel], slope_y[pixel]]) / 2, plane[:2], atol=2e-3)  # the tilt of 1e-3


@pytest.mark.parametrize("shape", [(1, 1), (3, 64), (2, 5)])
def test_small_images_have_planes_at_any_stride(shape: tuple[int, int]) -> None:
    image = np.zeros(shape, np.uint8)
    for stride in (1, 4, 64):
        planes = measure_map(np.zeros(shape, np.float32), image, image, None, stride)
        assert planes.shape[1:] == tuple(-(-size // stride) for size in shape)
