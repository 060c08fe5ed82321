"""Paths that a call reads and writes, looked at before any work. Imports no torch."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

TABLES = (".csv", ".parquet")  # endings of tables that are written
_STORE = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):(?=[/\\\\])")  # what a path leaves of a URL
MAPS = (".pfm", ".png", ".npy", ".tif", ".tiff")  # endings of maps that are read and written


def check_source(name: str, path: Path, endings: Sequence[str] = ()) -> Path:
    """Raise unless a file can be read and has one of some endings, in any case.

    Args:
        name: Name of the argument, for errors.
        path: File that must exist.
        endings: Allowed endings in lower case; none: any.

    Raises:
        ValueError: for another ending.
        FileNotFoundError: if there is no such file.
        PermissionError: if it cannot be read.

    >>> check_source("left", Path("missing.png"))
    Traceback (most recent call last):
    ...
    FileNotFoundError: left: there is no file missing.png
    """
    check_ending(name, path, endings)
    if not path.is_file():
        raise FileNotFoundError(f"{name}: there is no file {path}")
    if not os.access(path, os.R_OK):
        raise PermissionError(f"{name}: {path} cannot be read")
    return path


def check_folder(name: str, path: Path) -> Path:
    """Raise unless a folder exists.

    Raises:
        FileNotFoundError: if there is no such folder.
    """
    if not path.is_dir():
        raise FileNotFoundError(f"{name}: there is no folder {path}")
    return path


def has_ending(path: Path, endings: str | Sequence[str]) -> bool:
    """Whether a path has one of some endings, in any case: the one rule of this package for endings.

    Args:
        path: Any path.
        endings: One ending in lower case, or several.

    >>> has_ending(Path("disp0.PFM"), ".pfm"), has_ending(Path("a.png.txt"), (".png", ".jpg"))
    (True, False)
    """
    return ending_of(path) in ((endings,) if isinstance(endings, str) else endings)


def ending_of(path: Path) -> str:
    """The ending of a path in lower case.

    >>> ending_of(Path("matches.NPZ"))
    '.npz'
    """
    return path.suffix.casefold()


def check_ending(name: str, path: Path, endings: Sequence[str]) -> None:
    """Raise unless a path has one of some endings, in any case.

    Raises:
        ValueError: naming the endings.
    """
    if endings and not has_ending(path, endings):
        raise ValueError(f"{name} must end in {' or '.join(endings)}, got {path.name!r}")


def prepare_target(name: str, path: Path, endings: Sequence[str] = ()) -> Path:
    """Make the folder of a file that shall be written, and raise unless the file can be.

    Args:
        name: Name of the argument, for errors.
        path: File to write; one that exists may be replaced.
        endings: Allowed endings in lower case; none: any.

    Raises:
        ValueError: for another ending, or if the path is a folder.
        OSError: if the folder cannot be made, or the file not written.
    """
    check_ending(name, path, endings)
    if path.is_dir():
        raise ValueError(f"{name} must be a file, got the folder {path}")
    prepare_folder(name, path.parent)
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(f"{name}: {path} cannot be written")
    return path


def check_apart(name: str, path: Path, sources: dict[str, Path | None]) -> None:
    """Raise if a file that shall be written is one of those that are read.

    Raises:
        ValueError: naming both arguments.
    """
    for other, source in sources.items():
        if source is not None and (source.resolve() == path.resolve() or (path.exists() and path.samefile(source))):
            raise ValueError(f"{name} must be another file than {other}, got {path} for both")


def prepare_targets(targets: dict[str, tuple[Path | None, Sequence[str]]], sources: dict[str, Path | None]) -> None:
    """Check all files that a call writes, and make their folders.

    Args:
        targets: By the name of its argument every file, None if it is not wanted, and its allowed endings.
        sources: By the name of its argument every file that is read.

    Raises:
        ValueError: if one is read too, or is another one that is written; for what :func:`prepare_target` refuses.
        OSError: as :func:`prepare_target`.
    """
    taken = dict(sources)
    for name, (path, endings) in targets.items():
        if path is not None:
            check_apart(name, path, taken)
            prepare_target(name, path, endings)
            taken[name] = path


def check_no_store(name: str, path: Path) -> None:
    """Raise if a path to write to is what is left of a URL of an object store.

    Raises:
        ValueError: because nothing can be renamed there in one step.

    >>> check_no_store("out", Path("results"))
    """
    store = _STORE.match(str(path))
    if store is not None and not Path(store[0]).exists():
        raise ValueError(
            f"{name} must lie on a local or shared disk, got {path}: results are renamed in one step, which a store of "
            f"{store[1]} cannot do; copy them there when they are finished"
        )


def prepare_folder(name: str, path: Path) -> Path:
    """Make a folder that shall be written to, and raise unless it can be.

    Raises:
        ValueError: if the path is a URL.
        OSError: if the folder cannot be made or written to.
    """
    check_no_store(name, path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise type(error)(f"{name}: the folder {path} cannot be made: {error.strerror}") from error
    if not os.access(path, os.W_OK):
        raise PermissionError(f"{name}: nothing can be written to the folder {path}")
    return path
