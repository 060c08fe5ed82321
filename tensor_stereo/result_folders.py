"""Folders with one result for each of many sources; a call that ended early goes on where it was. Imports no torch."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Generic, NamedTuple, TypeVar

from tensor_stereo.atomic import append_line, drop_torn_line, whole_file
from tensor_stereo.locks import lock

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)
_ONE_SOURCE_FAILS = (ValueError, TypeError, ImportError, OSError, RuntimeError, MemoryError)

Summary = TypeVar("Summary")


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


class ResultFolder(Generic[Summary]):
    """A folder of results of some settings, with a file of these settings and a journal of what is done.

    Args:
        out: The folder; it exists.
        kind: Name of both files: ``KIND.json`` and ``KIND.jsonl``.
        settings: What all results depend on, as JSON.
        defaults: Settings that files of earlier releases lack.
        to_json: A summary as the journal holds it.
        from_json: Back again; it raises for what is none.
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
    ) -> None:
        self.out, self.settings, self.defaults = out, json.loads(json.dumps(settings)), defaults or {}
        self.settings_file, self.journal_file = out / f"{kind}.json", out / f"{kind}.jsonl"
        self._to_json, self._from_json = to_json, from_json

    def work(
        self,
        sources: Sequence[Source],
        run: Callable[[int], Summary],
        on_progress: Callable[[int, int, str], None] | None = None,
        on_end: Callable[[dict[str, Summary]], None] | None = None,
    ) -> Worked[Summary]:
        """Make the results that are not there, or whose sources have changed; those that failed are tried again.

        Args:
            sources: All of them.
            run: Makes the result of a source, by its number, and tells of it.
            on_progress: Called after each source with the number of sources done, their total and the name.
            on_end: Called with the summaries at the end, also that by an error, while the folder is locked.

        Raises:
            ValueError: If another call works on the folder, or it holds results of other settings.
            OSError: If nothing can be written to it.
        """
        worked: Worked[Summary] = Worked()
        with self.journal_file.open("ab", buffering=0) as journal:
            if not lock(journal):
                raise ValueError(f"out: another call works on {self.out}; wait for it or name another folder")
            self._claim()
            drop_torn_line(journal, self.journal_file)
            known = self._read_journal()
            try:
                num_found = self._work(sources, run, on_progress, journal, known, worked)
            finally:
                if on_end is not None:
                    on_end(worked.summaries)
        return Worked(num_found, worked.errors, worked.summaries)

    def _work(
        self,
        sources: Sequence[Source],
        run: Callable[[int], Summary],
        on_progress: Callable[[int, int, str], None] | None,
        journal: IO[bytes],
        known: dict[str, dict[str, Any]],
        worked: Worked[Summary],
    ) -> int:
        """Fill ``worked``; how many sources were done before."""
        num_found = 0
        for number, source in enumerate(sources):
            entry, stamp = known.get(source.name), _stamp(source)
            if entry is not None and entry["stamp"] == stamp and _sizes(source.results) == entry["size"]:
                num_found += 1
                worked.summaries[source.name] = self._from_json(entry["summary"])
            else:
                try:
                    summary = run(number)
                except _ONE_SOURCE_FAILS as error:
                    if isinstance(error, OSError) and error.errno in _NO_ROOM:
                        raise
                    worked.errors[source.name] = " ".join(str(error).split())
                    if entry is not None and stamp and stamp != entry["stamp"]:  # of what the source was
                        for path in source.results:
                            path.unlink(missing_ok=True)
                else:
                    worked.summaries[source.name] = summary
                    done = {"name": source.name, "stamp": stamp, "size": _sizes(source.results)}
                    line = json.dumps(done | {"summary": self._to_json(summary)}, separators=(",", ":"))
                    append_line(line.encode(), journal)
            if on_progress is not None:
                on_progress(number + 1, len(sources), source.name)
        return num_found

    def _claim(self) -> None:
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

    def _read_journal(self) -> dict[str, dict[str, Any]]:
        """The last entry of each source that is done; a line that the end of its process has torn does not count."""
        entries: dict[str, dict[str, Any]] = {}
        for line in self.journal_file.read_bytes().splitlines():
            try:
                entry = json.loads(line)
                self._from_json(entry["summary"])
                entries[entry["name"]] = {"stamp": None, "size": None} | entry
            except (ValueError, TypeError, KeyError):
                continue
        return entries


def _sizes(paths: Sequence[Path]) -> int | list[int] | None:
    """Bytes of the first result, or of all if others are there too; None if the first is not there."""
    if not paths[0].is_file():
        return None
    sizes = [path.stat().st_size for path in paths if path.is_file()]
    return sizes if len(sizes) > 1 else sizes[0]


def _stamp(source: Source) -> list[Any]:
    """What changes when a source changes; empty if a file is missing."""
    try:
        states = [path.stat() for path in source.inputs]
    except OSError:
        return []
    settings = [] if source.settings is None else [source.settings]
    return [*(value for state in states for value in (state.st_size, state.st_mtime_ns)), *settings]
