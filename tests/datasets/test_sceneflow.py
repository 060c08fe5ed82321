"""The layout is written here as the data sets' page publishes it; no sample of theirs is at hand."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tensor_stereo.datasets import find_pairs, read_pair, write_pfm
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
