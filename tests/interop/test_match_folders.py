from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tensor_stereo import filter_file, filter_files
from tensor_stereo.cli import main
from tensor_stereo.configs import FilterConfig
from tensor_stereo.interop import match_folders
from tensor_stereo.locks import lock
from tests.awkward_names import NAMES
from tests.cli.failing import fails
from tests.interop.match_batches import batch
from tests.interop.test_match_tables import table_of
from tests.interop.test_npz_forms import lightglue

SETTINGS = FilterConfig(verdict="cardinality")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A folder with files of several forms, one of them damaged, and what is no file of matches."""
    folder = tmp_path / "matches"
    (folder / "deep [1]" / "seed=3").mkdir(parents=True)
    table_of(batch(1)).write_csv(folder / "a.csv")
    table_of(batch(2)).write_parquet(folder / "deep [1]" / "b.PARQUET")
    np.savez(folder / "deep [1]" / "seed=3" / "c.npz", **lightglue(3)[0])
    (folder / "damaged.npz").write_bytes(b"PK no archive")
    (folder / "readme.txt").touch()
    (folder / ".hidden.csv").touch()
    return folder


GOOD = ("a.csv", "deep [1]/b.PARQUET", "deep [1]/seed=3/c.npz")


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_every_file_has_its_result_and_failures_are_told(source: Path, tmp_path: Path) -> None:
    out, seen = tmp_path / "out", []
    summary = filter_files(source, out, config=SETTINGS, on_progress=lambda *state: seen.append(state))
    assert set(contents(out)) == {*GOOD, ".filter.lock", "filter.json", "filter.jsonl"}
    assert (summary.num_files, summary.num_found, list(summary.errors)) == (4, 0, ["damaged.npz"])
    assert "no readable archive" in summary.errors["damaged.npz"]
    assert [state[:2] for state in seen] == [(k + 1, 4) for k in range(4)]
    total = 0
    for name in GOOD:
        alone = tmp_path / f"alone{Path(name).suffix}"
        total += filter_file(source / name, alone, config=SETTINGS).num_matches
        assert (out / name).read_bytes() == alone.read_bytes()
    assert summary.matches.num_matches == total


def test_a_second_call_does_only_what_is_left(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def counting(path: Path, *arguments: object, **settings: object) -> object:
        done.append(path.relative_to(source).as_posix())
        return filter_file(path, *arguments, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(match_folders, "filter_file", counting)
    out = tmp_path / "out"
    first = filter_files(source, out, config=SETTINGS)
    before = contents(out)
    done.clear()
    again = filter_files(source, out, config=SETTINGS)
    assert done == ["damaged.npz"]  # what failed is tried again
    assert (again.num_found, again.matches, again.errors) == (3, first.matches, first.errors)
    assert contents(out) == before
    table_of(batch(9)).write_csv(source / "a.csv")  # changed
    (out / "deep [1]" / "b.PARQUET").unlink()  # lost
    journal = out / "filter.jsonl"
    journal.write_bytes(journal.read_bytes() + b'{"name": "torn')
    (out / GOOD[2]).write_bytes(b"")  # cut off
    done.clear()
    filter_files(source, out, config=SETTINGS)
    assert done == ["a.csv", "damaged.npz", *GOOD[1:]]
    done.clear()
    filter_files(source, out, config=SETTINGS)
    assert done == ["damaged.npz"]
    filter_file(source / "a.csv", tmp_path / "alone.csv", config=SETTINGS)
    assert (out / "a.csv").read_bytes() == (tmp_path / "alone.csv").read_bytes()


def test_the_result_of_a_file_that_fails_now_does_not_stay(source: Path, tmp_path: Path) -> None:
    filter_files(source, tmp_path / "out", config=SETTINGS)
    (source / "a.csv").write_text("x0,y0\n")
    assert set(filter_files(source, tmp_path / "out", config=SETTINGS).errors) == {"a.csv", "damaged.npz"}
    assert not (tmp_path / "out" / "a.csv").exists()


def test_two_calls_on_one_folder_are_refused(source: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with (tmp_path / "out" / "filter.jsonl").open("ab") as journal:
        assert lock(journal)
        with pytest.raises(ValueError, match="out: another call works on"):
            filter_files(source, tmp_path / "out", config=SETTINGS)


def test_whatever_one_file_does_the_others_are_done(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for error in (TypeError, RuntimeError, MemoryError, PermissionError):

        def failing(path: Path, *arguments: object, error: type[Exception] = error, **settings: object) -> object:
            if path.name == "a.csv":
                raise error("of its own kind")
            return filter_file(path, *arguments, **settings)  # type: ignore[arg-type]

        monkeypatch.setattr(match_folders, "filter_file", failing)
        summary = filter_files(source, tmp_path / error.__name__, config=SETTINGS)
        assert set(summary.errors) == {"a.csv", "damaged.npz"}
        assert (tmp_path / error.__name__ / GOOD[1]).exists()


@pytest.mark.skipif(os.name != "posix", reason="names of files are text on this system")
def test_names_that_are_no_text_are_no_end(source: Path, tmp_path: Path) -> None:
    for ending in (".csv", ".parquet"):
        table = table_of(batch(1))
        with open(os.fsencode(source) + b"/caf\xe9" + ending.encode(), "wb") as file:  # noqa: PTH123
            table.write_csv(file) if ending == ".csv" else table.write_parquet(file)
    assert list(filter_files(source, tmp_path / "out", config=SETTINGS).errors) == ["damaged.npz"]


def test_links_are_followed_and_results_of_other_calls_passed_over(source: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    shutil.copy(source / "a.csv", tmp_path / "elsewhere" / "linked.csv")
    (source / "link").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    (source / "loop").symlink_to(source, target_is_directory=True)
    filter_files(source, source / "first", config=SETTINGS)
    summary = filter_files(source, source / "second", config=SETTINGS)
    assert summary.num_files == 5
    assert (source / "second" / "link" / "linked.csv").exists()


def test_no_result_replaces_another_source(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    inner = source / "sub"
    inner.mkdir()
    shutil.copy(source / "a.csv", inner / "a.csv")
    (source / "list.csv").write_text("matches\na.csv\nsub/a.csv\n")
    before = contents(source)
    fails(["filter", str(source / "list.csv"), "--out", str(inner)], capsys, "--out must be another folder")
    (source / "list.csv").unlink()
    deep = source / "deep" / "deep"
    deep.mkdir(parents=True)
    for folder in (deep, deep.parent):
        shutil.copy(source / "a.csv", folder / "x.csv")
    fails(["filter", str(source / "deep"), "--out", str(source)], capsys, "--out must be another folder")
    assert {name: data for name, data in contents(source).items() if name in before} == {
        name: data for name, data in before.items() if name != "list.csv"
    }


def test_a_list_may_name_equal_files_in_several_folders(source: Path, tmp_path: Path) -> None:
    folders = [tmp_path / "scenes" / name for name in ("A", "B")]
    for folder in folders:
        folder.mkdir(parents=True)
        shutil.copy(source / "a.csv", folder / "m.csv")
    (source / "list.csv").write_text("matches\n" + "\n".join(str(folder / "m.csv") for folder in folders))
    assert filter_files(source / "list.csv", tmp_path / "out", config=SETTINGS).errors == {}
    assert (tmp_path / "out" / "A" / "m.csv").exists()
    assert (tmp_path / "out" / "B" / "m.csv").exists()


def test_an_interrupted_call_goes_on(source: Path, tmp_path: Path) -> None:
    def interrupt(done: int, total: int, name: str) -> None:
        if done == 2:
            raise KeyboardInterrupt

    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        filter_files(source, out, config=SETTINGS, on_progress=interrupt)
    assert filter_files(source, out, config=SETTINGS).num_found == 1
    plain = tmp_path / "plain"
    filter_files(source, plain, config=SETTINGS)
    for name in GOOD:
        assert (out / name).read_bytes() == (plain / name).read_bytes()


def test_results_of_other_settings_are_refused(source: Path, tmp_path: Path) -> None:
    filter_files(source, tmp_path / "out", config=SETTINGS)
    for changed in ({"config": FilterConfig(verdict="adjacency")}, {"config": SETTINGS, "score_name": "mine"}):
        with pytest.raises(ValueError, match=r"out: .* holds results of other settings"):
            filter_files(source, tmp_path / "out", **changed)  # type: ignore[arg-type]


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_a_list_names_files_wherever_they_are(source: Path, tmp_path: Path, ending: str) -> None:
    import polars as pl

    elsewhere = tmp_path / "elsewhere.csv"
    shutil.copy(source / "a.csv", elsewhere)
    names = ["deep [1]/seed=3/c.npz", " a.csv", "missing.npz"]
    table = pl.DataFrame({"matches": names})
    path = source / f"list{ending}"
    table.write_csv(path) if ending == ".csv" else table.write_parquet(path)
    summary = filter_files(path, tmp_path / "out", config=SETTINGS)
    assert set(contents(tmp_path / "out")) == {
        *("deep [1]/seed=3/c.npz", "a.csv", ".filter.lock", "filter.json", "filter.jsonl")
    }
    assert list(summary.errors) == ["missing.npz"]
    names[1] = str(elsewhere)
    table = pl.DataFrame({"matches": names})
    table.write_csv(path) if ending == ".csv" else table.write_parquet(path)
    filter_files(path, tmp_path / "other", config=SETTINGS)
    assert set(contents(tmp_path / "other")) == {
        *("matches/deep [1]/seed=3/c.npz", "elsewhere.csv", ".filter.lock", "filter.json", "filter.jsonl")
    }


def test_hdf5_files_take_the_common_keypoints_where_they_have_none(tmp_path: Path) -> None:
    pytest.importorskip("h5py", reason="h5py is not installed")
    from tests.interop.hloc_files import features, some_pairs, write_features, write_matches
    from tests.interop.test_hdf5_forms import write_exported

    folder = tmp_path / "in"
    folder.mkdir()
    write_features(folder / "features.h5", features(0))
    write_matches(folder / "hloc.h5", some_pairs(0))
    write_exported(folder / "exported.h5", {"pair": 0})
    summary = filter_files(folder, tmp_path / "out", keypoints=folder / "features.h5")
    assert (summary.num_files, summary.errors) == (2, {})
    assert set(contents(tmp_path / "out")) == {"hloc.h5", "exported.h5", ".filter.lock", "filter.json", "filter.jsonl"}


def change_list(text: str) -> Callable[[Path], Path]:
    def change(folder: Path) -> Path:
        (folder / "list.csv").write_text(text)
        return folder / "list.csv"

    return change


def empty_folder(folder: Path) -> Path:
    (folder / "empty").mkdir()
    return folder / "empty"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (empty_folder, "MATCHES must hold files that end in .npz"),
        (change_list("x0,y0,x1,y1\n"), "MATCHES must be a list with the column 'matches' where out is a folder"),
        (change_list("matches,note\na.csv,b\n"), "unknown column 'note'"),
        (change_list("matches,keypoints\n,k.h5\n"), "line 2: column 'matches' is empty"),
        (change_list("matches\na.csv\n../matches/a.csv\n"), "twice"),
        (lambda folder: folder / "none", "MATCHES"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Callable[[Path], Path], message: str
) -> None:
    fails(["filter", str(change(source)), "--out", str(tmp_path / "out")], capsys, message)


def test_results_do_not_replace_their_sources(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fails(["filter", str(source), "--out", str(source)], capsys, "--out must be another folder than MATCHES")
    before = contents(source)
    filter_files(source, source / "out", config=SETTINGS)
    again = filter_files(source, source / "out", config=SETTINGS)  # its results are no sources
    assert again.num_files == 4
    assert before.items() <= contents(source).items()


def test_the_command_tells_failures_at_the_end(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["filter", str(source), "--out", str(tmp_path / "out"), "--verdict", "cardinality"]
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    output = capsys.readouterr()
    assert stop.value.code == 1
    assert "num_files" in output.out
    lines = output.err.splitlines()
    assert lines[0].startswith("tensor-stereo: damaged.npz: ")
    assert lines[-1] == "tensor-stereo: 1 of 4 files failed"
    (source / "damaged.npz").unlink()
    main(arguments)
    assert json.loads((tmp_path / "out" / "filter.json").read_text())["score_name"] is None


@pytest.mark.parametrize("name", NAMES)
def test_names_are_taken_as_they_are(source: Path, tmp_path: Path, name: str) -> None:
    folder = tmp_path / name
    folder.mkdir()
    shutil.copy(source / "a.csv", folder / f"{name}.csv")
    summary = filter_files(folder, tmp_path / "out" / name, config=SETTINGS)
    assert summary.errors == {}
    assert (tmp_path / "out" / name / f"{name}.csv").is_file()
