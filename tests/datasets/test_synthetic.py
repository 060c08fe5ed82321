from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from tensor_stereo.configs import SyntheticConfig
from tensor_stereo.datasets.synthetic import Rendering, SyntheticDataset, render_pair, render_scene

SMALL = SyntheticConfig(width_px=160, height_px=120, max_disparity_px=30)


@pytest.fixture(scope="module")
def scene() -> Rendering:
    return render_scene(3, SMALL)


def _pixels(scene: Rendering) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[: scene.disparities[0].shape[0], : scene.disparities[0].shape[1]]
    return x.astype(np.float64), y


def test_visible_points_have_the_same_grey_level_in_both_views(scene: Rendering) -> None:
    """The texture belongs to the surface: where d is constant and whole, both views sample the same points."""
    flat = SyntheticConfig(width_px=160, height_px=120, max_disparity_px=30, noise_levels=0, gain=1, offset_levels=0)
    rendered = render_scene(3, flat)
    x, y = _pixels(rendered)
    visible = ~rendered.occluded[0]
    target = x - rendered.disparities[0]
    column = np.clip(np.floor(target).astype(int), 0, x.shape[1] - 2)
    weight = target - column
    view1 = rendered.clean[1]
    warped = view1[y, column] * (1 - weight) + view1[y, column + 1] * weight
    error = np.abs(warped - rendered.clean[0])[visible]
    # Linear interpolation blurs the finest octave, and edges mix two surfaces; a wrong disparity is far worse.
    shifted = np.clip(np.rint(target + 2).astype(int), 0, x.shape[1] - 1)
    wrong = np.abs(view1[y, shifted] - rendered.clean[0])[visible]
    assert np.median(error) < 2 < np.median(wrong) / 2
    assert error.mean() < wrong.mean() / 2.5


@pytest.mark.parametrize("view", [0, 1])
def test_both_disparity_maps_agree_where_both_views_see(scene: Rendering, view: int) -> None:
    x, y = _pixels(scene)
    own, other = scene.disparities[view], scene.disparities[1 - view]
    target = x - own if view == 0 else x + own
    left = np.clip(np.floor(target).astype(int), 0, x.shape[1] - 2)
    near = np.stack([other[y, left], other[y, left + 1]])
    smooth = np.ptp(near, axis=0) < 0.5  # px: both neighbours on one surface
    between = (near.min(0) - 0.02 <= own) & (own <= near.max(0) + 0.02)  # spheres curve between pixels
    seen = ~scene.occluded[view] & smooth
    assert seen.mean() > 0.5
    assert between[seen].mean() > 0.995


@pytest.mark.parametrize("view", [0, 1])
def test_occluded_points_lie_outside_or_behind_something_nearer(scene: Rendering, view: int) -> None:
    x, y = _pixels(scene)
    own, other = scene.disparities[view], scene.disparities[1 - view]
    target = x - own if view == 0 else x + own
    outside = (target < 0) | (target > x.shape[1] - 1)
    assert scene.occluded[view][outside].all()
    inside = scene.occluded[view] & ~outside
    columns = [np.clip(f(target).astype(int), 0, x.shape[1] - 1) for f in (np.floor, np.ceil)]
    nearer = np.maximum(*(other[y, c] for c in columns)) > own
    assert 0.01 < inside.mean() < 0.4
    # Something thinner than a pixel can hide a point between two columns.
    assert nearer[inside].mean() > 0.97


def test_seed_alone_decides() -> None:
    dataset = SyntheticDataset(3, seed=5, config=SMALL)
    forth = [dataset[k] for k in range(3)]
    back = [dataset[k] for k in (2, 1, 0)][::-1]
    for one, two in zip(forth, back, strict=True):
        assert torch.equal(one.image0, two.image0)
        assert torch.equal(one.disparity_gt, two.disparity_gt)  # type: ignore[arg-type]
    assert not torch.equal(forth[0].image0, forth[1].image0)
    assert not torch.equal(forth[0].image0, SyntheticDataset(1, seed=6, config=SMALL)[0].image0)
    assert [pair.name for pair in SyntheticDataset(2, config=SMALL)] == ["synthetic-00", "synthetic-01"]


def test_noise_is_independent_in_both_views() -> None:
    noisy = render_scene(1, replace(SMALL, noise_levels=4.0, gain=1.0, offset_levels=0.0))
    residuals = [image - clean for image, clean in zip(noisy.images, noisy.clean, strict=True)]
    for residual in residuals:
        assert residual.std() == pytest.approx(4.0, rel=0.05)  # 19 200 samples: 1 % is two standard errors
    assert abs(np.corrcoef(*(r.ravel() for r in residuals))[0, 1]) < 4 / np.sqrt(residuals[0].size)


def _fraction_incorrect(scene: Rendering) -> float:
    """FAST + SSD of 11 x 11 windows without gates, one-to-one by lowest cost, in OpenCV and NumPy."""
    points, windows = [], []
    for image in scene.images:
        found = cv2.FastFeatureDetector.create(20).detect(image)
        found = sorted(found, key=lambda k: -k.response)[:2000]
        xy = np.array([k.pt for k in found]).astype(int)
        padded = cv2.copyMakeBorder(image, 5, 5, 5, 5, cv2.BORDER_REFLECT).astype(np.float32)
        patches = np.lib.stride_tricks.sliding_window_view(padded, (11, 11))
        points.append(xy)
        windows.append(patches[xy[:, 1], xy[:, 0]].reshape(len(xy), -1))
    a, b = windows
    cost = (a * a).sum(1)[:, None] + (b * b).sum(1) - 2 * a @ b.T
    best = cost.argmin(1)
    order = np.argsort(cost[np.arange(len(a)), best], kind="stable")
    _, first = np.unique(best[order], return_index=True)
    kept = order[first]
    assert len(kept) >= 250
    left, right = points[0][kept], points[1][best[kept]]
    truth = scene.disparities[0][left[:, 1], left[:, 0]]
    return float((np.abs(truth - (left[:, 0] - right[:, 0])) > 1).mean())


def test_as_hard_as_real_scenes() -> None:
    fractions = [_fraction_incorrect(render_scene((0, k))) for k in range(4)]
    assert all(0.3 <= fraction <= 0.6 for fraction in fractions), fractions


def test_pair_carries_the_rendering() -> None:
    pair, scene = render_pair(3, SMALL), render_scene(3, SMALL)
    assert pair.image0.shape == (1, 120, 160)
    assert np.array_equal(pair.image1[0].numpy(), scene.images[1])
    assert pair.disparity_gt is not None
    assert np.array_equal(pair.disparity_gt.numpy(), scene.disparities[0].astype(np.float32))
    assert pair.occluded is not None
    assert np.array_equal(pair.occluded.numpy(), scene.occluded[0])
    assert np.isfinite(scene.disparities[0]).all()


def test_bad_settings_are_named() -> None:
    for name, value in (("width_px", 0), ("samples_per_px", 0), ("min_disparity_px", 99), ("noise_levels", -1)):
        with pytest.raises(ValueError, match=name):
            SyntheticConfig(**{name: value})
    with pytest.raises(ValueError, match="num_pairs"):
        SyntheticDataset(-1)
    with pytest.raises(IndexError, match="index"):
        SyntheticDataset(2)[2]
