"""Views that store fewer bits than 16 without saying so, on the command line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import polars as pl
import pytest

from tensor_stereo.cli import main
from tensor_stereo.datasets import read_manifest
from tensor_stereo.datasets.synthetic import render_pair
from tests.cli.failing import fails


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered pair of 12 bits in PNGs of 16, with its ground truth, beside its 8-bit original."""
    pair = render_pair(0)
    folder = tmp_path_factory.mktemp("data")
    for bits in (8, 12):
        (folder / str(bits) / "my scene").mkdir(parents=True)
        for name, image in (("view1", pair.image0), ("view5", pair.image1)):
            pixels = image.permute(1, 2, 0).numpy()[..., ::-1]
            if bits == 12:
                pixels = ((pixels.astype(np.uint32) * 4095 + 127) // 255).astype(np.uint16)
            cv2.imwrite(str(folder / str(bits) / "my scene" / f"{name}.png"), pixels)
        gt = np.nan_to_num(pair.disparity_gt.numpy())
        cv2.imwrite(str(folder / str(bits) / "my scene" / "disp1.png"), gt.round().astype(np.uint8))
    return folder


def _classify(folder: Path, out: Path, *flags: str) -> pl.DataFrame:
    views = [str(folder / "my scene" / name) for name in ("view1.png", "view5.png")]
    main(["classify", *views, "--out", str(out), *flags])
    return pl.read_csv(out)


def test_classify_finds_with_the_bits_what_it_finds_in_8_bits(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    expected = _classify(scene / "8", tmp_path / "8.csv")
    assert len(expected) > 100
    assert _classify(scene / "12", tmp_path / "12.csv", "--sample-bits", "12").equals(expected)
    assert capsys.readouterr().err == ""


def test_classify_says_in_one_line_that_views_are_dark(scene: Path) -> None:
    views = [str(scene / "12" / "my scene" / name) for name in ("view1.png", "view5.png")]
    command = [sys.executable, "-m", "tensor_stereo", "classify", *views]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    [line] = done.stderr.splitlines()
    assert line.startswith(f"tensor-stereo: warning: {views[0]} holds samples of 16 bits, none above ")
    assert line.endswith("give sample_bits (--sample-bits)")


def test_the_bits_reach_evaluate(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = []
    for bits, flags in ((8, []), (12, ["--sample-bits", "12"])):
        main(["evaluate", str(scene / str(bits)), "--gt-scale", "1", "--detectors", "fast", *flags])
        out, error = capsys.readouterr()
        assert error == ""
        printed.append(out.partition("\n\n")[2].partition("\n\n")[0])  # the first table; another holds times
    assert "my scene" in printed[0]
    assert printed[0] == printed[1]


def test_the_bits_reach_the_manifest(scene: Path, tmp_path: Path) -> None:
    main(["index", str(scene / "12"), "--gt-scale", "1", "--sample-bits", "12", "--out", str(tmp_path / "m.parquet")])
    [pair] = read_manifest(tmp_path / "m.parquet")
    assert pair.sample_bits == 12


@pytest.mark.parametrize("command", ["classify {0}/view1.png {0}/view5.png", "evaluate {0}", "index {0} --out {1}"])
def test_wrong_bits_are_an_error_by_the_name_of_the_flag(
    scene: Path, tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [word.format(scene / "12" / "my scene", tmp_path / "m.parquet") for word in command.split()]
    fails([*arguments, "--sample-bits", "20"], capsys, "--sample-bits must lie in [8, 16], got 20")
