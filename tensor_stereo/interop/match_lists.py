"""Which files of matches a folder or a list holds, and where their results go. Imports no torch."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tensor_stereo.interop.formats import FORMATS, KEYPOINTS_ENDING
from tensor_stereo.paths import TABLES, check_folder, check_source, has_ending, prepare_folder

LIST_COLUMNS = ("matches", "keypoints")
KIND = "filter"  # of results: filter.json and filter.jsonl


class MatchFile(NamedTuple):
    """One file to filter.

    Attributes:
        name: Path of its result below the folder of results, with ``/``.
        source: The file.
        keypoints: File of keypoints that belongs to an ``.h5`` file, or None.
    """

    name: str
    source: Path
    keypoints: Path | None = None


def is_many(source: Path, out: Path) -> bool:
    """Whether a call is about a folder or a list of files, not about one: ``source`` is a folder, or ``out`` no file.

    >>> is_many(Path("list.csv"), Path("results")), is_many(Path("m.csv"), Path("filtered.csv"))
    (True, False)
    """
    return source.is_dir() or (has_ending(source, TABLES) and not has_ending(out, tuple(FORMATS)))


def find_match_files(source: Path, out: Path, keypoints: Path | None = None) -> list[MatchFile]:
    """List the files of matches in a folder and below, or in a list of paths.

    Hidden files and folders are passed over, and so are ``out``, other folders of results and ``keypoints`` where they
    lie below ``source``; links are followed, each folder once. A list is a CSV or Parquet table with the column
    ``matches`` and optionally ``keypoints``: paths that are absolute or relative to the folder of the list. Their
    results have the paths of the files below that folder, or below the one that all have in common.

    Args:
        source: The folder or the list.
        out: Folder of the results, which keeps the folders below ``source``.
        keypoints: File of keypoints for the ``.h5`` files that hold none.

    Returns:
        The files in the order of their names, or of the list.

    Raises:
        FileNotFoundError: If ``source`` or ``keypoints`` is missing.
        ValueError: If there is no file of matches, the list is wrong, or two results would have one name.
        OSError: If ``out`` cannot be written.
    """
    if keypoints is not None:
        check_source("keypoints", keypoints, (".h5",))
    if source.is_dir():
        check_folder("source", source)
        files = list(_walk(source, out, keypoints))
        if not files:
            raise ValueError(f"source must hold files that end in {', '.join(FORMATS)}, got the folder {source}")
    else:
        check_source("source", source, TABLES)
        files = list(_read_list(source, keypoints))
    _check_results(files, out, [source, *(() if keypoints is None else (keypoints,))])
    prepare_folder("out", out)
    return files


def _check_results(files: list[MatchFile], out: Path, others: list[Path]) -> None:
    """Raise if two results would have one name, or one would replace a file that is read."""
    read = {path.resolve() for file in files for path in (file.source, file.keypoints) if path is not None}
    read |= {path.resolve() for path in others}
    seen: dict[str, Path] = {}
    for file in files:
        other = seen.setdefault(file.name, file.source)
        if other is not file.source:
            same = other.resolve() == file.source.resolve()
            what = f"{other} twice" if same else f"{other} and {file.source}, whose results would have one name"
            raise ValueError(f"source names {what}")
        if (out / file.name).resolve() in read:
            raise ValueError(f"out must be another folder than source, whose file {out / file.name} it would replace")


def _walk(source: Path, out: Path, keypoints: Path | None) -> Iterator[MatchFile]:
    passed_over = {out.resolve(), *(() if keypoints is None else (keypoints.resolve(),))}
    visited: set[Path] = set()
    for folder, folders, names in os.walk(source, followlinks=True):
        here = Path(folder)
        real = here.resolve()
        is_result = here != source and (here / f"{KIND}.json").is_file()  # of another call
        if real in visited or real in passed_over or is_result:
            folders.clear()
            if here != source:
                continue
        visited.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            path = here / name
            is_match_file = has_ending(path, tuple(FORMATS)) and not name.startswith(".")
            is_match_file &= not name.endswith(KEYPOINTS_ENDING)
            if is_match_file and path.resolve() not in passed_over:
                yield MatchFile(path.relative_to(source).as_posix(), path, _keypoints_of(path, keypoints))


def _keypoints_of(path: Path, keypoints: Path | None) -> Path | None:
    """The common file of keypoints, for a file that needs one: glue-factory's hold their own."""
    if keypoints is None or not has_ending(path, ".h5"):
        return None
    from tensor_stereo.interop.hdf5 import find_exported, open_file

    try:
        with open_file(path) as file:
            find_exported(path, file)
    except ValueError:
        return keypoints
    return None


def _read_list(source: Path, keypoints: Path | None) -> Iterator[MatchFile]:
    from tensor_stereo.table_files import read_csv, read_parquet

    table = read_csv(source) if has_ending(source, ".csv") else read_parquet(source)
    if "matches" not in table.columns:
        raise ValueError(
            f"source must be a list with the column 'matches' where out is a folder, {source} has {table.columns}"
        )
    unknown = sorted(set(table.columns) - set(LIST_COLUMNS))
    if unknown:
        raise ValueError(f"{source} has the unknown column {unknown[0]!r}; known are {list(LIST_COLUMNS)}")
    files = []
    for row, values in enumerate(table.iter_rows(named=True)):
        texts = {name: str(value).strip() for name, value in values.items() if value is not None}
        if not texts.get("matches"):
            place = f"line {row + 2}" if has_ending(source, ".csv") else f"row {row + 1}"
            raise ValueError(f"{source}, {place}: column 'matches' is empty")
        path = Path(os.path.normpath(source.absolute().parent / texts["matches"]))
        own = source.parent / texts["keypoints"] if texts.get("keypoints") else _keypoints_of(path, keypoints)
        files.append((path, own))
    folder = source.absolute().parent
    if not all(path.is_relative_to(folder) for path, _ in files):  # then below the folder that all have in common
        folder = Path(os.path.commonpath([path.parent for path, _ in files]))
    for path, own in files:
        yield MatchFile(path.relative_to(folder).as_posix(), path, own)
