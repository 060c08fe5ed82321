"""The journals of a run folder: which parts are finished, and who works on them."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from tensor_stereo.atomic import append_line, drop_torn_line
from tensor_stereo.locks import lock

LOG = logging.getLogger(__name__)


@dataclass
class JournalState:
    """What the journals of a run say.

    Attributes:
        good: units with rows.
        errors: the record of each other unit that failed; a unit may fail, and be good another time.
        files: size and hash of each finished part, by path relative to the run.
        names: paths of all parts that were ever finished, also damaged and missing ones.
    """

    good: set[int] = field(default_factory=set)
    errors: dict[int, dict[str, Any]] = field(default_factory=dict)
    files: dict[str, tuple[int, str]] = field(default_factory=dict)
    names: set[str] = field(default_factory=set)

    @property
    def done(self) -> set[int]:
        """Units that are not to be done again."""
        return self.good | self.errors.keys()


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
    lost: set[int] = set()
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
                lost |= set(entry["done"])
                entry = entry | {"files": {}, "done": []}
            enter(entry, state)
    for unit in lost - state.good:  # they were good, so an older error does not count
        state.errors.pop(unit, None)
    return state


def enter(entry: dict[str, Any], state: JournalState) -> None:
    """Enter one line of a journal, in any order: a unit with rows is good, whatever else was said of it."""
    state.files.update(entry["files"])
    state.names |= entry["files"].keys()
    for unit in entry["done"]:
        state.good.add(unit)
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


@contextmanager
def run_lock(out: Path) -> Iterator[None]:
    """Wait for, and hold, the run folder for the moment of a change that all shards share."""
    with (out / ".lock").open("w") as file:
        lock(file, wait=True)
        yield


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
    path = out / f"journal-{shard}.jsonl"
    if not path.exists():
        return False
    with path.open("r+") as file:
        return not lock(file)


def _is_whole(path: Path, size: int, sha256: str, verify: bool) -> bool:
    try:
        if path.stat().st_size != size:
            return False
        return not verify or hashlib.sha256(path.read_bytes()).hexdigest() == sha256
    except FileNotFoundError:
        return False
