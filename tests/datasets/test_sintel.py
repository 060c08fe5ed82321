"""The files are written here as the README of the archive says; no sample of theirs is at hand."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tensor_stereo.datasets import build_manifest, find_pairs, read_manifest, read_pair, write_manifest
from tensor_stereo.datasets.images import read_sintel_disparity, read_sintel_occlusion
from tensor_stereo.datasets.sintel import find_sintel

SHAPE = (6, 8)


def _write(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)


@pytest.fixture
def disparity(tmp_path: Path) -> np.ndarray:
    """The archive with one frame in both passes; its disparity in px."""
    disparity = np.linspace(0, 700, SHAPE[0] * SHAPE[1]).reshape(SHAPE)
    encoded = np.zeros((*SHAPE, 3), np.uint8)  # BGR
    encoded[..., 2] = np.floor(disparity / 4)
    encoded[..., 1] = np.floor(disparity * 64 % 256)
    occluded, outside = np.zeros(SHAPE, np.uint8), np.zeros(SHAPE, np.uint8)
    occluded[1, 2], outside[3, 0] = 255, 1
    training = tmp_path / "sintel" / "training"
    for name in ("clean_left", "clean_right", "final_left", "final_right"):
        _write(training / name / "alley_1" / "frame_0001.png", np.full((*SHAPE, 3), 9, np.uint8))
    for name, pixels in (("disparities", encoded), ("occlusions", occluded), ("outofframe", outside)):
        _write(training / name / "alley_1" / "frame_0001.png", pixels)
    return disparity


def test_both_passes_are_found_and_read(tmp_path: Path, disparity: np.ndarray) -> None:
    pairs = find_pairs(tmp_path)
    assert [(pair.dataset, pair.scene) for pair in pairs] == [
        ("sintel-clean", "alley_1/frame_0001"),
        ("sintel-final", "alley_1/frame_0001"),
    ]
    assert find_sintel(tmp_path) == pairs
    pair = read_pair(pairs[0])
    assert pair.disparity_gt is not None
    error = disparity - pair.disparity_gt.numpy()
    assert (error >= 0).all()
    assert (error < 1 / 64).all()  # "never exceeds 0.016 pixel"
    assert pair.occluded is not None
    assert pair.occluded.nonzero().tolist() == [[1, 2], [3, 0]]


def test_a_manifest_keeps_what_the_reader_needs(tmp_path: Path, disparity: np.ndarray) -> None:
    write_manifest(build_manifest([tmp_path]), tmp_path / "m.parquet")
    pair = read_pair(read_manifest(tmp_path / "m.parquet")[1])
    assert torch.equal(pair.disparity_gt, read_pair(find_pairs(tmp_path)[1]).disparity_gt)
    assert len(disparity) == SHAPE[0]


def test_damaged_maps_are_named(tmp_path: Path) -> None:
    _write(tmp_path / "grey.png", np.zeros(SHAPE, np.uint8))
    with pytest.raises(ValueError, match=r"grey\.png must be an 8-bit RGB image"):
        read_sintel_disparity(tmp_path / "grey.png")
    _write(tmp_path / "occlusions" / "a" / "f.png", np.zeros(SHAPE, np.uint8))
    _write(tmp_path / "outofframe" / "a" / "f.png", np.zeros((2, 2), np.uint8))
    with pytest.raises(ValueError, match="outofframe"):
        read_sintel_occlusion(tmp_path / "occlusions" / "a" / "f.png")


def test_a_missing_right_view_is_named(tmp_path: Path, disparity: np.ndarray) -> None:
    assert disparity.shape == SHAPE
    (tmp_path / "sintel/training/clean_right/alley_1/frame_0001.png").unlink()
    with pytest.raises(ValueError, match=r"clean_right/alley_1/frame_0001\.png is missing"):
        find_pairs(tmp_path)
