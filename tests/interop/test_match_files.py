from __future__ import annotations

import os
import sqlite3
import warnings
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import torch

from tensor_stereo import DelaunayFilter, DomainWarning, Matches
from tensor_stereo.batching import collate_matches, ptr_to_batch, split_matches
from tensor_stereo.configs import FileFilterConfig, FilterConfig, PipelineConfig
from tensor_stereo.interop.formats import FORMATS
from tensor_stereo.interop.match_files import filter_file
from tensor_stereo.interop.verdicts import Verdicts
from tests.awkward_names import NAMES
from tests.interop.match_batches import batch, expected, expected_of_any_views

ENDINGS = (".npz", ".csv", ".parquet", ".h5", ".db")
SET_TEST = {"verdict": "adjacency", "min_group_size": 1, "tie_tolerance": 0.01, "backend": "scipy"}


def write_source(folder: Path, ending: str, matches: Matches) -> dict[str, Any]:
    """A file of the given pairs; returns the first arguments of filter_file."""
    source, out = folder / f"in{ending}", folder / f"out{ending}"
    items = split_matches(matches)
    if ending == ".npz":
        views = {"keypoints0": matches.keypoints0.numpy(), "keypoints1": matches.keypoints1.numpy()}
        np.savez(source, ptr=matches.ptr.numpy(), **views)
    elif ending in (".csv", ".parquet"):
        views = {f"{axis}{v}": points[:, k] for v, points in enumerate(both(matches)) for k, axis in enumerate("xy")}
        table = pl.DataFrame({**views, "pair": ptr_to_batch(matches.ptr).numpy()})
        table.write_csv(source) if ending == ".csv" else table.write_parquet(source)
    elif ending == ".h5":
        h5py = pytest.importorskip("h5py", reason="h5py is not installed")
        with h5py.File(source, "w") as file, h5py.File(folder / "keypoints.h5", "w") as keypoints:
            for b, item in enumerate(items):
                file[f"{b}-0.png/{b}-1.png/matches0"] = np.arange(item.num_matches)
                for view, points in enumerate(both(item)):
                    keypoints[f"{b}/{view}.png/keypoints"] = points
        return {"source": source, "out": out, "keypoints": folder / "keypoints.h5"}
    else:
        pytest.importorskip("pycolmap", reason="pycolmap is not installed")
        with closing(sqlite3.connect(source)) as database, database:
            for name, key in (("keypoints", "image_id"), ("matches", "pair_id")):
                database.execute(f"CREATE TABLE {name} ({key} INTEGER PRIMARY KEY NOT NULL, rows, cols, data BLOB)")
            for b, item in enumerate(items):
                rows = np.stack([np.arange(item.num_matches, dtype="<u4")] * 2, axis=1)
                pair_id = (2 * b + 1) * 2147483647 + 2 * b + 2
                database.execute("INSERT INTO matches VALUES (?, ?, 2, ?)", (pair_id, len(rows), rows.tobytes()))
                for view, points in enumerate(both(item)):
                    data = points.astype("<f4").tobytes()
                    database.execute("INSERT INTO keypoints VALUES (?, ?, 2, ?)", (2 * b + 1 + view, len(rows), data))
    return {"source": source, "out": out}


def both(matches: Matches) -> tuple[np.ndarray, np.ndarray]:
    return matches.keypoints0.numpy(), matches.keypoints1.numpy()


def read_inliers(out: Path) -> list[bool]:
    """The verdicts of all pairs, in order."""
    if out.suffix == ".npz":
        with np.load(out) as arrays:
            return arrays["inlier"].tolist()  # type: ignore[no-any-return]
    if out.suffix in (".csv", ".parquet"):
        table = pl.read_csv(out) if out.suffix == ".csv" else pl.read_parquet(out)
        return table["inlier"].to_list()
    if out.suffix == ".h5":
        import h5py

        with h5py.File(out) as file:
            return [bool(value) for name0 in file for name1 in file[name0] for value in file[name0][name1]["inlier"]]
    with closing(sqlite3.connect(out)) as database:
        return [
            bool(value) for (row,) in database.execute("SELECT inlier FROM tensor_stereo_verdicts") for value in row
        ]


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def assert_verdicts(out: Path, summary: object, verdicts: Verdicts) -> None:
    assert read_inliers(out) == verdicts.inlier.tolist()
    assert summary.num_matches == len(verdicts.inlier)  # type: ignore[attr-defined]
    assert summary.num_kept == verdicts.inlier.sum()  # type: ignore[attr-defined]
    assert summary.num_untested == (verdicts.relation == 0).sum()  # type: ignore[attr-defined]


