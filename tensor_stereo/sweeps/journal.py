"""The journals of a run folder: which parts are finished, and who works on them."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from tensor_stereo.atomic import append_line, drop_torn_line
from tensor_stereo.locks import hold, is_held, lock

LOG = logging.getLogger(__name__)


class UnitSet:
    """Numbers of units, one byte for each up to the largest.

    >>> units = UnitSet([4, 1, 2])
    >>> units.runs(), 1 in units, len(units)
    ([[1, 3], [4, 5]], True, 3)
    """

    def __init__(self, units: Iterable[int] = ()) -> None:
        self._there = np.zeros(0, np.bool_)
        self.add_runs([int(unit), int(unit) + 1] for unit in units)

    def add_runs(self, runs: Iterable[Sequence[int] | int]) -> None:
        """Add numbers, or runs of them (first, last + 1)."""
        for run in runs:
            first, end = (run, run + 1) if isinstance(run, int) else run
            if not 0 <= first <= end:
                raise ValueError(f"units must be numbers or runs of them, got {run}")
            if end > len(self._there):
                grown = np.zeros(max(end, 2 * len(self._there)), np.bool_)
                grown[: len(self._there)] = self._there
                self._there = grown
            self._there[first:end] = True

    def among(self, units: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(N,) which of some units are in the set."""
        found = np.zeros(len(units), np.bool_)
        within = units < len(self._there)
        found[within] = self._there[units[within]]
        return found

    def runs(self) -> list[list[int]]:
        """The numbers as runs (first, last + 1)."""
        edges = np.flatnonzero(np.diff(self._there, prepend=False, append=False))
        return edges.reshape(-1, 2).tolist()

    def __contains__(self, unit: int) -> bool:
        return unit < len(self._there) and bool(self._there[unit])

    def __iter__(self) -> Iterator[int]:
        return iter(np.flatnonzero(self._there).tolist())

    def __len__(self) -> int:
        return int(self._there.sum())


@dataclass
class JournalState:
    """What the journals of a run say.

    Attributes:
        good: units with rows.
        errors: the record of each other unit that failed; a unit may fail, and be good another time.
        files: size and hash of each finished part, by path relative to the run.
        names: paths of all parts that were ever finished, also damaged and missing ones.
    """

    good: UnitSet = field(default_factory=UnitSet)
    errors: dict[int, dict[str, Any]] = field(default_factory=dict)
    files: dict[str, tuple[int, str]] = field(default_factory=dict)
    names: set[str] = field(default_factory=set)

    def done(self, units: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(N,) which of some units are not to be done again: the good ones and those that failed."""
        return self.good.among(units) | self.failed(units)

    def failed(self, units: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(N,) which of some units failed."""
        return np.isin(units, np.fromiter(self.errors, np.int64, len(self.errors)))


class SweepError(RuntimeError):
    """A sweep cannot run here and now, whatever its settings."""


class RunInUseError(SweepError):
    """Another process works on the same run."""


def read_journals(out: Path, *, verify: bool = False) -> JournalState:
    """What is finished. Parts whose files are missing, or have another size or hash, count as not done.

    Args:
        out: run folder.
        verify: read and hash the files instead of asking for their size.
    """
    state = JournalState()
    lost = UnitSet()
    for path in sorted(out.glob("journal-*.jsonl")):
        for line in path.read_bytes().splitlines():
            try:
                entry = json.loads(line)
            except ValueError:  # torn by the end of its process
                LOG.warning("%s has a damaged line; what it lists is done again", path.name)
                continue
            damaged = [
                name
                for name, (size, sha256) in entry["files"].items()
                if not _is_whole(out / name, size, sha256, verify)
            ]
            for name in damaged:
                LOG.warning("%s is damaged; its units are done again", name)
            state.names |= entry["files"].keys()  # a name is never used twice
            if damaged:
                lost.add_runs(entry["done"])
                entry = entry | {"files": {}, "done": []}
            enter(entry, state)
    for unit in [unit for unit in state.errors if unit in lost]:  # it was good, so an older error does not count
        del state.errors[unit]
    return state


def enter(entry: dict[str, Any], state: JournalState) -> None:
    """Enter one line of a journal, in any order: a unit with rows is good, whatever else was said of it."""
    state.files.update(entry["files"])
    state.names |= entry["files"].keys()
    state.good.add_runs(entry["done"])
    if state.errors:
        for run in entry["done"]:
            for unit in [run] if isinstance(run, int) else range(*run):
                state.errors.pop(unit, None)
    for record in entry["errors"]:
        if record["unit"] not in state.good:
            state.errors[record["unit"]] = record


def append(entry: dict[str, Any], journal: IO[bytes]) -> None:
    """Add a line that is on disk when this returns, or is not there.

    Raises:
        OSError: if it cannot be written.
    """
    append_line(json.dumps(entry, separators=(",", ":")).encode(), journal)


def run_lock(out: Path) -> AbstractContextManager[None]:
    """Hold the run folder for the moment of a change that all shards share."""
    return hold(out / ".lock")


def open_journal(out: Path, shard: tuple[int, int]) -> IO[bytes]:
    """This shard's journal, locked as long as it is open, without the line that a crash has torn."""
    for path in out.glob("journal-*.jsonl"):
        if not path.stem.endswith(f"-of-{shard[1]}"):
            with path.open("r+") as other:
                _lock_journal(other, path)
    path = out / f"journal-{shard[0]}-of-{shard[1]}.jsonl"
    journal = path.open("ab", buffering=0)
    try:
        _lock_journal(journal, path)
        drop_torn_line(journal, path)
    except BaseException:
        journal.close()
        raise
    return journal


def _lock_journal(file: IO[Any], path: Path) -> None:
    if not lock(file):
        raise RunInUseError(f"another process works on {path.parent} ({path.stem}); wait for it or stop it")


def is_open_elsewhere(out: Path, shard: str) -> bool:
    """Whether another process works on a shard, named as in ``journal-1-of-4``."""
    return is_held(out / f"journal-{shard}.jsonl")


def _is_whole(path: Path, size: int, sha256: str, verify: bool) -> bool:
    try:
        if path.stat().st_size != size:
            return False
        return not verify or hashlib.sha256(path.read_bytes()).hexdigest() == sha256
    except FileNotFoundError:
        return False
