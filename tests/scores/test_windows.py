"""Windows: bilinear samples, weights, and where a parabola is lowest; their costs are tested with the evidence."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tensor_stereo.ops.windows import (
    RADIUS_PX,
    TIGHT,
    compare_windows,
    lowest_place,
    sample_slanted,
    sample_windows,
    window_kernels,
)


@pytest.mark.parametrize("shear", [(0.0, 0.0), (0.25, 0.0), (0.0, -0.5), (-0.3, 0.2)])
def test_a_ramp_tells_where_slanted_windows_look(shear: tuple[float, float]) -> None:
    image = (torch.arange(90.0) * 2 + torch.arange(70.0)[:, None] * 3).contiguous()  # bilinear sampling is exact on it
    centers = torch.tensor([[45.25, 30.5], [41.0, 36.75]])
    found = sample_slanted(image, centers, 10, torch.tensor([shear, shear]))
    v, u = np.mgrid[-RADIUS_PX : RADIUS_PX + 1, -10:11]
    for window, (x, y) in zip(found.numpy(), centers.numpy(), strict=True):
        expected = 2 * (x + u + shear[0] * u + shear[1] * v) + 3 * (y + v)
        np.testing.assert_allclose(window, expected, rtol=1e-5)
    if shear == (0.0, 0.0):
        torch.testing.assert_close(found, sample_windows(image, centers, 10))


def test_tight_windows_keep_to_one_side_of_an_edge() -> None:
    window = torch.full((1, 15, 15), 50.0)
    window[:, :, 8:] = 150.0  # the pixel in the middle is the last one of the dark side
    weights = window_kernels(window)[0].reshape(15, 15, -1)
    torch.testing.assert_close(weights.sum((0, 1)), torch.ones(weights.shape[2]))
    assert float(weights[:, 8:, TIGHT].sum()) < 1e-3
    assert float(weights[:, 8:, 1].sum()) > 0.4


def test_only_the_tight_window_sees_that_all_is_brighter() -> None:
    windows = torch.rand(3, 15, 15, generator=torch.Generator().manual_seed(0)) * 100
    log_ssd, likeness, _ = compare_windows(windows, windows + 9, window_kernels(windows), has_tight=True)
    others = [k for k in range(log_ssd.shape[2]) if k != TIGHT]
    np.testing.assert_allclose(log_ssd[..., others].exp(), 2, atol=0.02)  # the noise alone
    np.testing.assert_allclose(log_ssd[..., TIGHT].exp(), 83, rtol=1e-3)
    assert (likeness > 0.9).all()


@pytest.mark.parametrize("place", [-2.75, -1.5, -0.25, 0.0, 0.4, 1.0, 2.9])
def test_lowest_place_of_a_parabola_is_exact(place: float) -> None:
    ssd = 3 + 5 * (torch.arange(-3, 4) - place) ** 2
    found = lowest_place(ssd.log().reshape(1, 7, 1))
    assert float(found) == pytest.approx(place, abs=1e-4)  # float32 logarithms of up to 180, there and back


def test_lowest_place_of_level_and_rising_costs_stays_near() -> None:
    assert lowest_place(torch.zeros(1, 7, 1)).abs() <= 3
    assert lowest_place(torch.arange(7.0).reshape(1, 7, 1)).abs() <= 3
