"""The layout is written here as the data sets' page publishes it; no sample of theirs is at hand."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tensor_stereo.datasets import find_pairs, read_pair, read_pfm, write_pfm
from tensor_stereo.datasets.sceneflow import find_sceneflow


def _frame(root: Path, inner: str, name: str, passes: tuple[str, ...] = ("cleanpass",)) -> np.ndarray:
    disparity = np.linspace(1, 9, 12 * 16, dtype=np.float32).reshape(12, 16)
    (root / "disparity" / inner / "left").mkdir(parents=True, exist_ok=True)
    write_pfm(root / "disparity" / inner / "left" / f"{name}.pfm", disparity)
    for kind in passes:
        for side in ("left", "right"):
            folder = root / f"frames_{kind}" / inner / side
            folder.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / f"{name}.png"), np.full((12, 16, 3), 7, np.uint8))
    return disparity


def test_frames_of_all_three_data_sets_are_found_and_read(tmp_path: Path) -> None:
    expected = _frame(tmp_path / "FlyingThings3D", "TRAIN/A/0000", "0006", ("cleanpass", "finalpass"))
    _frame(tmp_path / "monkaa", "a_rain_of_stones_x2", "0001")
    _frame(tmp_path / "Driving", "15mm_focallength/scene_backwards/fast", "0001")
    pairs = find_pairs(tmp_path)
    assert [(pair.dataset, pair.scene) for pair in pairs] == [
        ("driving-cleanpass", "15mm_focallength/scene_backwards/fast/0001"),
        ("flyingthings3d-cleanpass", "TRAIN/A/0000/0006"),
        ("flyingthings3d-finalpass", "TRAIN/A/0000/0006"),
        ("monkaa-cleanpass", "a_rain_of_stones_x2/0001"),
    ]
    assert find_sceneflow(tmp_path) == pairs
    pair = read_pair(pairs[1])
    assert pair.image0.shape == (3, 12, 16)
    assert torch.equal(pair.disparity_gt, torch.from_numpy(expected))


def test_frames_without_ground_truth_have_none(tmp_path: Path) -> None:
    _frame(tmp_path / "monkaa", "x", "0001")
    (tmp_path / "monkaa" / "disparity" / "x" / "left" / "0001.pfm").unlink()
    [pair] = find_pairs(tmp_path)
    assert pair.disparity_gt is None
    assert pair.gt_scale is None


def test_a_missing_right_view_is_named(tmp_path: Path) -> None:
    _frame(tmp_path / "monkaa", "x", "0001")
    (tmp_path / "monkaa" / "frames_cleanpass" / "x" / "right" / "0001.png").unlink()
    with pytest.raises(ValueError, match=r"right/0001\.png is missing"):
        find_pairs(tmp_path)


def test_frames_in_webp_are_found_and_those_in_png_preferred(tmp_path: Path) -> None:
    root = tmp_path / "FlyingThings3D"
    _frame(root, "TRAIN/A/0000", "0006")
    for side in ("left", "right"):
        folder = root / "frames_cleanpass_webp" / "TRAIN" / "A" / "0000" / side
        folder.mkdir(parents=True)
        for name in ("0006", "0007"):
            cv2.imwrite(str(folder / f"{name}.webp"), np.full((12, 16, 3), 7, np.uint8))
    pairs = find_pairs(tmp_path)
    assert [(pair.dataset, pair.image0.name) for pair in pairs] == [
        ("flyingthings3d-cleanpass", "0006.png"),
        ("flyingthings3d-cleanpass", "0007.webp"),
    ]
    assert pairs[0].disparity_gt is not None
    assert read_pair(pairs[1]).image0.shape == (3, 12, 16)


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_subset_of_flyingthings3d_is_found_and_read(tmp_path: Path, sign: int) -> None:
    disparity = np.linspace(1, 9, 12 * 16, dtype=np.float32).reshape(12, 16)
    root = tmp_path / "FlyingThings3D_subset"
    for part in ("train", "val"):
        for name in ("image_clean", "image_final"):
            for side in ("left", "right"):
                (root / part / name / side).mkdir(parents=True)
                cv2.imwrite(str(root / part / name / side / "0000012.png"), np.full((12, 16, 3), 7, np.uint8))
        for name in ("disparity", "disparity_occlusions"):
            (root / part / name / "left").mkdir(parents=True)
        write_pfm(root / part / "disparity" / "left" / "0000012.pfm", sign * disparity)
        cv2.imwrite(str(root / part / "disparity_occlusions" / "left" / "0000012.png"), np.uint8(255 * (disparity > 5)))
    pairs = find_pairs(root)
    assert [(pair.dataset, pair.scene) for pair in pairs] == [
        ("flyingthings3d-subset-cleanpass", "train/0000012"),
        ("flyingthings3d-subset-cleanpass", "val/0000012"),
        ("flyingthings3d-subset-finalpass", "train/0000012"),
        ("flyingthings3d-subset-finalpass", "val/0000012"),
    ]
    assert [pair.scene for pair in find_pairs(root / "val")] == ["val/0000012"] * 2
    for files in pairs:
        pair = read_pair(files)
        assert pair.disparity_gt is not None
        assert pair.occluded is not None
        assert torch.equal(pair.disparity_gt, torch.from_numpy(disparity))
        assert torch.equal(pair.occluded, torch.from_numpy(disparity > 5))


def test_real_maps_of_flyingthings3d_are_positive(data_root: Path) -> None:
    root = data_root.parent / "training_data" / "sceneflow"
    maps = sorted(root.rglob("*.pfm"))
    if not maps:
        pytest.skip(f"there are no maps of Scene Flow in {root}")
    assert all((read_pfm(path) > 0).all() for path in maps)