@pytest.mark.parametrize("ending", ENDINGS)
def test_all_formats_get_the_verdicts_of_one_batch(tmp_path: Path, ending: str) -> None:
    matches = batch(0)
    matches = Matches(*(points.float().double() for points in (matches.keypoints0, matches.keypoints1)), matches.ptr)
    arguments = write_source(tmp_path, ending, matches)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    summary = filter_file(**arguments)
    assert_verdicts(arguments["out"], summary, expected_of_any_views(matches))
    assert summary.num_pairs == (5 if ending in (".npz", ".h5", ".db") else 4)  # a table has no pairs without rows
    assert {path: path.read_bytes() for path in before} == before
    assert files(tmp_path) == sorted([*(path.name for path in before), f"out{ending}"])


@pytest.mark.parametrize("ending", ENDINGS)
def test_settings_reach_the_filter(tmp_path: Path, ending: str) -> None:
    matches = batch(1, [60])
    matches = Matches(*(points.float().double() for points in (matches.keypoints0, matches.keypoints1)), matches.ptr)
    arguments = write_source(tmp_path, ending, matches)
    config = FilterConfig(**SET_TEST)  # type: ignore[arg-type]
    assert_verdicts(arguments["out"], filter_file(**arguments, config=config), expected(matches, **SET_TEST))
    pipeline = PipelineConfig(verdict="adjacency")
    summary = filter_file(**arguments, config=pipeline)
    assert_verdicts(arguments["out"], summary, expected(matches, verdict="adjacency"))
    summary = filter_file(**arguments, config=FilterConfig(threshold=0.6))  # replaces what is there
    assert_verdicts(arguments["out"], summary, expected(matches, threshold=0.6))
    for settings in (
        {"score": "learned"},
        {"score": "topology", "temperature": 0.3, "threshold": 0.4},
        {"min_precision": 0.8, "score": "consensus"},
    ):
        for config in (FilterConfig(**settings), FileFilterConfig(**settings)):  # type: ignore[arg-type]
            filter_file(**arguments, config=config)
            output = DelaunayFilter(**settings, rectified=config.rectified)(matches)  # type: ignore[arg-type]
            assert read_inliers(arguments["out"]) == output.inlier.tolist()


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("turn", [0.0, 30.0])
def test_matches_of_every_format_tell_whether_their_pair_is_rectified(tmp_path: Path, ending: str, turn: float) -> None:
    matches = turned(batch(1, [200]), turn)
    arguments = write_source(tmp_path, ending, matches)
    for config in (None, FileFilterConfig(), FileFilterConfig(min_group_size=5), FilterConfig(rectified="auto")):
        summary = filter_file(**arguments, config=config)
        output = DelaunayFilter(rectified="auto", min_group_size=config.min_group_size if config else 4)(matches)
        assert read_inliers(arguments["out"]) == output.inlier.tolist()
        assert output.inlier.sum() > 80
        assert summary.num_rectified == int(output.alignment.rectified) == (turn == 0)
    for rectified in (True, False):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DomainWarning)
            summary = filter_file(**arguments, config=FileFilterConfig(rectified=rectified))
            output = DelaunayFilter(rectified=rectified)(matches)
        assert read_inliers(arguments["out"]) == output.inlier.tolist()
        assert summary.num_rectified == rectified
    assert filter_file(**arguments, config=FileFilterConfig(verdict="cardinality")).num_rectified == 0


def turned(matches: Matches, degrees: float) -> Matches:
    """The same with view 1 turned, in single precision as some formats store it."""
    angle = np.deg2rad(degrees)
    turn = torch.tensor([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]], dtype=torch.float64)
    left, right = matches.keypoints0, matches.keypoints1 @ turn
    return Matches(left.float().double(), right.float().double(), matches.ptr)


def test_each_pair_of_a_file_is_taken_for_what_it_is(tmp_path: Path) -> None:
    pairs = [turned(batch(seed, [200]), degrees) for seed, degrees in ((1, 0.0), (1, 30.0), (2, 0.0))]
    matches = collate_matches(pairs)
    arguments = write_source(tmp_path, ".npz", matches)
    summary = filter_file(**arguments)
    assert (summary.num_pairs, summary.num_rectified) == (3, 2)
    assert read_inliers(arguments["out"]) == DelaunayFilter(rectified="auto")(matches).inlier.tolist()


