from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import polars as pl
import pytest

from tensor_stereo.cli import main
from tensor_stereo.datasets.synthetic import render_pair
from tests.cli.failing import fails


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic pair in the layout of Middlebury 2014, with its ground truth as PNG as well."""
    from tensor_stereo.datasets import write_pfm

    pair = render_pair(0)
    folder = tmp_path_factory.mktemp("data") / "middlebury-2014" / "rendered"
    folder.mkdir(parents=True)
    for name, image in (("im0.png", pair.image0), ("im1.png", pair.image1)):
        cv2.imwrite(str(folder / name), image.permute(1, 2, 0).numpy()[..., ::-1])
    assert pair.disparity_gt is not None
    disparity = pair.disparity_gt.numpy()
    write_pfm(folder / "disp0.pfm", disparity)
    cv2.imwrite(str(folder / "scaled.png"), np.round(disparity * 256).astype(np.uint16))
    return folder


def test_help_needs_no_torch() -> None:
    code = """
import sys
from tensor_stereo.cli import main
try:
    main(["--help"])
except SystemExit:
    assert not {"torch", "numpy"} & sys.modules.keys()
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    for command in ("demo", "classify", "evaluate"):
        assert command in result.stdout


def test_module_is_the_command() -> None:
    result = subprocess.run(
        [sys.executable, "-m", "tensor_stereo", "evaluate", "--help"], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0
    for flag in ("--min-group-size", "--preset", "--detectors", "--sift.max-ratio", "--matching.max-row-offset-px"):
        assert flag in result.stdout


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_classify_writes_every_match(scene: Path, tmp_path: Path, ending: str, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / f"matches.{ending}"
    main(["classify", str(scene / "im0.png"), str(scene / "im1.png"), "--out", str(out), "--constrained",
          "--disparity-gt", str(scene / "disp0.pfm")])  # fmt: skip
    table = pl.read_csv(out) if ending == "csv" else pl.read_parquet(out)
    printed = dict(line.split() for line in capsys.readouterr().out.splitlines())
    assert int(printed["num_matches"]) == table.height > 100
    assert int(printed["num_kept"]) == table["inlier"].sum()
    assert {"sensitivity", "specificity"} <= printed.keys()
    assert {"group", "correct"} <= set(table.columns)
    assert (table["disparity"] - (table["x0"] - table["x1"])).abs().max() < 1e-4  # float32 in, decimal text out


def test_a_scaled_png_is_the_same_ground_truth(scene: Path, capsys: pytest.CaptureFixture) -> None:
    images = [str(scene / "im0.png"), str(scene / "im1.png")]
    main(["classify", *images, "--disparity-gt", str(scene / "disp0.pfm")])
    exact = capsys.readouterr().out
    main(["classify", *images, "--disparity-gt", str(scene / "scaled.png"), "--gt-scale", "256"])
    assert capsys.readouterr().out == exact


def test_evaluate_writes_a_run_folder(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "run"
    command = ["evaluate", str(scene.parent.parent), "--detectors", "fast", "gftt", "--scenes", "RENDERED"]
    main([*command, "--out", str(out)])
    printed = capsys.readouterr().out
    for title in ("Table 2", "Table 4", "Table 5"):
        assert title in printed
    rows = json.loads((out / "summary.json").read_text())
    assert len(rows) == 2 * 2 * 2
    assert {row["restriction"] for row in rows} == {"adjacency", "cardinality"}
    settings = json.loads((out / "settings.json").read_text())
    assert settings["config"]["min_group_size"] == 1
    assert "Table 2" in (out / "tables.md").read_text()
    figures = sorted(path.name for path in (out / "figures").iterdir())
    assert figures == ["rendered-fast.png", "rendered-gftt.png"]
    main([*command, "--out", str(out)])  # the same settings may run again
    fails([*command, "--out", str(out), "--min-group-size", "4"], capsys, "settings.json", "out")


def test_preset_paper_sets_the_ratio(scene: Path, tmp_path: Path) -> None:
    main(["evaluate", str(scene), "--detectors", "sift", "--preset", "paper", "--sift.backend", "opencv",
          "--out", str(tmp_path / "run")])  # fmt: skip
    settings = json.loads((tmp_path / "run" / "settings.json").read_text())
    assert settings["config"]["sift"]["max_ratio"] == 0.6


def test_bad_input_is_one_line_and_exit_code_2(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    left, right = str(scene / "im0.png"), str(scene / "im1.png")
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), np.zeros((20, 30), np.uint8))
    empty = tmp_path / "empty.png"
    empty.touch()
    fails(["classify", left, str(tmp_path / "none.png")], capsys, "none.png")
    fails(["classify", left, str(empty)], capsys, "empty.png")
    fails(["classify", left, str(small)], capsys, "small.png")
    fails(["classify", left, right, "--disparity-gt", str(small), "--gt-scale", "4"], capsys, "small.png")
    fails(["classify", left, right, "--disparity-gt", str(scene / "scaled.png")], capsys, "--gt-scale")
    fails(["classify", left, right, "--out", str(tmp_path / "matches.xlsx")], capsys, "out", ".csv")
    fails(["classify", left, right, "--out", str(tmp_path / "no" / "matches.csv")], capsys, "out")
    fails(["evaluate", str(tmp_path / "nothing")], capsys, "nothing")
    fails(["evaluate", str(tmp_path)], capsys, "looked for")
    fails(["evaluate", str(scene), "--scenes", "Atlantis"], capsys, "Atlantis", "rendered")
    fails(["classify", left, right, "--min-group-size", "0"], capsys, "min_group_size")
    fails(["classify", left, right, "--threshold", "3"], capsys, "threshold", "[0, 1]")
    fails(["evaluate", str(scene), "--score", "topology", "--min-precision", "0.9"], capsys, "calibrated")


@pytest.mark.parametrize("score", ["consensus", "learned", "topology"])
def test_the_score_can_decide(scene: Path, tmp_path: Path, score: str) -> None:
    out, images = tmp_path / "matches.parquet", [str(scene / "im0.png"), str(scene / "im1.png")]
    main(["classify", *images, "--out", str(out), "--score", score, "--threshold", "0.4"])
    table = pl.read_parquet(out)
    tested = table["relation"] != "UNTESTED"
    assert table["inlier"].equals((table["score"] >= 0.4) & tested)
    assert 0 < table["inlier"].sum() < len(table)
    if score != "topology":
        main(["classify", *images, "--out", str(out), "--score", score, "--min-precision", "0.9"])
        aimed = pl.read_parquet(out)
        least = aimed.filter(pl.col("inlier"))["score"].min()
        assert aimed["inlier"].equals((aimed["score"] >= least) & tested)
        assert not aimed["inlier"].equals(table["inlier"])
    main(["classify", *images, "--out", str(out), "--score", "none"])
    assert "score" not in pl.read_parquet(out).columns


def test_tables_name_the_score_that_decided(scene: Path, capsys: pytest.CaptureFixture) -> None:
    command = ["evaluate", str(scene), "--detectors", "fast", "--score", "learned", "--target-sensitivity", "0.9"]
    main(command)
    printed = capsys.readouterr().out
    assert "Table 2. FAST, learned, target sensitivity 0.9:" in printed
    assert "How the score ranks matches (learned)" in printed
    main([*command[:-4], "--score", "none"])
    assert "How the score" not in capsys.readouterr().out


def test_constant_images_give_an_empty_table(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    flat, out = tmp_path / "flat.png", tmp_path / "matches.csv"
    cv2.imwrite(str(flat), np.full((40, 50), 128, np.uint8))
    main(["classify", str(flat), str(flat), "--out", str(out), "--figure", str(tmp_path / "flat-figure.png")])
    assert "num_matches" in capsys.readouterr().out
    table = pl.read_csv(out)
    assert table.height == 0
    assert "inlier" in table.columns


def test_demo_prints_the_five_tables(capsys: pytest.CaptureFixture) -> None:
    main(["demo", "--num-pairs", "1"])
    printed = capsys.readouterr().out
    assert all(f"Table {k}" in printed for k in range(1, 6))


def test_index_writes_a_manifest_of_folders_and_lists(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from tensor_stereo.datasets import read_manifest

    (tmp_path / "mine.csv").write_text(f"image0,image1\n{scene / 'im1.png'},{scene / 'im0.png'}\n")
    out = tmp_path / "m.parquet"
    main(["index", str(scene.parent), str(tmp_path / "mine.csv"), "--out", str(out)])
    assert "2 pairs in" in capsys.readouterr().out
    assert {(pair.dataset, pair.scene) for pair in read_manifest(out)} == {
        ("middlebury-2014", "rendered"),
        ("mine", "im1"),
    }
    with pytest.raises(SystemExit) as stop:
        main(["index", str(tmp_path / "none"), "--out", str(out)])
    assert stop.value.code == 2
