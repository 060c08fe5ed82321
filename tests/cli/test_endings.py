"""Ends that must not look like success, and ends that are one."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import polars as pl
import pytest

from tensor_stereo.cli import main
from tensor_stereo.cli.progress import show_progress
from tensor_stereo.datasets.synthetic import render_pair

PLAIN = ["--detectors", "fast", "--verdict", "cardinality", "--score", "none"]


def ends(arguments: list[str]) -> int:
    """The exit code of a command."""
    try:
        main(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def write_scene(folder: Path, seed: int, *, truth: bool = True) -> Path:
    """A rendered pair in the layout of Middlebury 2003."""
    folder.mkdir(parents=True)
    pair = render_pair(seed)
    assert pair.disparity_gt is not None
    for name, image in (("im2", pair.image0), ("im6", pair.image1)):
        cv2.imwrite(str(folder / f"{name}.png"), image[0].numpy())
    if truth:
        stored = np.nan_to_num(4 * pair.disparity_gt.numpy()).clip(0, 255).round().astype(np.uint8)
        cv2.imwrite(str(folder / "disp2.png"), stored)
    return folder


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data") / "middlebury" / "2003"
    write_scene(root / "cones", 0)
    write_scene(root / "teddy", 1)
    write_scene(root / "dark", 2, truth=False)
    return root


def test_pairs_without_ground_truth_are_left_out_with_one_line(
    release: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["evaluate", str(release), *PLAIN, "--gt-scale", "4", "--out", str(tmp_path / "new" / "out")]
    assert ends(arguments) == 0
    printed = capsys.readouterr()
    assert printed.err == "1 of 3 pairs have no ground truth and are left out\n"
    scenes = {row["scene"] for row in json.loads((tmp_path / "new" / "out" / "summary.json").read_text())}
    assert scenes == {"cones", "teddy"}
    assert ends(arguments) == 0  # the same folder again


def test_an_evaluation_without_any_ground_truth_fails(
    release: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(release / "dark", tmp_path / "2003" / "dark")
    assert ends(["evaluate", str(tmp_path), *PLAIN]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_damaged_pairs_are_told_at_the_end_and_the_others_kept(
    release: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "middlebury" / "2003"
    shutil.copytree(release, root)
    (root / "cones" / "im6.png").write_bytes(b"torn")
    assert ends(["evaluate", str(root), *PLAIN, "--gt-scale", "4", "--out", str(tmp_path / "out")]) == 1
    printed = capsys.readouterr()
    assert "1 of 2 pairs failed" in printed.err
    assert "im6.png" in printed.err
    assert "Table 2. FAST" in printed.out
    assert {row["scene"] for row in json.loads((tmp_path / "out" / "summary.json").read_text())} == {"teddy"}
    assert list(json.loads((tmp_path / "out" / "errors.json").read_text())) == ["cones"]
    shutil.copy(release / "cones" / "im6.png", root / "cones")
    assert ends(["evaluate", str(root), *PLAIN, "--gt-scale", "4", "--out", str(tmp_path / "out")]) == 0
    assert not (tmp_path / "out" / "errors.json").exists()  # those of an earlier run are none of this one
    for name in ("cones/im6.png", "teddy/im2.png"):
        (root / name).write_bytes(b"torn")
    capsys.readouterr()
    assert ends(["evaluate", str(root), *PLAIN, "--gt-scale", "4"]) == 1
    assert "2 of 2 pairs failed" in capsys.readouterr().err


def test_classify_takes_the_scale_from_the_folders_of_a_release(
    release: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = release / "teddy"
    files = [str(scene / name) for name in ("im2.png", "im6.png")]
    found = []
    for scale in ([], ["--gt-scale", "4"]):
        truth = ["--disparity-gt", str(scene / "disp2.png"), *scale, "--verdict", "cardinality"]
        if ends(["classify", *files, *truth]) == 2:  # a rendered image has not the width of the release
            assert "--gt-scale" in capsys.readouterr().err
            continue
        found.append(capsys.readouterr().out)
    rates = dict(line.split() for line in found[-1].splitlines())
    assert rates["precision"] == rates["npv"]
    assert rates["recall"] == rates["specificity"]
    assert len(set(found)) == 1


def test_classify_takes_the_scale_of_a_real_scene_as_index_does(
    data_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = data_root / "middlebury" / "2005" / "Art"
    arguments = ["classify", str(scene / "view1.png"), str(scene / "view5.png"), "--verdict", "cardinality"]
    truth = ["--disparity-gt", str(scene / "disp1.png")]
    assert ends([*arguments, *truth]) == 0
    alone = capsys.readouterr().out
    assert ends([*arguments, *truth, "--gt-scale", "3"]) == 0
    assert capsys.readouterr().out == alone
    assert ends([*arguments, *truth, "--gt-scale", "4"]) == 0
    assert capsys.readouterr().out != alone


def test_an_evaluation_without_any_known_truth_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_scene(tmp_path / "middlebury" / "2003" / "cones", 0)
    blank = np.zeros(cv2.imread(str(scene / "im2.png")).shape[:2], np.uint8)
    cv2.imwrite(str(scene / "disp2.png"), blank)
    assert ends(["evaluate", str(scene.parent), *PLAIN, "--gt-scale", "4", "--out", str(tmp_path / "out")]) == 1
    assert "no match of the 1 pairs has known ground truth" in capsys.readouterr().err


def test_rates_without_any_known_truth_fail(release: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.zeros(cv2.imread(str(release / "teddy" / "im2.png")).shape[:2], np.uint8))
    files = [str(release / "teddy" / name) for name in ("im2.png", "im6.png")]
    arguments = ["classify", *files, "--disparity-gt", str(blank), "--gt-scale", "4", "--verdict", "cardinality"]
    assert ends(arguments) == 1
    assert "no match has known ground truth" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore:the score expects")
def test_an_empty_result_of_matches_that_agree_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = np.random.default_rng(0).random((200, 2)) * [320, 240]
    turned = points @ np.array([[0.8, -0.6], [0.6, 0.8]])
    table = pl.DataFrame(np.hstack([points, turned]), schema=["x0", "y0", "x1", "y1"])
    table.write_csv(tmp_path / "m.csv")
    out = tmp_path / "made" / "kept.csv"
    assert ends(["filter", str(tmp_path / "m.csv"), "--out", str(out), "--rectified", "True"]) == 1
    error = capsys.readouterr().err
    assert "no match is kept, although 200 of 200 agree with their neighbours" in error
    assert "--rectified" in error
    assert "--verdict cardinality" in error
    assert out.is_file()  # what was found is there
    assert ends(["filter", str(tmp_path / "m.csv"), "--out", str(out), "--verdict", "cardinality"]) == 0
    assert ends(["filter", str(tmp_path / "m.csv"), "--out", str(out)]) == 0  # auto sees that the pair is none
    noise = np.random.default_rng(1).random((200, 4)) * 200
    pl.DataFrame(noise, schema=["x0", "y0", "x1", "y1"]).write_csv(tmp_path / "noise.csv")
    assert ends(["filter", str(tmp_path / "noise.csv"), "--out", str(out), "--score", "consensus"]) == 0


def sweep(folder: Path, release: Path, scenes: list[str], *, grid: str = "", top: str = "") -> tuple[int, Path]:
    """Exit code and run folder of a small sweep over some scenes."""
    folder.mkdir(exist_ok=True)
    lines = [f"{release / s / 'im2.png'},{release / s / 'im6.png'},{s}" for s in scenes]
    (folder / "list.csv").write_text("image0,image1,scene\n" + "\n".join(lines) + "\n")
    assert ends(["index", str(folder / "list.csv"), "--out", str(folder / "m.parquet")]) == 0
    (folder / "s.toml").write_text(f'{top}\n[grid]\nverdict = "cardinality"\n{grid}\n')
    run = folder / "run"
    arguments = ["sweep", str(folder / "s.toml"), "--manifest", str(folder / "m.parquet"), "--out", str(run)]
    return ends([*arguments, "--workers", "1"]), run


@pytest.mark.slow
def test_a_sweep_for_rates_without_ground_truth_fails_and_one_for_matches_does_not(
    release: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _ = sweep(tmp_path / "rates", release, ["dark"])
    assert code == 1
    assert "no pair has known ground truth" in capsys.readouterr().err
    code, run = sweep(tmp_path / "matches", release, ["dark"], top="export_matches = true")
    assert code == 0
    assert list((run / "matches").glob("part-*.parquet"))


@pytest.mark.slow
def test_two_reports_without_a_common_pair_fail_and_have_a_folder_of_their_own(
    release: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = []
    for scene in ("cones", "teddy"):
        _, run = sweep(tmp_path / scene, release, [scene], top="export_matches = true")
        runs.append(run.rename(tmp_path / f"run-{scene}"))
    capsys.readouterr()
    assert ends(["report", *map(str, runs)]) == 1
    printed = capsys.readouterr()
    assert "no pair in common" in printed.err
    assert (tmp_path / "run-cones-and-run-teddy" / "report.html").is_file()
    assert not (runs[1] / "report.html").exists()


def test_progress_is_a_line_now_and_then_with_the_time_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tensor_stereo.cli.progress.PLAIN_SECONDS", 0.0)
    with show_progress("evaluate") as show:
        show(1, 4, "Art fast, 0:00:03 left")
    assert capsys.readouterr().err == "evaluate 1/4, Art fast, 0:00:03 left\n"
