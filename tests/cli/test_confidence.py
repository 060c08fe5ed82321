from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tensor_stereo.cli import main
from tensor_stereo.configs import SyntheticConfig
from tensor_stereo.datasets import write_pfm
from tensor_stereo.datasets.images import write_image
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tensor_stereo.dense import match_semi_global, score_disparity
from tests.cli.failing import fails
from tests.cli.printed import printed_values


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered pair, its semi-global maps in several formats, and its ground truth."""
    path = tmp_path_factory.mktemp("pair")
    pair = render_pair(3, SyntheticConfig(width_px=240, height_px=180))
    write_image(path / "left.png", pair.image0)
    write_image(path / "right.png", pair.image1)
    assert pair.disparity_gt is not None
    write_pfm(path / "truth.pfm", pair.disparity_gt.numpy())
    maps = match_semi_global(pair.image0, pair.image1)
    assert maps.disparity1 is not None
    for name, values in (("map", maps.disparity0[0]), ("map1", maps.disparity1[0])):
        write_pfm(path / f"{name}.pfm", values.nan_to_num(torch.inf).numpy())
        np.save(path / f"{name}.npy", (values * 16).nan_to_num(-16).round().to(torch.int16).numpy())
    return path


def test_it_writes_what_the_library_says(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    views = [str(folder / name) for name in ("left.png", "right.png", "map.pfm")]
    out, figure = tmp_path / "new" / "c.npy", tmp_path / "c.png"
    main(["confidence", *views, "--disparity1", str(folder / "map1.pfm"), "--out", str(out), "--figure", str(figure),
          "--disparity-gt", str(folder / "truth.pfm"), "--min-precision", "0.97"])  # fmt: skip
    printed = printed_values(capsys)
    pair = render_pair(3, SyntheticConfig(width_px=240, height_px=180))
    maps = match_semi_global(pair.image0, pair.image1)
    assert maps.disparity1 is not None
    found = score_disparity(maps.disparity0[0], pair.image0, pair.image1, maps.disparity1[0])
    assert np.array_equal(np.load(out), found.probability[0, 0].numpy())
    kept = found.keep(min_precision=0.97)[0, 0]
    assert pair.disparity_gt is not None
    error = (maps.disparity0[0] - pair.disparity_gt).abs()
    assert int(printed["num_kept"]) == int(kept.sum())
    assert float(printed["bad"]) == pytest.approx(float((error > 1).double().mean()), abs=1e-4)
    assert float(printed["bad_kept"]) == pytest.approx(float((error[kept] > 1).double().mean()), abs=1e-4)
    assert float(printed["bad_kept"]) < 0.5 * float(printed["bad"])
    assert cv2.imread(str(figure)).shape[0] > 500


def test_integers_of_opencv_give_the_same(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    views = [str(folder / name) for name in ("left.png", "right.png")]
    main(["confidence", *views, str(folder / "map.pfm"), "--out", str(tmp_path / "a.pfm"), "--stride", "3"])
    main(["confidence", *views, str(folder / "map.npy"), "--scale", "16", "--unknown", "-16", "--stride", "3",
          "--out", str(tmp_path / "b.pfm")])  # fmt: skip
    assert (tmp_path / "a.pfm").read_bytes() == (tmp_path / "b.pfm").read_bytes()
    assert "num_kept" in capsys.readouterr().out


def test_bad_input_is_one_line(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    views = [str(folder / name) for name in ("left.png", "right.png")]
    fails(["confidence", *views, str(folder / "none.pfm")], capsys, "DISPARITY", "none.pfm")
    fails(["confidence", *views, str(folder / "map.npy")], capsys, "--scale")
    fails(["confidence", *views, str(folder / "map.pfm"), "--out", str(tmp_path / "c.jpg")], capsys, "--out", ".pfm")
    fails(["confidence", *views, str(folder / "map.pfm"), "--out", str(folder / "map.pfm")], capsys, "--out")
    fails(["confidence", *views, str(folder / "map.pfm"), "--stride", "0"], capsys, "--stride")
    fails(["confidence", *views, str(folder / "map.pfm"), "--max-error-px", "40"], capsys, "--max-error-px")
    fails(["confidence", *views, str(folder / "map.pfm"), "--threshold", "0.5", "--min-precision", "0.9"], capsys,
          "--threshold", "--min-precision")  # fmt: skip
    small = tmp_path / "small.pfm"
    write_pfm(small, np.ones((5, 6), np.float32))
    fails(["confidence", *views, str(small)], capsys, "size")
    fails(["confidence", *views, str(folder / "map.pfm"), "--disparity-gt", str(small)], capsys, "--disparity-gt")


def test_a_map_that_knows_nothing_is_told(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_pfm(tmp_path / "nothing.pfm", np.full((180, 240), np.inf, np.float32))
    with pytest.raises(SystemExit) as stop:
        main(["confidence", str(folder / "left.png"), str(folder / "right.png"), str(tmp_path / "nothing.pfm")])
    assert stop.value.code == 1
    assert "knows no disparity" in capsys.readouterr().err