@pytest.mark.parametrize("ending", ENDINGS)
def test_what_fails_leaves_the_folder_as_it_was(tmp_path: Path, ending: str) -> None:
    matches = batch(2)
    matches.keypoints0[-1, 0] = float("nan")  # in the last pair
    arguments = write_source(tmp_path, ending, matches)
    arguments["out"].write_bytes(b"what was there")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ValueError, match="must be finite"):
        filter_file(**arguments)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_file_that_cannot_grow_is_an_error_of_the_system(tmp_path: Path, ending: str) -> None:
    resource = pytest.importorskip("resource", reason="this system has no limits for processes")
    arguments = write_source(tmp_path, ending, batch(3, [300]))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (arguments["source"].stat().st_size + 100, limits[1]))
    try:
        with pytest.raises(OSError, match=r"too large|cannot be written"):
            filter_file(**arguments)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert files(tmp_path) == sorted(path.name for path in arguments.values() if path != arguments["out"])


def test_out_must_be_another_file_than_the_inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = write_source(tmp_path, ".csv", batch(4))
    source = arguments["source"]
    (tmp_path / "soft.csv").symlink_to(source)
    os.link(source, tmp_path / "hard.csv")
    monkeypatch.chdir(tmp_path)
    for out in (source, tmp_path / "soft.csv", tmp_path / "hard.csv", Path("in.csv"), tmp_path / "x" / ".." / "in.csv"):
        with pytest.raises(ValueError, match="out must be another file than source"):
            filter_file(source, out)
    arguments = write_source(tmp_path, ".h5", batch(4))
    with pytest.raises(ValueError, match="out must be another file than keypoints"):
        filter_file(arguments["source"], arguments["keypoints"], keypoints=arguments["keypoints"])


def test_wrong_arguments_are_named(tmp_path: Path) -> None:
    source, out = write_source(tmp_path, ".csv", batch(5)).values()
    with pytest.raises(
        ValueError, match=r"source must end in \.npz or \.csv or \.parquet or \.h5 or \.db, got 'in\.txt'"
    ):
        filter_file(tmp_path / "in.txt", out)
    with pytest.raises(ValueError, match=r"out must end in \.csv as source does, got 'out\.npz'"):
        filter_file(source, out.with_suffix(".npz"))
    with pytest.raises(ValueError, match=r"keypoints must be None but for \.h5"):
        filter_file(source, out, keypoints=source)
    with pytest.raises(ValueError, match=r"score_name must be None for \.h5"):
        filter_file(tmp_path / "in.h5", tmp_path / "out.h5", score_name="mine")
    for name in ("", " ", "inlier", "relation"):
        with pytest.raises(ValueError, match="score_name must be the name of a column besides"):
            filter_file(source, out, score_name=name)
    with pytest.raises(FileNotFoundError, match="source: there is no file"):
        filter_file(tmp_path / "none.csv", out)
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(FileNotFoundError, match="source: there is no file"):
        filter_file(tmp_path / "folder.csv", out)
    made = tmp_path / "none" / "deeper" / "out.csv"
    filter_file(str(source), str(made))
    assert made.is_file()
    with pytest.raises(OSError, match=r"out: the folder .* cannot be made"):
        filter_file(source, source / "out.csv")


@pytest.mark.parametrize("ending", [".npz", ".parquet", ".h5", ".db"])
def test_contents_must_fit_the_ending(tmp_path: Path, ending: str) -> None:
    source = tmp_path / f"in{ending}"
    source.write_text("x0,y0,x1,y1\n1,2,3,4\n")
    keypoints = source if ending == ".h5" else None
    with pytest.raises(ValueError, match="whatever its ending says"):
        filter_file(source, tmp_path / f"out{ending}", keypoints=keypoints)


def test_endings_may_be_in_capitals(tmp_path: Path) -> None:
    source, out = write_source(tmp_path, ".csv", batch(6)).values()
    source.rename(tmp_path / "IN.CSV")
    assert filter_file(tmp_path / "IN.CSV", out).num_matches == batch(6).num_matches


def test_every_format_has_its_first_bytes(tmp_path: Path) -> None:
    assert set(FORMATS) == set(ENDINGS)
    for ending in ENDINGS[:3]:
        source = write_source(tmp_path, ending, batch(7))["source"]
        assert source.read_bytes().startswith(FORMATS[ending][0])


@pytest.mark.parametrize("name", NAMES)
def test_names_are_taken_as_they_are(tmp_path: Path, name: str) -> None:
    for ending in ENDINGS:
        folder = tmp_path / ending / name
        folder.mkdir(parents=True)
        arguments = write_source(folder, ending, batch(8))
        renamed = folder / f"{name}{ending}"
        arguments["source"].rename(renamed)
        out = folder / "out" / f"{name}{ending.upper()}"
        summary = filter_file(**(arguments | {"source": renamed, "out": out}))
        assert summary.num_matches == batch(8).num_matches
        assert files(out.parent) == [out.name]
