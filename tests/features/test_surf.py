from __future__ import annotations

from pathlib import Path

import cv2
import mahotas.features.surf as mahotas_surf
import numpy as np
import pytest
import torch
from torch import Tensor

from tensor_stereo.features import detect_surf
from tensor_stereo.features.surf import hessian_determinant, refine_maxima
from tensor_stereo.matching import match_features


def make_blob(x: float, y: float, sigma: float) -> Tensor:
    """(1, 1, 150, 160) uint8 image of one Gaussian blob, pixel centres at integers."""
    rows, columns = torch.arange(150.0)[:, None], torch.arange(160.0)
    blob = torch.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
    return (40 + 180 * blob).round().to(torch.uint8)[None, None]


@pytest.mark.parametrize("sigma", [3.0, 4.0])
@pytest.mark.parametrize(("x", "y"), [(70, 65), (70.3, 64.8), (71.4, 63.6), (69.75, 65.25)])
def test_blob_is_found_at_its_centre(x: float, y: float, sigma: float) -> None:
    found = detect_surf(make_blob(x, y, sigma)).keypoints[0]
    assert (
        found - torch.tensor([x, y])
    ).abs().max() < 0.12  # box filters; mahotas' own positions are off by up to 1 px


def integral_and_points(image: Tensor) -> tuple[np.ndarray, np.ndarray]:
    integral = mahotas_surf.integral(image.numpy().astype(np.float64))
    return integral, mahotas_surf.interest_points(integral, is_integral=True)


def test_determinant_is_mahotas_score(textures: Tensor) -> None:
    integral, points = integral_and_points(textures[0, 0])
    y, x = np.rint(points[:, :2].T).astype(np.int64)
    lobe = 2 * np.rint((points[:, 2] / 0.4 - 1) / 2).astype(np.int64) + 1
    first_octave = np.isclose(hessian_determinant(integral, y, x, lobe), points[:, 3], rtol=1e-12, atol=0)
    assert first_octave.sum() >= 0.8 * len(points) > 20


def test_refined_points_stay_in_their_grid_cell_and_keep_their_score(textures: Tensor) -> None:
    integral, points = integral_and_points(textures[1, 0])
    refined = refine_maxima(integral, points, num_octaves=4, initial_step_px=1)
    assert np.array_equal(refined[:, 3:], points[:, 3:])
    assert np.abs(refined[:, :2] - points[:, :2]).max() <= 8
    assert (refined[:, 2] > 0).all()
    assert not np.array_equal(refined[:, :2], points[:, :2])


def test_point_of_the_second_octave_is_refined_on_its_own_grid() -> None:
    view = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(300, 340)), (0, 0), 3)
    integral = mahotas_surf.integral((view - view.min()) / np.ptp(view) * 255)
    first = {tuple(p) for p in mahotas_surf.interest_points(integral, nr_octaves=1, is_integral=True)}
    both = mahotas_surf.interest_points(integral, nr_octaves=2, is_integral=True)
    points = np.array([p for p in both if tuple(p) not in first])
    # lobes of 9, 13, ... px belong to both octaves, so the score alone does not tell them apart
    y, x = (np.rint(points[:, k, None] / 2).astype(np.int64) * 2 for k in (0, 1))
    lobe = np.rint((points[:, 2, None] / 0.4 - 1) / 4).astype(np.int64) * 4 + 1
    scales, rows, columns = (shift.ravel() for shift in np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"))
    finer = hessian_determinant(integral, y + rows, x + columns, lobe + 2 * scales)  # (N, 27) around the same place
    coarse_only = finer.max(1) > finer[:, 13] * (1 + 1e-9)
    assert coarse_only.sum() > 5
    alone = refine_maxima(integral, points, num_octaves=1, initial_step_px=1)
    refined = refine_maxima(integral, points, num_octaves=2, initial_step_px=1)
    assert np.array_equal(alone[coarse_only], points[coarse_only])
    assert (refined[coarse_only] != points[coarse_only]).any(1).all()


def test_point_that_is_no_grid_maximum_stays_as_it_is(textures: Tensor) -> None:
    integral, points = integral_and_points(textures[1, 0])
    points = points[:3].copy()
    points[1, 3] *= 2  # a score that no octave has there
    refined = refine_maxima(integral, points, num_octaves=4, initial_step_px=1)
    assert np.array_equal(refined[1], points[1])
    assert not np.array_equal(refined[[0, 2]], points[[0, 2]])


def test_mirrored_image_has_mirrored_keypoints(textures: Tensor) -> None:
    one, other = (detect_surf(image).keypoints for image in (textures[:1], textures[:1].transpose(2, 3)))
    gaps = (one[:, None] - other.flip(1)).norm(dim=2).amin(1)
    assert (gaps < 1e-3).float().mean() > 0.9  # exchange of axes; blocks of 3 x 3 x 3 settle ties in another order


def test_descriptors_have_unit_length(textures: Tensor) -> None:
    descriptors = detect_surf(textures).descriptors
    assert ((descriptors.norm(dim=1) - 1).abs() < 1e-5).all()


def test_correct_matches_are_placed_better_than_mahotas_places_them(data_root: Path) -> None:
    scene = data_root / "middlebury" / "2003" / "cones"
    views = [cv2.imread(str(scene / name), cv2.IMREAD_GRAYSCALE) for name in ("im2.png", "im6.png")]
    truth = torch.from_numpy(cv2.imread(str(scene / "disp2.png"), cv2.IMREAD_UNCHANGED) / 4)
    images = [torch.from_numpy(view)[None, None] for view in views]
    matches = match_features(*(detect_surf(image) for image in images))
    x, y = matches.keypoints0.round().long().unbind(1)
    error = (truth[y, x] - matches.disparity).abs()[truth[y, x] > 0]
    assert error[error < 3].median() < 0.35  # 0.25; 0.45 with mahotas' own positions
