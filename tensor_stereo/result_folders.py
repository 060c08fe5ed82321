"""Folders with one result for each of many sources; a call that ended early goes on where it was. Imports no torch."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Generic, NamedTuple, TypeVar

from tensor_stereo.atomic import append_line, drop_torn_line, whole_file
from tensor_stereo.locks import hold, is_held, lock

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)
ONE_SOURCE_FAILS = (ValueError, TypeError, ImportError, OSError, RuntimeError, MemoryError)

Summary = TypeVar("Summary")
Run = Callable[[Iterable[int]], Iterator[tuple[int, Summary | Exception]]]
"""Makes the results of some sources, by their numbers, and tells of each, in any order, or why there is none. It takes
a number when it is about to read the source."""


class Source(NamedTuple):
    """One source and its result.

    Attributes:
        name: Of the result, for the journal and for errors; unique in its folder.
        inputs: Files that the result depends on.
        results: Files that are written; those that exist tell that it is done.
        settings: What else the result depends on, as JSON; None: nothing.
    """

    name: str
    inputs: tuple[Path, ...]
    results: tuple[Path, ...]
    settings: dict[str, Any] | None = None


@dataclass(frozen=True)
class Worked(Generic[Summary]):
    """What became of the sources.

    Attributes:
        num_found: Sources that an earlier call has finished.
        errors: Reason of each source that failed, by its name.
        summaries: What is told of each of the others, by its name, in the order of the sources.
    """

    num_found: int = 0
    errors: dict[str, str] = field(default_factory=dict)
    summaries: dict[str, Summary] = field(default_factory=dict)


def check_shard(shard: tuple[int, int]) -> None:
    """Raise ValueError unless ``shard`` is (i, n) with 1 <= i <= n."""
    if not 1 <= shard[0] <= shard[1]:
        raise ValueError(f"shard must be i/n with 1 <= i <= n, got {shard[0]}/{shard[1]}")


def in_turn(make: Callable[[int], Summary]) -> Run[Summary]:
    """Make one result after the other in this process.

    >>> list(in_turn(lambda number: 10 // number)([2, 5]))
    [(2, 5), (5, 2)]
    """

    def run(numbers: Iterable[int]) -> Iterator[tuple[int, Summary | Exception]]:
        for number in numbers:
            outcome: Summary | Exception
            try:
                outcome = make(number)
            except ONE_SOURCE_FAILS as error:
                outcome = error
            yield number, outcome

    return run


class ResultFolder(Generic[Summary]):
    """A folder of results of some settings, with a file of these settings and a journal of what is done.

    Several calls can share the work: each takes one shard of the sources, with a journal of its own.

    Args:
        out: The folder; it exists.
        kind: Name of both files: ``KIND.json`` and ``KIND.jsonl``, ``KIND-i-of-n.jsonl`` of a shard.
        settings: What all results depend on, as JSON.
        defaults: Settings that files of earlier releases lack.
        to_json: A summary as the journal holds it.
        from_json: Back again; it raises for what is none.
        shard: (i, n): only every n-th source is worked on, from the i-th on, counted from 1.
    """

    def __init__(
        self,
        out: Path,
        kind: str,
        settings: dict[str, Any],
        *,
        defaults: dict[str, Any] | None = None,
        to_json: Callable[[Summary], dict[str, Any]],
        from_json: Callable[[dict[str, Any]], Summary],
        shard: tuple[int, int] = (1, 1),
    ) -> None:
        self.out, self.settings, self.defaults = out, json.loads(json.dumps(settings)), defaults or {}
        self.kind, self.shard = kind, shard
        name = kind if shard == (1, 1) else f"{kind}-{shard[0]}-of-{shard[1]}"
        self.settings_file, self.journal_file = out / f"{kind}.json", out / f"{name}.jsonl"
        self._to_json, self._from_json = to_json, from_json

    def work(
        self,
        sources: Sequence[Source],
        run: Run[Summary],
        on_progress: Callable[[int, int, str], None] | None = None,
        on_end: Callable[[dict[str, Summary]], None] | None = None,
    ) -> Worked[Summary]:
        """Make the results that are not there, or whose sources have changed; those that failed are tried again.

        Args:
            sources: All of them, also those of other shards.
            run: As :func:`in_turn` gives it.
            on_progress: Called after each source with the number of sources done, their total and the name.
            on_end: Called with the summaries of all sources that are done, also by other calls, at the end, also that
                by an error, while the shard is locked.

        Returns:
            Counts and errors of this shard, and the same summaries.

        Raises:
            ValueError: If another call works on the shard, or the folder holds results of other settings.
            OSError: If nothing can be written to it.
        """
        worked: Worked[Summary] = Worked()
        with self._claim() as journal:
            drop_torn_line(journal, self.journal_file)
            try:
                num_found = self._work(sources, run, on_progress, journal, worked)
            finally:
                with self._locked():
                    summaries = self._told(sources, worked)
                    if on_end is not None:
                        on_end(summaries)
        return Worked(num_found, worked.errors, summaries)

    def _work(
        self,
        sources: Sequence[Source],
        run: Run[Summary],
        on_progress: Callable[[int, int, str], None] | None,
        journal: IO[bytes],
        worked: Worked[Summary],
    ) -> int:
        """Fill ``worked``; how many sources were done before."""
        mine = range(self.shard[0] - 1, len(sources), self.shard[1])
        known = read_entries(self.out, self.kind)
        num_done = 0

        def tell(name: str) -> None:
            nonlocal num_done
            num_done += 1
            if on_progress is not None:
                on_progress(num_done, len(mine), name)

        todo = []
        for number in mine:
            source = sources[number]
            summary = self._read(find_entry(source, known))
            if summary is None:
                todo.append(number)
            else:
                worked.summaries[source.name] = summary
                tell(source.name)
        stamps: dict[int, list[Any]] = {}

        def begin() -> Iterator[int]:
            for number in todo:
                stamps[number] = _stamp(sources[number])
                yield number

        for number, outcome in run(begin()):
            source, stamp = sources[number], stamps.pop(number)
            if isinstance(outcome, Exception):
                if isinstance(outcome, OSError) and outcome.errno in _NO_ROOM:
                    raise outcome
                worked.errors[source.name] = " ".join(str(outcome).split())
                last = known.get(source.name)
                if last and stamp and stamp != last[-1]["stamp"]:  # the result is of what the source was
                    for path in source.results:
                        path.unlink(missing_ok=True)
            else:
                worked.summaries[source.name] = outcome
                if stamp or not source.inputs:  # else a file has come since, and who knows when
                    done = {"name": source.name, "stamp": stamp} | _state(source.results)
                    line = json.dumps(done | {"summary": self._to_json(outcome)}, separators=(",", ":"))
                    append_line(line.encode(), journal)
            tell(source.name)
        return len(mine) - len(todo)

    def _told(self, sources: Sequence[Source], worked: Worked[Summary]) -> dict[str, Summary]:
        """What is told of every source, in their order: here, and by the journals of the other shards."""
        known = read_entries(self.out, self.kind) if self.shard != (1, 1) else {}
        mine = {source.name for source in sources[self.shard[0] - 1 :: self.shard[1]]}
        found = {}
        for source in sources:
            if source.name in worked.summaries:
                found[source.name] = worked.summaries[source.name]
            elif source.name not in mine and source.name in known:
                summary = self._read(known[source.name][-1])
                if summary is not None:
                    found[source.name] = summary
        return found

    def _read(self, entry: dict[str, Any] | None) -> Summary | None:
        """What an entry tells; None without one, or of one that another release has written."""
        if entry is None:
            return None
        try:
            return self._from_json(entry["summary"])
        except (ValueError, TypeError, KeyError):
            return None

    def _locked(self) -> AbstractContextManager[None]:
        """Hold the folder for the moment of a change that all shards share."""
        return hold(self.out / f".{self.kind}.lock")

    @contextmanager
    def _claim(self) -> Iterator[IO[bytes]]:
        """The journal of this shard, locked; raise if another call has it, or divides the work in another way."""
        with self.journal_file.open("ab", buffering=0) as journal:
            with self._locked():
                if not lock(journal) or any(map(is_held, self._other_divisions())):
                    raise ValueError(f"out: another call works on {self.out}; wait for it or name another folder")
                self._claim_settings()
            yield journal

    def _other_divisions(self) -> list[Path]:
        """Journals of shards of another number of shards."""
        same = f"{self.kind}-*-of-{self.shard[1]}.jsonl"
        others = set(_journals(self.out, self.kind)) - {self.journal_file}
        return sorted(others if self.shard == (1, 1) else others - set(self.out.glob(same)))

    def _claim_settings(self) -> None:
        """Make this the folder of the settings, or raise if it is that of others."""
        path = self.settings_file
        if path.exists():
            try:
                known = dict(json.loads(path.read_text(encoding="utf-8")))
            except (ValueError, TypeError) as error:
                raise ValueError(f"{path} is damaged: {error}") from error
            if self.defaults | known != self.settings:
                raise ValueError(
                    f"out: {self.out} holds results of other settings, see {path.name}; name another folder"
                )
            return
        with whole_file(path) as part:
            part.write_text(json.dumps(self.settings, indent=1) + "\n", encoding="utf-8")


def read_entries(out: Path, kind: str) -> dict[str, list[dict[str, Any]]]:
    """All entries of each source that the journals of a folder hold, the one of the newest result last.

    A line that the end of its process has torn does not count.
    """
    entries: dict[str, list[dict[str, Any]]] = {}
    for path in _journals(out, kind):
        for line in path.read_bytes().splitlines():
            try:
                entry = {"stamp": None, "size": None, "written": []} | json.loads(line)
                if isinstance(entry["summary"], dict):
                    entries.setdefault(entry["name"], []).append(entry)
            except (ValueError, TypeError, KeyError):
                continue
    for found in entries.values():
        found.sort(key=lambda entry: entry["written"])  # those of earlier releases have none, and stay in their order
    return entries


def find_entry(source: Source, entries: dict[str, list[dict[str, Any]]]) -> dict[str, Any] | None:
    """The entry of a source that is done and has not changed since; only the last one can speak of what is there."""
    found = entries.get(source.name)
    if not found or (source.inputs and not found[-1]["stamp"]) or found[-1]["stamp"] != _stamp(source):
        return None
    state = _state(source.results)
    is_there = found[-1]["size"] == state["size"] and found[-1]["written"] in ([], state["written"])
    return found[-1] if is_there else None


def _journals(out: Path, kind: str) -> list[Path]:
    whole = out / f"{kind}.jsonl"
    return sorted(out.glob(f"{kind}-*-of-*.jsonl")) + [whole] * whole.exists()


def _state(paths: Sequence[Path]) -> dict[str, Any]:
    """Bytes of the first result, or of all if others are there too, and when they were written; None without it."""
    if not paths[0].is_file():
        return {"size": None, "written": []}
    states = [path.stat() for path in paths if path.is_file()]
    sizes = [state.st_size for state in states]
    return {"size": sizes if len(sizes) > 1 else sizes[0], "written": [state.st_mtime_ns for state in states]}


def _stamp(source: Source) -> list[Any]:
    """What changes when a source changes; empty if a file is missing."""
    try:
        states = [path.stat() for path in source.inputs]
    except OSError:
        return []
    settings = [] if source.settings is None else [source.settings]
    return [*(value for state in states for value in (state.st_size, state.st_mtime_ns)), *settings]
