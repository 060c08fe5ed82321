from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from tensor_stereo.datasets import read_pfm, write_pfm
from tensor_stereo.datasets.map_files import read_map, write_confidence

VALUES = np.array([[0.5, 7.25, np.inf], [-3, 120, 33.5]], np.float32)


def same(found: np.ndarray, expected: np.ndarray) -> bool:
    return found.dtype == np.float32 and np.array_equal(found, expected.astype(np.float32), equal_nan=True)


EXPECTED = np.where(np.isfinite(VALUES), VALUES, np.nan)


def test_floats_of_all_formats_are_read_as_they_are(tmp_path: Path) -> None:
    write_pfm(tmp_path / "map.pfm", VALUES)
    np.save(tmp_path / "map.npy", VALUES[None])
    np.save(tmp_path / "double.npy", VALUES.astype(np.float64))
    Image.fromarray(VALUES).save(tmp_path / "map.tiff")
    for name in ("map.pfm", "map.npy", "double.npy", "map.tiff"):
        assert same(read_map(tmp_path / name), EXPECTED)
    assert same(read_map(tmp_path / "map.npy", scale=2), EXPECTED / 2)
    assert same(read_map(tmp_path / "map.npy", unknown=120), np.where(EXPECTED == 120, np.nan, EXPECTED))


def test_integers_need_a_scale(tmp_path: Path) -> None:
    stored = np.array([[0, 256, 65280]], np.uint16)
    cv2.imwrite(str(tmp_path / "kitti.png"), stored)
    assert same(read_map(tmp_path / "kitti.png", scale=256), np.array([[np.nan, 1, 255]]))
    assert same(read_map(tmp_path / "kitti.png", scale=256, unknown=65280), np.array([[np.nan, 1, np.nan]]))
    np.save(tmp_path / "opencv.npy", np.array([[-16, 0, 40]], np.int16))
    assert same(read_map(tmp_path / "opencv.npy", scale=16, unknown=-16), np.array([[np.nan, 0, 2.5]]))
    cv2.imwrite(str(tmp_path / "map.tif"), stored)
    assert same(read_map(tmp_path / "map.tif", scale=256), np.array([[0, 1, 255]]))
    for name in ("kitti.png", "opencv.npy", "map.tif"):
        with pytest.raises(ValueError, match=f"scale must be given for .*{name}, which holds integers"):
            read_map(tmp_path / name, name="disparity1")


def test_what_is_no_map_is_said(tmp_path: Path) -> None:
    np.save(tmp_path / "deep.npy", np.zeros((2, 3, 4), np.float32))
    np.save(tmp_path / "bool.npy", np.zeros((2, 3), bool))
    (tmp_path / "cut.npy").write_bytes((tmp_path / "deep.npy").read_bytes()[:90])
    np.save(tmp_path / "object.npy", np.array([[{}]], dtype=object), allow_pickle=True)
    for name, message in (
        ("deep.npy", "must hold one channel"),
        ("bool.npy", "must hold numbers, got bool"),
        ("cut.npy", "no .npy file that can be read"),
        ("object.npy", "no .npy file that can be read"),
    ):
        with pytest.raises(ValueError, match=message):
            read_map(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="disparity: there is no file"):
        read_map(tmp_path / "none.pfm")
    with pytest.raises(ValueError, match=r"disparity must end in .pfm or"):
        read_map(tmp_path / "map.txt")
    with pytest.raises(ValueError, match="scale must be a positive number"):
        read_map(tmp_path / "deep.npy", scale=0)


def test_probabilities_are_written_in_every_format(tmp_path: Path) -> None:
    probability = np.random.default_rng(0).random((5, 7), dtype=np.float32)
    for ending in (".pfm", ".npy", ".tiff", ".png"):
        write_confidence(tmp_path / f"c{ending}", probability)
    assert np.array_equal(read_pfm(tmp_path / "c.pfm"), probability)
    assert np.array_equal(np.load(tmp_path / "c.npy"), probability)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "c.tiff")), probability)
    stored = np.asarray(Image.open(tmp_path / "c.png"))
    assert np.abs(stored / 65535 - probability).max() <= 0.5 / 65535 + 1e-7
    with pytest.raises(ValueError, match="out must end in"):
        write_confidence(tmp_path / "c.jpg", probability)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.npy", "c.pfm", "c.png", "c.tiff"]
