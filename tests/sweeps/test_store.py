from __future__ import annotations

import errno
import json
import os
import tempfile
from dataclasses import asdict
from pathlib import Path

import polars as pl
import pytest

from tensor_stereo import atomic
from tensor_stereo.configs import SweepConfig, TrialConfig
from tensor_stereo.datasets.pair_table import PairTable
from tensor_stereo.sweeps import RunInUseError, read_errors, read_results
from tensor_stereo.sweeps.batches import METRICS_SCHEMA, BatchResult, make_batch
from tensor_stereo.sweeps.journal import read_journals
from tensor_stereo.sweeps.store import FORMAT, RunStore

SWEEP = asdict(SweepConfig((TrialConfig(verdict="cardinality", score="none"),)))
CONFIG: dict[str, object] = {"format": FORMAT, "sweep": SWEEP, "manifest": {"num_pairs": 2}}


def _good(unit: int) -> BatchResult:
    return make_batch([dict.fromkeys(METRICS_SCHEMA) | {"unit": unit, "trial": 0, "num_matches": 10 * unit}])


def _bad(unit: int, message: str = "torn") -> BatchResult:
    names = ("dataset", "scene", "detector", "stage", "error")
    return make_batch([], [{"unit": unit, "attempts": 1, "message": message} | dict.fromkeys(names, "x")])


def _open(out: Path, config: dict[str, object] = CONFIG, **options: object) -> RunStore:
    with tempfile.TemporaryDirectory(prefix="manifest") as folder:
        path = Path(folder, "pairs.csv")
        path.write_text("image0,image1,scene\n/a.png,/b.png,a\n/a.png,/b.png,b\n")
        return RunStore(out, config, PairTable(path, check_files=False), **options)  # type: ignore[arg-type]


def _done(store: RunStore) -> set[int]:
    return set(store.state.good) | store.state.errors.keys()


def _units(out: Path) -> list[int]:
    return read_results(out)["unit"].to_list()


