from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import polars as pl
import pytest
import torch

import tensor_stereo as ts
from tensor_stereo.cli import main
from tensor_stereo.configs import RESTRICTIONS, VERDICTS
from tensor_stereo.datasets import read_image
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tests.cli.failing import fails
from tests.cli.printed import printed_values


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
from tensor_stereo.cli import _parse, main
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
    for flag in ("--min-group-size", "--preset", "--detectors", "--sift.max-ratio", "--matching.max-row-offset-px",
                 "--verdict", "--score", "--min-precision", "--consensus.slope"):  # fmt: skip
        assert flag in result.stdout


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_classify_writes_every_match(scene: Path, tmp_path: Path, ending: str, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / f"matches.{ending}"
    figure = tmp_path / "figure.png"
    main(["classify", str(scene / "im0.png"), str(scene / "im1.png"), "--out", str(out), "--constrained",
          "--disparity-gt", str(scene / "disp0.pfm"), "--figure", str(figure)])  # fmt: skip
    table = pl.read_csv(out) if ending == "csv" else pl.read_parquet(out)
    printed = printed_values(capsys)
    assert int(printed["num_matches"]) == table.height > 100
    assert int(printed["num_kept"]) == table["inlier"].sum()
    assert int(printed["num_untested"]) == (table["relation"] == "untested").sum() > 0
    assert sum(int(printed[f"num_{name}"]) for name in ("kept", "rejected", "untested")) == table.height
    for name in VERDICTS:
        assert int(printed[f"kept_by_{name}"]) == table[f"inlier_{name}"].sum() > 0
    assert table["inlier"].equals(table["inlier_score"])
    assert table["inlier_score"].equals((table["probability"] >= 0.5) & (table["relation"] != "untested"))
    assert {"sensitivity", "specificity"} <= printed.keys()
    assert {"group", "correct"} <= set(table.columns)
    assert "score" not in table.columns
    assert (table["disparity"] - (table["x0"] - table["x1"])).abs().max() < 1e-4  # float32 in, decimal text out
    assert cv2.imread(str(figure)).std() > 0


@pytest.mark.parametrize("constrained", [[], ["--constrained"]])
def test_the_verdicts_of_the_paper_are_those_of_classify_matches(
    scene: Path, tmp_path: Path, constrained: list[str]
) -> None:
    out, images = tmp_path / "matches.parquet", [str(scene / "im0.png"), str(scene / "im1.png")]
    for settings in (["--score", "consensus"], ["--verdict", "adjacency"], ["--verdict", "cardinality"]):
        main(["classify", *images, "--out", str(out), "--min-group-size", "5", *settings, *constrained])
        table = pl.read_parquet(out)
        points = [torch.from_numpy(table.select(f"x{view}", f"y{view}").to_numpy(writable=True)) for view in (0, 1)]
        cost = torch.from_numpy(table["cost"].to_numpy(writable=True))
        group = torch.from_numpy(table["group"].to_numpy(writable=True)) if constrained else None
        matches = ts.Matches(*points, torch.tensor([0, len(table)]), cost, group)
        for name in RESTRICTIONS:
            expected = ts.classify_matches(matches, restriction=name, min_group_size=5)
            assert table[f"inlier_{name}"].to_list() == expected.inlier.tolist()
            assert 0 < expected.inlier.sum() < len(table)
            assert table["relation"].to_list() == [
                ts.Relation(value).name.lower() for value in expected.relation.tolist()
            ]
            if settings == ["--verdict", name]:
                assert table["inlier"].equals(table[f"inlier_{name}"])
        assert table["inlier_adjacency"].sum() < table["inlier_cardinality"].sum()


@pytest.mark.parametrize("verdict", RESTRICTIONS)
def test_a_verdict_of_the_paper_pays_for_no_score_and_shows_one_that_is_asked_for(
    scene: Path, tmp_path: Path, verdict: str, capsys: pytest.CaptureFixture
) -> None:
    out, figure = tmp_path / "matches.parquet", tmp_path / "figure.png"
    command = ["classify", str(scene / "im0.png"), str(scene / "im1.png"), "--out", str(out), "--verdict", verdict]
    main([*command, "--figure", str(figure)])
    plain, printed = pl.read_parquet(out), printed_values(capsys)
    assert not {"score", "probability", "inlier_score"} & set(plain.columns)
    assert {"relation", "inlier_adjacency", "inlier_cardinality"} <= set(plain.columns)
    assert "kept_by_score" not in printed
    assert int(printed["num_kept"]) == int(printed[f"kept_by_{verdict}"]) == plain["inlier"].sum()
    assert figure.stat().st_size > 0
    main([*command, "--score", "consensus"])
    table, printed = pl.read_parquet(out), printed_values(capsys)
    assert table.select(plain.columns).equals(plain)
    assert set(table.columns) - set(plain.columns) == {"probability", "inlier_score", "domain"}
    assert table["domain"].unique().to_list() == [""]
    assert printed["domain"] == "inside"
    assert table["inlier_score"].equals((table["probability"] >= 0.5) & (table["relation"] != "untested"))
    assert int(printed["kept_by_score"]) == table["inlier_score"].sum() != int(printed["num_kept"])
    main([*command, "--score", "topology"])  # no probability, so it decides nothing
    table, printed = pl.read_parquet(out), printed_values(capsys)
    assert set(table.columns) - set(plain.columns) == {"score"}
    assert not {"kept_by_score", "domain"} & set(printed)


def test_the_figure_shows_the_verdict_that_decides_and_beside_a_score_that_of_the_paper(
    scene: Path, tmp_path: Path
) -> None:
    """Rows of panels, all of one height: the verdicts and, last, the graphs."""
    heights = []
    for k, settings in enumerate((["--verdict", "adjacency"], ["--score", "consensus"])):
        figure = tmp_path / f"{k}.png"
        main(["classify", str(scene / "im0.png"), str(scene / "im1.png"), "--figure", str(figure), *settings])
        heights.append(cv2.imread(str(figure)).shape[0])
    assert heights[1] / heights[0] == pytest.approx(3 / 2, rel=0.05)  # titles have one height


def test_nested_settings_reach_the_score(scene: Path, tmp_path: Path) -> None:
    out, images = tmp_path / "matches.parquet", [scene / "im0.png", scene / "im1.png"]
    command = ["classify", *map(str, images), "--out", str(out), "--score", "consensus"]
    main(command)
    plain = pl.read_parquet(out)
    main([*command, "--consensus.slope", "3", "--consensus.row-tolerance-px", "2", "--matching.max-ratio", "0.9"])
    table = pl.read_parquet(out)
    settings = ts.ConsensusConfig(slope=3.0, row_tolerance_px=2.0)
    config = ts.PipelineConfig(score="consensus", consensus=settings, matching=ts.MatchingConfig(max_ratio=0.9))
    expected = ts.run_pipeline([(read_image(images[0]), read_image(images[1]))], config)
    assert table["probability"].to_list() == expected.score.tolist()
    assert table["inlier"].to_list() == expected.classification.inlier.tolist()
    assert len(table) < len(plain)
    main([*command, "--consensus.slope", "3"])
    assert not pl.read_parquet(out)["probability"].equals(plain["probability"])


def test_semi_global_matching_has_flags(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out, images = tmp_path / "matches.parquet", [scene / "im0.png", scene / "im1.png"]
    command = ["classify", *map(str, images), "--out", str(out), "--matching.method", "sgbm"]
    main([*command, "--sgbm.window-px", "7", "--sgbm.num-disparities-px", "64", "--sgbm.mode", "hh"])
    table = pl.read_parquet(out)
    settings = ts.SGBMConfig(window_px=7, num_disparities_px=64, mode="hh")
    config = ts.PipelineConfig(matching=ts.MatchingConfig(method="sgbm"), sgbm=settings)
    expected = ts.run_pipeline([(read_image(images[0]), read_image(images[1]))], config)
    assert table["x1"].to_list() == expected.matches.keypoints1[:, 0].tolist()
    assert table["cost"].to_list() == expected.matches.cost.tolist()
    assert table["y0"].equals(table["y1"], check_names=False)
    main([*command, "--sgbm.no-left-right"])
    assert "cost" not in pl.read_parquet(out).columns
    capsys.readouterr()
    fails([*command, "--rectified", "auto"], capsys, "--rectified must be True where --matching.method is 'sgbm'")
    fails([*command, "--matching.max-ratio", "0.8"], capsys, "--matching.max-ratio must be None where")
    fails([*command, "--sgbm.num-disparities-px", "100"], capsys, "--sgbm.num-disparities-px must be a multiple of 16")
    fails([*command, "--sgbm.step-penalty-levels", "40"], capsys, "must be less than --sgbm.jump-penalty-levels")


def test_a_scaled_png_is_the_same_ground_truth(scene: Path, capsys: pytest.CaptureFixture) -> None:
    command = ["classify", str(scene / "im0.png"), str(scene / "im1.png"), "--verdict", "cardinality"]
    main([*command, "--disparity-gt", str(scene / "disp0.pfm")])
    exact = capsys.readouterr().out
    assert "sensitivity" in exact
    main([*command, "--disparity-gt", str(scene / "scaled.png"), "--gt-scale", "256"])
    assert capsys.readouterr().out == exact


def test_evaluate_writes_a_run_folder(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "run"
    command = ["evaluate", str(scene.parent.parent), "--detectors", "fast", "gftt", "--scenes", "RENDERED"]
    main([*command, "--out", str(out)])
    printed = capsys.readouterr().out
    for title in ("Table 2", "Table 4", "Table 5"):
        assert title in printed
    rows = json.loads((out / "summary.json").read_text())
    assert len(rows) == 2 * (1 + 2 * 2)
    assert {row["verdict"] for row in rows} == set(VERDICTS)
    assert {row["score"] for row in rows if row["verdict"] == "score"} == {"learned"}
    assert printed.count("learned, probability 0.5 (S)") == printed.count("S spec.") == 2
    settings = json.loads((out / "settings.json").read_text())
    assert settings["config"]["min_group_size"] == 1
    assert "Table 2" in (out / "tables.md").read_text()
    figures = sorted(path.name for path in (out / "figures").iterdir())
    assert figures == ["rendered-fast.png", "rendered-gftt.png"]
    main([*command, "--out", str(out)])  # the same settings may run again
    fails([*command, "--out", str(out), "--min-group-size", "4"], capsys, "settings.json", "out")


def test_preset_paper_sets_the_ratio(scene: Path, tmp_path: Path) -> None:
    main(["evaluate", str(scene), "--detectors", "sift", "--preset", "paper", "--sift.backend", "opencv",
          "--verdict", "cardinality", "--out", str(tmp_path / "run")])  # fmt: skip
    settings = json.loads((tmp_path / "run" / "settings.json").read_text())
    assert settings["config"]["sift"]["max_ratio"] == 0.6
    assert len(json.loads((tmp_path / "run" / "summary.json").read_text())) == 2 * 2


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
    (tmp_path / "file").touch()
    fails(["classify", left, right, "--out", str(tmp_path / "file" / "matches.csv")], capsys, "--out", "made")
    fails(["evaluate", str(tmp_path / "nothing")], capsys, "nothing")
    fails(["evaluate", str(tmp_path)], capsys, "looked for")
    fails(["evaluate", str(scene), "--scenes", "Atlantis"], capsys, "Atlantis", "rendered")
    fails(["classify", left, right, "--min-group-size", "0"], capsys, "--min-group-size")
    fails(["classify", left, right, "--threshold", "3"], capsys, "--threshold", "[0, 1]")


@pytest.mark.parametrize("command", ["classify", "evaluate", "filter"])
@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["--verdict", "cardinality", "--threshold", "0.3"], ["--threshold needs --verdict score", "cardinality"]),
        (["--verdict", "adjacency", "--min-precision", "0.9"], ["--min-precision needs --verdict score"]),
        (["--verdict", "score", "--score", "topology"], ["--threshold must be given", "no probability"]),
        (["--verdict", "score", "--score", "topology", "--min-precision", "0.9"], ["--min-precision needs a probab"]),
        (["--verdict", "score", "--score", "none"], ["--score must not be 'none'"]),
        (["--threshold", "0.3", "--min-precision", "0.9"], ["--min-precision must be None beside --threshold"]),
    ],
)
def test_settings_that_contradict_each_other_are_one_line_and_exit_code_2(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture, command: str, settings: list[str], words: list[str]
) -> None:
    files = {
        "classify": [str(scene / "im0.png"), str(scene / "im1.png"), "--figure", str(tmp_path / "figure.png")],
        "evaluate": [str(scene), "--detectors", "fast", "--out", str(tmp_path / "run")],
        "filter": [str(tmp_path / "a.csv"), "--out", str(tmp_path / "b.csv")],
    }
    (tmp_path / "a.csv").write_text("x0,y0,x1,y1\n0,0,-3,0\n")
    fails([command, *files[command], *settings], capsys, *words)
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["--fast.window-px", "10"], ["--fast.window-px", "odd", "got 10"]),
        (["--consensus.slope", "-1"], ["--consensus.slope", "got -1"]),
    ],
)
def test_a_nested_setting_out_of_its_limits_is_one_line_and_exit_code_2(
    scene: Path, capsys: pytest.CaptureFixture, settings: list[str], words: list[str]
) -> None:
    fails(["classify", str(scene / "im0.png"), str(scene / "im1.png"), *settings], capsys, *words)


