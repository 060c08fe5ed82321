"""Pairs and manifests by URLs of fsspec."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import fsspec
import numpy as np
import pytest

from tensor_stereo.configs import SweepConfig
from tensor_stereo.datasets import PairFiles, build_manifest, read_manifest, read_pair, write_manifest
from tensor_stereo.datasets.pair_table import PairTable
from tensor_stereo.datasets.remote import fetched
from tensor_stereo.sweeps import expand_grid, read_errors, run_sweep
from tests.sweeps.conftest import write_pairs


@pytest.fixture
def store() -> Iterator[str]:
    """The URL of a folder in memory with two pairs, one of them damaged, and a list of them."""
    files = fsspec.filesystem("memory")
    image = np.arange(48, dtype=np.uint8).reshape(6, 8)
    for name in ("left 1.png", "right.png", "truth.png"):
        files.pipe_file(f"/pairs/{name}", cv2.imencode(".png", image)[1].tobytes())
    files.pipe_file("/pairs/bad.png", b"\x89PNG no image")
    text = "image0,image1,disparity_gt,gt_scale,scene\nleft 1.png,memory://pairs/right.png,truth.png,4,good\n"
    files.pipe_file("/pairs/list.csv", text.encode())
    yield "memory://pairs"
    files.rm("/pairs", recursive=True)


def test_a_list_elsewhere_names_files_elsewhere(store: str) -> None:
    (files,) = read_manifest(f"{store}/list.csv")
    assert (files.image0, files.image1) == ("memory://pairs/left 1.png", "memory://pairs/right.png")
    pair = read_pair(files)
    assert pair.image0.shape == (1, 6, 8)
    assert pair.disparity_gt is not None
    assert float(pair.disparity_gt[5, 7]) == 47 / 4


def test_an_index_of_urls_is_a_manifest(store: str, tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_text(f"image0,image1\n{store}/left 1.png,{store}/right.png\n")
    manifest = build_manifest([tmp_path / "mine.csv"])
    assert manifest.select("image0", "width_px", "height_px").row(0) == (f"{store}/left 1.png", 8, 6)
    write_manifest(manifest, tmp_path / "m.parquet")
    folder = fsspec.filesystem("memory")
    for name in ("a", "b"):
        renamed = manifest.with_columns(scene=manifest["scene"] + name)
        write_manifest(renamed, tmp_path / f"{name}.parquet")
        folder.pipe_file(f"/pairs/manifest/{name}.parquet", (tmp_path / f"{name}.parquet").read_bytes())
    assert [pair.scene for pair in PairTable(f"{store}/manifest")] == ["left 1a", "left 1b"]
    assert read_pair(read_manifest(tmp_path / "m.parquet")[0]).image1.shape == (1, 6, 8)


def test_what_is_wrong_elsewhere_is_named_by_its_url(store: str) -> None:
    good = f"{store}/right.png"
    with pytest.raises(FileNotFoundError, match=f"there is no file {store}/none.png"):
        read_pair(PairFiles("d", "s", good, f"{store}/none.png"))
    with pytest.raises(ValueError, match=f"{store}/bad.png"):
        read_pair(PairFiles("d", "s", f"{store}/bad.png", good))
    with pytest.raises(OSError, match=r"nosuch://x/a\.png cannot be read"):
        read_pair(PairFiles("d", "s", "nosuch://x/a.png", good))
    with pytest.raises(FileNotFoundError, match=r"there is no file memory://pairs/none\.parquet"):
        PairTable(f"{store}/none.parquet")


def test_copies_last_as_long_as_they_are_needed(store: str) -> None:
    with fetched(PairFiles("d", "s", f"{store}/right.png", Path("b.png"))) as files:
        copy = Path(files.image0)
        assert copy.read_bytes().startswith(b"\x89PNG")
        assert files.image1 == Path("b.png")
    assert not copy.exists()
    table = PairTable(f"{store}/list.csv")
    assert len(list(table)) == 1


def test_a_file_url_is_a_path(tmp_path: Path) -> None:
    write_pairs(tmp_path / "p", 1)
    folder = (tmp_path / "p").as_uri()
    (tmp_path / "mine.csv").write_text(f"image0,image1\n{folder}/synthetic-00-0.png,{folder}/synthetic-00-1.png\n")
    (files,) = read_manifest(tmp_path / "mine.csv")
    assert files.image0 == tmp_path / "p" / "synthetic-00-0.png"


def test_a_sweep_says_which_urls_cannot_be_read(tmp_path: Path) -> None:
    """Memory of this process is no store that workers see."""
    (tmp_path / "m.csv").write_text("image0,image1\nmemory://nowhere/a.png,memory://nowhere/b.png\n")
    config = SweepConfig(expand_grid([{"detector": "fast", "verdict": "cardinality", "score": "none"}]))
    run_sweep(config, tmp_path / "m.csv", tmp_path / "run", num_workers=1)
    (error,) = read_errors(tmp_path / "run").rows(named=True)
    assert (error["stage"], error["error"]) == ("read", "FileNotFoundError")
    assert error["message"] == "there is no file memory://nowhere/a.png"
