"""Many files of matches: one result per file; a call that ended early goes on where it was."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tensor_stereo.atomic import append_line, drop_torn_line, whole_file
from tensor_stereo.configs import FileFilterConfig, FilterConfig
from tensor_stereo.interop.formats import keypoints_beside
from tensor_stereo.interop.match_files import filter_file
from tensor_stereo.interop.match_lists import JOURNAL_FILE, SETTINGS_FILE, MatchFile, find_match_files
from tensor_stereo.interop.verdicts import FilterSummary
from tensor_stereo.locks import lock
from tensor_stereo.paths import check_folder, has_ending

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)


@dataclass(frozen=True)
class FolderSummary:
    """What became of many files.

    Attributes:
        num_files: All files.
        num_found: Those that an earlier call has finished.
        errors: Reason of each file that failed, by its name.
        matches: Counts over the files that are finished.
    """

    num_files: int = 0
    num_found: int = 0
    errors: dict[str, str] = field(default_factory=dict)
    matches: FilterSummary = field(default_factory=FilterSummary)


def filter_files(
    source: Path | str,
    out: Path | str,
    *,
    keypoints: Path | str | None = None,
    score_name: str | None = None,
    config: FilterConfig | None = None,
    images: Path | str | None = None,
    repair: bool = False,
    refine: bool = False,
    on_progress: Callable[[int, int, str], None] | None = None,
) -> FolderSummary:
    r"""Filter all files of matches in a folder or a list, each as :func:`~tensor_stereo.filter_file` does.

    Every result has the name of its file, below ``out``. ``filter.json`` in that folder holds the settings and
    ``filter.jsonl`` one line per file that is done. Call it again to go on after an interruption: files that are done
    and have not changed since are not done again, and those that failed are.

    Args:
        source: A folder, or a ``.csv`` or ``.parquet`` list with the column ``matches`` and optionally ``keypoints``,
            paths that are absolute or relative to the folder of the list.
        out: Folder of the results; it is made.
        keypoints: File of keypoints for the ``.h5`` files of hloc or DISK, which hold none.
        score_name: Name of the score, as in :func:`~tensor_stereo.filter_file`. Not for ``.h5`` and ``.db``.
        config: Settings of verdict and score, as in :func:`~tensor_stereo.filter_file`.
        images: Folder of the images of all files, as in :func:`~tensor_stereo.filter_file`. Whether an image has
            changed nobody asks when a call goes on.
        repair: Search rejected matches again, as there.
        refine: Move kept matches, as there.
        on_progress: Called after each file with the number of files done, their total and the name of the file.

    Returns:
        Counts, and the reason for each file that failed.

    Raises:
        ValueError: If there is no file, the list is wrong, or ``out`` holds results of other settings.
        FileNotFoundError: If ``source`` or ``keypoints`` is missing.
        OSError: If nothing can be written to ``out``.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "a.csv").write_text("x0,y0,x1,y1\n0,0,-3,0\n9,1,6,1\n1,8,-2,8\n8,9,5,9\n")
        ...     _ = Path(folder, "b.csv").write_text("x0,y0\n")
        ...     summary = filter_files(folder, Path(folder, "out"), config=FilterConfig(verdict="cardinality"))
        ...     summary.matches.num_kept, list(summary.errors), Path(folder, "out", "a.csv").exists()
        (4, ['b.csv'], True)
    """
    source, out = Path(source), Path(out)
    files = find_match_files(source, out, None if keypoints is None else Path(keypoints))
    looks = {"images": None if images is None else str(Path(images).absolute()), "repair": repair, "refine": refine}
    if images is not None:
        check_folder("images", Path(images))
    settings = {"config": asdict(config or FileFilterConfig()), "score_name": score_name, **looks}
    errors: dict[str, str] = {}
    total = FilterSummary()
    num_found = 0
    with (out / JOURNAL_FILE).open("ab", buffering=0) as journal:
        if not lock(journal):
            raise ValueError(f"out: another call works on {out}; wait for it or name another folder")
        _claim(out, json.loads(json.dumps(settings)))
        drop_torn_line(journal, out / JOURNAL_FILE)
        known = _read_journal(out / JOURNAL_FILE)
        for number, file in enumerate(files):
            result, stamp = out / file.name, _stamp(file)
            entry = known.get(file.name)
            if entry is not None and entry["stamp"] == stamp and _sizes(result) == entry["size"]:
                num_found += 1
                total += FilterSummary(**entry["summary"])
            else:
                try:
                    summary = _filter_one(file, result, score_name, config, looks)
                except (ValueError, TypeError, ImportError, OSError, RuntimeError, MemoryError) as error:
                    if isinstance(error, OSError) and error.errno in _NO_ROOM:
                        raise
                    errors[file.name] = " ".join(str(error).split())
                    if entry is not None:  # the result of what the file was
                        for path in (result, keypoints_beside(result)):
                            path.unlink(missing_ok=True)
                else:
                    total += summary
                    done = {"name": file.name, "stamp": stamp, "size": _sizes(result), "summary": asdict(summary)}
                    append_line(json.dumps(done, separators=(",", ":")).encode(), journal)
            if on_progress is not None:
                on_progress(number + 1, len(files), file.name)
    return FolderSummary(len(files), num_found, errors, total)


def _filter_one(
    file: MatchFile, result: Path, score_name: str | None, config: FilterConfig | None, looks: dict[str, Any]
) -> FilterSummary:
    return filter_file(
        file.source,
        result,
        keypoints=file.keypoints,
        score_name=None if has_ending(file.source, (".h5", ".db")) else score_name,
        config=config,
        **looks,
    )


def _sizes(path: Path) -> int | list[int] | None:
    """Bytes of a result, and of its keypoints if there are some; None if there is none."""
    if not path.is_file():
        return None
    beside = keypoints_beside(path)
    is_pair = has_ending(path, ".h5") and beside.is_file()
    return [path.stat().st_size, beside.stat().st_size] if is_pair else path.stat().st_size


def _stamp(file: MatchFile) -> list[int]:
    """What changes when a file or its keypoints change; empty if one is missing."""
    try:
        states = [path.stat() for path in (file.source, file.keypoints) if path is not None]
    except OSError:
        return []
    return [value for state in states for value in (state.st_size, state.st_mtime_ns)]


def _claim(out: Path, settings: dict[str, Any]) -> None:
    """Make ``out`` the folder of some settings, or raise if it is that of others."""
    path = out / SETTINGS_FILE
    if path.exists():
        try:
            known = dict(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} is damaged: {error}") from error
        if {"images": None, "repair": False, "refine": False} | known != settings:
            raise ValueError(f"out: {out} holds results of other settings, see {path.name}; name another folder")
        return
    with whole_file(path) as part:
        part.write_text(json.dumps(settings, indent=1) + "\n", encoding="utf-8")


def _read_journal(path: Path) -> dict[str, dict[str, Any]]:
    """The last entry of each file that is done; a line that the end of its process has torn does not count."""
    entries: dict[str, dict[str, Any]] = {}
    for line in path.read_bytes().splitlines() if path.exists() else ():
        try:
            entry = json.loads(line)
            FilterSummary(**entry["summary"])
            entries[entry["name"]] = {"stamp": None, "size": None} | entry
        except (ValueError, TypeError, KeyError):
            continue
    return entries