def test_the_default_verdict_needs_no_name(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    fails(
        ["classify", str(scene / "im0.png"), str(scene / "im1.png"), "--score", "topology"], capsys, "--threshold must"
    )
    fails(["evaluate", str(scene), "--score", "none"], capsys, "--score must not be 'none'")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("score", ["consensus", "learned", "topology"])
def test_the_score_can_decide(scene: Path, tmp_path: Path, score: str) -> None:
    out, images = tmp_path / "matches.parquet", [str(scene / "im0.png"), str(scene / "im1.png")]
    main(["classify", *images, "--out", str(out), "--score", score, "--threshold", "0.4"])
    table = pl.read_parquet(out)
    tested = table["relation"] != "untested"
    column = "score" if score == "topology" else "probability"
    assert table["inlier"].equals((table[column] >= 0.4) & tested)
    assert table["inlier_score"].equals(table["inlier"])
    assert 0 < table["inlier"].sum() < len(table)
    if score != "topology":
        for target in ("--min-precision", "--target-sensitivity"):
            main(["classify", *images, "--out", str(out), "--score", score, target, "0.95"])
            aimed = pl.read_parquet(out)
            least = aimed.filter(pl.col("inlier"))["probability"].min()
            assert aimed["inlier"].equals((aimed["probability"] >= least) & tested)
            assert aimed["probability"].equals(table["probability"])
            assert not aimed["inlier"].equals(table["inlier"])


def test_tables_name_the_score_that_decided(scene: Path, capsys: pytest.CaptureFixture) -> None:
    command = ["evaluate", str(scene), "--detectors", "fast", "--score", "learned", "--target-sensitivity", "0.9"]
    main(command)
    printed = capsys.readouterr().out
    groups = "unconstrained (U), constrained by objects (C), learned, target sensitivity 0.9 (S)"
    assert f"Table 2. FAST, cardinality: {groups}" in printed
    assert "How the score ranks matches (learned)" in printed
    for verdict in RESTRICTIONS:
        main([*command[:-4], "--verdict", verdict])
        printed = capsys.readouterr().out
        assert f"Table 2. FAST, {verdict}: unconstrained (U), constrained by objects (C)**" in printed
        assert "How the score" not in printed
        assert "(S)" not in printed


def test_constant_images_give_an_empty_table(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    flat, out = tmp_path / "flat.png", tmp_path / "matches.csv"
    cv2.imwrite(str(flat), np.full((40, 50), 128, np.uint8))
    main(["classify", str(flat), str(flat), "--out", str(out), "--figure", str(tmp_path / "flat-figure.png")])
    assert "num_matches" in capsys.readouterr().out
    table = pl.read_csv(out)
    assert table.height == 0
    assert {"inlier", "probability", "relation", *(f"inlier_{name}" for name in VERDICTS)} <= set(table.columns)


def test_demo_prints_the_five_tables(capsys: pytest.CaptureFixture) -> None:
    main(["demo", "--num-pairs", "1"])
    printed = capsys.readouterr().out
    assert all(f"Table {k}" in printed for k in range(1, 6))
    assert printed.count("learned, probability 0.5 (S)") == 4


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


@pytest.mark.filterwarnings("ignore:the score expects matches that agree")
def test_classify_marks_a_pair_of_two_scenes(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    views = [render_pair(0).image0, render_pair(1).image1]
    for k, view in enumerate(views):
        cv2.imwrite(str(tmp_path / f"{k}.png"), view[0].numpy())
    main(["classify", str(tmp_path / "0.png"), str(tmp_path / "1.png"), "--out", str(tmp_path / "matches.csv")])
    assert printed_values(capsys)["domain"] == "agreement"
    assert pl.read_csv(tmp_path / "matches.csv")["domain"].unique().to_list() == ["agreement"]


def test_every_command_takes_the_tolerance(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    files, out = [str(scene / "im0.png"), str(scene / "im1.png")], tmp_path / "matches.parquet"
    kept = []
    for px in ("0.5", "1", "5"):
        main(["classify", *files, "--max-error-px", px, "--out", str(out)])
        kept.append(int(printed_values(capsys)["num_kept"]))
        main(["filter", str(out), "--out", str(tmp_path / "kept.parquet"), "--max-error-px", px])
        assert int(printed_values(capsys)["num_kept"]) > 0
    assert kept == sorted(kept)
    command = ["evaluate", str(scene.parent.parent), "--detectors", "fast", "--scenes", "RENDERED"]
    main([*command, "--max-error-px", "3"])
    assert "learned, probability 0.5 within 3 px (S)" in capsys.readouterr().out
    fails(["classify", *files, "--max-error-px", "9"], capsys, "--max-error-px", "[0.5, 5]")
