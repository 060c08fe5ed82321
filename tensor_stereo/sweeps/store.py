"""The run folder of a sweep: parts that appear whole, and a journal of those that are finished.

    RUN/config.json          the points of the grid
    RUN/manifest.parquet     the pairs
    RUN/environment.json     one record per start: time, host, versions, engine
    RUN/journal-1-of-1.jsonl one line per part: its files with size and hash, the units that it holds
    RUN/metrics/part-*.parquet   one row per unit and trial
    RUN/matches/part-*.parquet   one row per match, if the sweep keeps them
    RUN/errors.parquet       one row per failed unit, written when a process begins and ends
    RUN/log.jsonl            what happened when

A part is written when the oldest result in it is ``seconds_per_part`` old, or when it is full: to a temporary file,
flushed to disk, renamed, and only then entered in the journal, which is flushed too. So a part counts once or not at
all, whenever the process ends.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import polars as pl

from tensor_stereo.atomic import whole_file
from tensor_stereo.configs import TrialConfig
from tensor_stereo.datasets.pair_table import PairTable
from tensor_stereo.sweeps.batches import ERRORS_SCHEMA, BatchResult
from tensor_stereo.sweeps.journal import (
    UnitSet,
    append,
    enter,
    is_open_elsewhere,
    open_journal,
    read_journals,
    run_lock,
)
from tensor_stereo.table_files import write_table

LOG = logging.getLogger(__name__)
_MAX_ROWS = 20_000  # that wait for their part, about 80 MB; a hundred matches weigh as much as a row
_FOLDERS = ("metrics", "matches")
FORMAT = 3  # of the run folder; another number when settings or columns are renamed, removed or change their meaning


class RunStore:
    """A run folder that this process adds to; use it as a context.

    Args:
        out: the run folder, made if it is not there.
        config: what makes the results what they are, as JSON values; another one is refused.
        manifest: the pairs; a copy is kept beside the results, and another one is refused.
        shard: (i, n), the part of the sweep that this process does; every shard has a journal of its own.
        units_per_part: units after which a part is written.
        seconds_per_part: time after which the oldest result that waits is written; :meth:`flush_if_due` looks.
        verify: hash the finished parts instead of trusting their size.

    Raises:
        ValueError: if ``out`` holds the results of another configuration, or something else.
        RunInUseError: if another process works on this shard, or on another division into shards.
        OSError: if ``out`` cannot be written.
    """

    def __init__(
        self,
        out: Path,
        config: dict[str, Any],
        manifest: PairTable,
        *,
        shard: tuple[int, int] = (1, 1),
        units_per_part: int = 500,
        seconds_per_part: float = 10.0,
        verify: bool = False,
    ) -> None:
        self.out = out
        self._name = f"{shard[0]}-of-{shard[1]}"
        self._units_per_part = units_per_part
        self._seconds_per_part = seconds_per_part
        self._pending: list[BatchResult] = []
        self._num_units = self._num_rows = 0
        self._oldest = time.monotonic()  # of what waits
        out.mkdir(parents=True, exist_ok=True)
        with run_lock(out):
            _claim(out, config, manifest)
            self._journal = open_journal(out, shard)
            try:
                self.state = read_journals(out, verify=verify)
                self._number = 1 + max((_part_number(name) for name in _part_names(out) | self.state.names), default=0)
                _set_aside_unlisted(out, self._name)
                self._write_errors()
            except BaseException:
                self._journal.close()
                raise

    def __enter__(self) -> RunStore:
        return self

    def __exit__(self, *exception: object) -> None:
        try:
            self.flush()
            with run_lock(self.out):
                self._write_errors()
        finally:
            self._journal.close()

    def add(self, batch: BatchResult) -> None:
        """Take the results of a batch; a full part is written.

        Raises:
            OSError: if the part cannot be written; its results are kept and go with the next one.
        """
        if not self._pending:
            self._oldest = time.monotonic()
        self._pending.append(batch)
        self._num_units += batch.num_units
        self._num_rows += len(batch.metrics) + (0 if batch.matches is None else len(batch.matches) // 100)
        if self._num_units >= self._units_per_part or self._num_rows > _MAX_ROWS:
            self.flush()
        else:
            self.flush_if_due()

    def flush_if_due(self) -> None:
        """Write what is pending if the oldest of it has waited long enough."""
        if self._pending and time.monotonic() - self._oldest >= self._seconds_per_part:
            self.flush()

    def flush(self) -> None:
        """Write what is pending as one part and enter it in the journal."""
        if not self._pending:
            return
        metrics = pl.concat([batch.metrics for batch in self._pending]).sort("unit", "trial")
        matches = [batch.matches for batch in self._pending if batch.matches is not None]
        files: dict[str, tuple[int, str]] = {}
        if len(metrics):
            tables = {"metrics": metrics}
            if matches:
                tables["matches"] = pl.concat(matches).sort("unit", "trial", maintain_order=True)
            for folder, table in tables.items():
                path = self.out / folder / f"part-{self._name}-{self._number:06d}.parquet"
                path.parent.mkdir(exist_ok=True)
                files[path.relative_to(self.out).as_posix()] = _write_table(table, path)
        done = UnitSet(unit for batch in self._pending for unit in batch.done).runs()
        errors = [error for batch in self._pending for error in batch.errors]
        entry = {"files": files, "done": done, "errors": errors}
        append(entry, self._journal)
        self._pending.clear()
        enter(entry, self.state)
        self._number += 1
        self._num_units = self._num_rows = 0

    def _write_errors(self) -> None:
        """The failed units of all shards, as one table."""
        _write_table(errors_table(self.out), self.out / "errors.parquet")


def errors_table(out: Path) -> pl.DataFrame:
    """The failed units of all shards, by number, with the columns of ``ERRORS_SCHEMA``."""
    errors = sorted(read_journals(out).errors.values(), key=lambda record: int(record["unit"]))
    return pl.DataFrame(errors, ERRORS_SCHEMA)


def write_json(value: Any, path: Path) -> None:
    """Write JSON in one step: there is the whole file, the old one, or none."""
    with whole_file(path) as part:
        part.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def append_environment(out: Path, record: dict[str, Any]) -> None:
    """Add the record of one start to environment.json."""
    path = out / "environment.json"
    with run_lock(out):
        records = json.loads(path.read_text()) if path.exists() else []
        write_json([*records, record], path)


def _write_table(table: pl.DataFrame, path: Path) -> tuple[int, str]:
    """Write Parquet in one step; its size and hash."""
    buffer = io.BytesIO()
    write_table(table, buffer, ".parquet")
    data = buffer.getvalue()
    with whole_file(path) as part:
        part.write_bytes(data)
    return len(data), hashlib.sha256(data).hexdigest()


def _claim(out: Path, config: dict[str, Any], manifest: PairTable) -> None:
    """Make ``out`` the run of a configuration, or raise if it is that of another one."""
    path = out / "config.json"
    config = json.loads(json.dumps(config))
    if path.exists():
        known = read_config_file(path)
        if known != config:
            change = _first_difference(known, config, "")
            raise ValueError(f"out: {out} holds results of other settings: {change}; name another folder")
        difference = manifest.first_difference(out / "manifest.parquet")
        if difference is not None:
            raise ValueError(f"out: {out} holds results of another manifest: {difference}; name another folder")
        return
    names = {entry.name for entry in out.iterdir() if not entry.name.startswith(".")}
    others = names - {"manifest.parquet"}  # it comes first, so it is what a start that was killed leaves
    if others:
        raise ValueError(f"out: {out} is no run, but holds {min(others)}; name another folder")
    with whole_file(out / "manifest.parquet") as part:
        manifest.copy_to(part)
    write_json(config, path)


def read_config_file(path: Path) -> dict[str, Any]:
    """The configuration of a run, with the defaults of settings that came after it.

    Raises:
        ValueError: if the run has another format, or settings that this release does not know.
    """
    try:
        config: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    found = config.get("format")
    if found != FORMAT:
        raise ValueError(f"{path.parent} is a run of format {found}, this release reads format {FORMAT}")
    config.get("manifest", {}).pop("sha256", None)  # of releases that did not compare the manifest itself
    if "sweep" in config:
        default = json.loads(json.dumps(asdict(TrialConfig())))
        trials = [_complete(trial, default, f"{path.parent}: setting ") for trial in config["sweep"]["trials"]]
        config["sweep"]["trials"] = trials
    return config


def _complete(settings: dict[str, Any], default: dict[str, Any], name: str) -> dict[str, Any]:
    for key, value in settings.items():
        if key not in default:
            raise ValueError(f"{name}{key} is unknown to this release; a later one has written the run")
        if isinstance(value, dict) and isinstance(default[key], dict):
            settings = settings | {key: _complete(value, default[key], f"{name}{key}.")}
    return default | settings


def _first_difference(known: Any, given: Any, name: str) -> str:
    if isinstance(known, dict) and isinstance(given, dict):
        for key in sorted(known.keys() | given.keys()):
            if known.get(key) != given.get(key):
                return _first_difference(known.get(key), given.get(key), f"{name}.{key}" if name else key)
    if isinstance(known, list) and isinstance(given, list):
        if len(known) != len(given):
            return f"{name} has {len(known)} entries there, {len(given)} here"
        for k, (old, new) in enumerate(zip(known, given, strict=True)):
            if old != new:
                return _first_difference(old, new, f"{name}[{k}]")
    return f"{name} is {known!r} there, {given!r} here"


def _set_aside_unlisted(out: Path, shard: str) -> None:
    """Rename parts that no journal lists, as after a crash before the entry: their units are done again."""
    unlisted = [name for name in _part_names(out) if _owner(name) == shard or not is_open_elsewhere(out, _owner(name))]
    listed = read_journals(out).files  # read after a look at the locks: who has ended since has entered its part
    for name in unlisted:
        path = out / name
        if path.name.startswith("."):
            path.unlink()  # half a file
        elif path.suffix == ".parquet" and name not in listed:
            path.rename(path.with_suffix(".parquet.unlisted"))
            LOG.warning("%s is in no journal, or damaged, and was set aside", name)


def _part_names(out: Path) -> set[str]:
    """Paths of all parts, of what is left of them, and of those under way."""
    found = [path for folder in _FOLDERS for path in (out / folder).glob("*part-*-of-*-*.parquet*")]
    return {path.relative_to(out).as_posix() for path in found}


def _owner(name: str) -> str:
    """The shard that a part is of."""
    return name.rsplit("part-", 1)[1].rsplit("-", 1)[0]


def _part_number(name: str) -> int:
    return int(name.rsplit("-", 1)[1].split(".")[0])
