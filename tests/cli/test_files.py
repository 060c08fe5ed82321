"""The commands that turn files into other files: render, filter, download, report."""

from __future__ import annotations

from pathlib import Path

import polars as pl
import pytest

from tensor_stereo.cli import main
from tensor_stereo.datasets import render_pair
from tensor_stereo.datasets.images import write_image
from tests.cli.failing import fails
from tests.cli.printed import printed_values


def test_rendered_pairs_are_indexed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["render", str(tmp_path / "pairs"), "--num-pairs", "2", "--seed", "3"])
    listed = capsys.readouterr().out.strip()
    main(["index", listed, "--out", str(tmp_path / "m.parquet")])
    assert "2 pairs in" in capsys.readouterr().out


def test_what_classify_wrote_is_filtered_alike(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["render", str(tmp_path), "--num-pairs", "1"])
    images = [str(tmp_path / f"synthetic-00-{view}.png") for view in (0, 1)]
    main(["classify", *images, "--out", str(tmp_path / "matches.csv"), "--verdict", "cardinality"])
    capsys.readouterr()
    main(["filter", str(tmp_path / "matches.csv"), "--out", str(tmp_path / "filtered.csv"), "--verdict", "cardinality"])
    printed = dict(line.split() for line in capsys.readouterr().out.splitlines())
    before, after = pl.read_csv(tmp_path / "matches.csv"), pl.read_csv(tmp_path / "filtered.csv")
    assert before["inlier"].equals(after["inlier"])
    assert int(printed["num_kept"]) == before["inlier"].sum()
    strict = tmp_path / "strict.csv"
    main(["filter", str(tmp_path / "matches.csv"), "--out", str(strict), "--verdict", "adjacency"])
    assert 0 < pl.read_csv(strict)["inlier"].sum() < before["inlier"].sum()
    assert pl.read_csv(strict)["inlier"].equals(before["inlier_adjacency"])


def test_a_score_without_images_says_the_same_of_files_as_of_their_matches(tmp_path: Path) -> None:
    main(["render", str(tmp_path), "--num-pairs", "1"])
    images = [str(tmp_path / f"synthetic-00-{view}.png") for view in (0, 1)]
    matches, filtered = tmp_path / "matches.parquet", tmp_path / "filtered.parquet"
    settings = ["--score", "consensus", "--consensus.slope", "0.4", "--min-precision", "0.9"]
    main(["classify", *images, "--out", str(matches), *settings])
    main(["filter", str(matches), "--out", str(filtered), *settings])
    before, after = pl.read_parquet(matches), pl.read_parquet(filtered)
    assert before["inlier"].equals(after["inlier"])
    assert (before["probability"] - after["score"]).abs().max() < 1e-5  # float32 there, float64 here


@pytest.mark.slow
def test_a_run_gets_its_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["render", str(tmp_path / "pairs"), "--num-pairs", "2"])
    main(["index", str(tmp_path / "pairs" / "synthetic.csv"), "--out", str(tmp_path / "m.parquet")])
    runs = []
    for window in (9, 11):
        settings = tmp_path / f"{window}.toml"
        settings.write_text(f'[grid]\ndetector = "fast"\nverdict = "cardinality"\nfast.window_px = {window}\n')
        runs.append(str(tmp_path / f"run{window}"))
        main(["sweep", str(settings), "--manifest", str(tmp_path / "m.parquet"), "--out", runs[-1], "--workers", "1"])
    capsys.readouterr()
    main(["report", runs[0]])
    assert (tmp_path / "run9" / "report.html").stat().st_size > 10_000
    assert "data:image/png" in (tmp_path / "run9" / "report.html").read_text()  # the worst pairs
    main(["report", *runs, "--out", str(tmp_path / "compared")])
    assert "run11" in (tmp_path / "compared" / "report.md").read_text()
    assert capsys.readouterr().out.count("report.") == 4


def test_bad_input_is_one_line_and_exit_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fails(["download", "kitti-2051", "--out", str(tmp_path)], capsys, "kitti-2051", "kitti-2015")
    fails(["download", "--out", str(tmp_path)], capsys, "names")
    fails(["report", str(tmp_path)], capsys, "no run")
    fails(["filter", str(tmp_path / "a.txt"), "--out", str(tmp_path / "b.txt")], capsys, "MATCHES", ".npz")
    fails(["filter", str(tmp_path / "a.csv"), "--out", str(tmp_path / "b.csv")], capsys, "a.csv")


def test_filter_repairs_and_refines_with_a_folder_of_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair = render_pair(2)
    for name, image in (("a.png", pair.image0), ("b.png", pair.image1)):
        write_image(tmp_path / name, image)
    left, right = (str(tmp_path / name) for name in ("a.png", "b.png"))
    main(["classify", left, right, "--detector", "fast", "--out", str(tmp_path / "m.csv")])
    table = pl.read_csv(tmp_path / "m.csv").with_columns(image0=pl.lit("a.png"), image1=pl.lit("b.png"))
    table.write_csv(tmp_path / "m.csv")
    capsys.readouterr()
    command = ["filter", str(tmp_path / "m.csv"), "--out", str(tmp_path / "out.csv")]
    main([*command, "--images", str(tmp_path)])
    printed = printed_values(capsys)
    assert not any(name in printed for name in ("num_improved", "num_refined", "num_repaired"))
    main([*command, "--images", str(tmp_path), "--repair", "--refine"])
    improved = printed_values(capsys)
    assert improved["num_kept"] == printed["num_kept"]  # of those given
    assert int(improved["num_improved"]) > int(improved["num_kept"])
    assert int(improved["num_repaired"]) + int(improved["num_refined"]) <= int(improved["num_improved"])
    assert min(int(improved[name]) for name in ("num_repaired", "num_refined")) > 0
    found = pl.read_csv(tmp_path / "out.csv")
    assert found["improved_inlier"].sum() == int(improved["num_improved"])
    fails([*command, "--repair"], capsys, "images must be the folder of the images for repair")