def test_parts_are_read_as_one_table(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with _open(out, units_per_part=2) as store:
        for unit in (3, 1, 2, 5, 4):
            store.add(_good(unit))
    assert len(list((out / "metrics").iterdir())) == 3
    assert _units(out) == [1, 2, 3, 4, 5]
    assert read_results(out).schema == pl.Schema(METRICS_SCHEMA)


def test_polars_and_duckdb_read_the_parts_without_this_library(tmp_path: Path) -> None:
    duckdb = pytest.importorskip("duckdb")
    out = tmp_path / "run"
    with _open(out, units_per_part=2) as store:
        for unit in range(5):
            store.add(_good(unit))
    pattern = str(out / "metrics" / "part-*.parquet")
    assert pl.read_parquet(pattern)["num_matches"].sum() == 100
    assert duckdb.sql(f"SELECT count(*), sum(num_matches) FROM '{pattern}'").fetchall() == [(5, 100)]


def test_a_damaged_part_is_set_aside_and_not_done(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with _open(out, units_per_part=2) as store:
        for unit in range(4):
            store.add(_good(unit))
    part = out / "metrics" / "part-1-of-1-000001.parquet"
    part.write_bytes(part.read_bytes()[:-1])
    with _open(out) as store:
        assert _done(store) == {2, 3}
        for unit in (0, 1):
            store.add(_good(unit))
    assert _units(out) == [0, 1, 2, 3]
    assert pl.read_parquet(str(out / "metrics" / "part-*.parquet")).height == 4
    assert part.with_suffix(".parquet.unlisted").exists()  # nothing is thrown away


def test_a_changed_byte_is_found_by_verify(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with _open(out) as store:
        store.add(_good(0))
    part = next((out / "metrics").iterdir())
    data = bytearray(part.read_bytes())
    data[20] ^= 1
    part.write_bytes(data)
    assert list(read_journals(out).good) == [0]
    assert list(read_journals(out, verify=True).good) == []


def test_a_torn_line_of_the_journal_is_done_again(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with _open(out, units_per_part=1) as store:
        store.add(_good(0))
        store.add(_good(1))
    journal = out / "journal-1-of-1.jsonl"
    journal.write_bytes(journal.read_bytes()[:-10])
    with _open(out) as store:
        assert _done(store) == {0}
        store.add(_good(1))
    assert _units(out) == [0, 1]
    assert all(json.loads(line) for line in journal.read_text().splitlines())


def test_a_part_in_no_journal_counts_once_at_most(tmp_path: Path) -> None:
    """A crash between the rename of a part and its line in the journal."""
    out = tmp_path / "run"
    with _open(out) as store:
        store.add(_good(0))
    (out / "journal-1-of-1.jsonl").write_bytes(b"")
    with _open(out) as store:
        assert _done(store) == set()
        store.add(_good(0))
    assert _units(out) == [0]
    assert pl.read_parquet(str(out / "metrics" / "part-*.parquet")).height == 1


def test_a_later_success_replaces_an_error(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with _open(out) as store:
        store.add(_bad(0))
        store.add(_bad(1, "gone"))
        store.add(_good(2))
    assert read_errors(out)["unit"].to_list() == [0, 1]
    assert pl.read_parquet(out / "errors.parquet").equals(read_errors(out))
    with _open(out) as store:
        assert _done(store) == {0, 1, 2}
        store.add(_good(0))
    assert read_errors(out)["message"].to_list() == ["gone"]
    assert pl.read_parquet(out / "errors.parquet").equals(read_errors(out))
    assert _units(out) == [0, 2]


def test_a_success_counts_whichever_journal_tells_it(tmp_path: Path) -> None:
    """A unit fails in an array of jobs, and is good in one process whose journal comes first by name."""
    out = tmp_path / "run"
    with _open(out, shard=(2, 4)) as store:
        store.add(_bad(1))
    with _open(out) as store:
        assert store.state.errors.keys() == {1}
        store.add(_good(1))
    with _open(out) as store:
        assert set(store.state.good) == _done(store) == {1}
    assert _units(out) == [1]
    assert read_errors(out).is_empty()


def test_damage_to_a_unit_that_failed_before_does_it_again(tmp_path: Path) -> None:
    out = tmp_path / "run"
    for result in (_bad(0), _good(0)):
        with _open(out) as store:
            store.add(result)
    part = next((out / "metrics").iterdir())
    part.write_bytes(part.read_bytes()[:-1])
    with _open(out) as store:
        assert _done(store) == set()


def test_a_part_never_takes_the_name_of_another(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with _open(out) as store:
        store.add(_good(1))
    next((out / "metrics").iterdir()).unlink()
    for unit in (2, 1):
        with _open(out) as store:
            assert unit not in _done(store)
            store.add(_good(unit))
    assert _units(out) == [1, 2]


def test_a_start_that_was_killed_leaves_a_folder_that_can_be_used(tmp_path: Path) -> None:
    for name in (".lock", ".4711.manifest.parquet", "manifest.parquet", ".4711.config.json"):
        (tmp_path / name).touch()
    with _open(tmp_path) as store:
        store.add(_good(0))
    assert _units(tmp_path) == [0]


def test_files_of_others_stay(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with _open(out) as store:
        store.add(_good(0))
    (out / "plots").mkdir()
    mine = [out / "plots" / "part-1-of-1-000003.parquet", out / "plots" / ".part-1-of-1-000003.parquet"]
    for path in mine:
        path.touch()
    with _open(out):
        assert all(path.exists() for path in mine)


def test_many_rows_make_a_part_of_their_own(tmp_path: Path) -> None:
    wide = dict.fromkeys(METRICS_SCHEMA)
    with _open(tmp_path / "run") as store:
        for unit in range(3):
            store.add(make_batch([wide | {"unit": unit, "trial": k} for k in range(15_000)]))
    assert len(list((tmp_path / "run" / "metrics").iterdir())) == 2


def test_another_configuration_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with _open(out) as store:
        store.add(_good(0))
    with pytest.raises(ValueError, match=r"manifest\.num_pairs is 2 there, 3 here"):
        _open(out, CONFIG | {"manifest": {"num_pairs": 3}})
    assert _units(out) == [0]


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ValueError, match=r"thesis\.tex"):
        _open(tmp_path)
    with pytest.raises(FileNotFoundError, match="no run"):
        read_results(tmp_path)


def test_one_process_a_shard(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with _open(out, shard=(1, 2)) as store:
        with pytest.raises(RunInUseError, match="journal-1-of-2"):
            _open(out, shard=(1, 2))
        with pytest.raises(RunInUseError, match="journal-1-of-2"):
            _open(out)  # another division would do the same units
        with _open(out, shard=(2, 2)) as other:
            other.add(_bad(1))
            store.add(_good(0))
            store.add(_bad(2))
    assert _units(out) == [0]
    assert pl.read_parquet(out / "errors.parquet")["unit"].to_list() == [1, 2]
    with _open(out) as store:
        assert _done(store) == {0, 1, 2}


@pytest.mark.parametrize("survives", [0, 1, 2])
def test_a_full_disk_loses_nothing_that_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, survives: int
) -> None:
    """The disk is full after so many flushes to it; then there is room again."""
    out = tmp_path / "run"
    with _open(out) as store:
        store.add(_good(0))
    flush, left = os.fsync, survives

    def full(descriptor: int) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        flush(descriptor)

    store = _open(out)
    store.add(_good(1))
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        store.flush()
    monkeypatch.undo()
    assert atomic.os.fsync is flush
    assert _units(out) == [0]
    with store:  # what is pending goes with the end
        store.add(_good(2))
    assert _units(out) == [0, 1, 2]
    assert pl.read_parquet(str(out / "metrics" / "part-*.parquet")).height == 3


@pytest.mark.skipif(os.geteuid() != 0, reason="needs the right to become another user")
def test_a_read_only_folder_is_an_error(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    os.seteuid(65534)
    try:
        with pytest.raises(PermissionError, match="run"):
            _open(tmp_path / "run")
    finally:
        os.seteuid(0)
