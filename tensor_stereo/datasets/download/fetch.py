"""Downloads of published releases, laid out so that :func:`~tensor_stereo.datasets.find_pairs` reads them."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from tensor_stereo.atomic import whole_file
from tensor_stereo.datasets.download.archives import is_archive, unpack_archive
from tensor_stereo.datasets.download.releases import RELEASES, Release, RemoteFile
from tensor_stereo.datasets.download.transfer import discard_part, fetch_part
from tensor_stereo.datasets.files import StrPath
from tensor_stereo.datasets.image_size import image_size

LOCK_NAME = "checksums.json"
_LOCK_VERSION = 1


@dataclass(frozen=True)
class DownloadProgress:
    """What a download is doing.

    Attributes:
        file: name of the file at work.
        step: ``download``; ``check``, where the members of an archive are read; ``unpack``.
        bytes_done: of this step.
        bytes_total: of this step; None while unknown.
    """

    file: str
    step: Literal["download", "check", "unpack"]
    bytes_done: int
    bytes_total: int | None


@dataclass(frozen=True)
class _Entry:
    """What the lock file keeps of one remote file: its hash, and the size of each file that came of it."""

    sha256: str
    files: Mapping[str, int]  # by path, relative to the folder of the lock file

    def is_complete(self, root: Path) -> bool:
        return all(
            (root / name).is_file() and (root / name).stat().st_size == size for name, size in self.files.items()
        )


def download_releases(
    names: Iterable[str],
    out: StrPath,
    *,
    base_url: str | None = None,
    progress: Callable[[DownloadProgress], None] | None = None,
) -> list[Path]:
    """Fetch and unpack published stereo releases, each into a folder of its name.

    ``out/checksums.json`` records the SHA-256 of every file that was fetched and what came of it. Files that are still
    there with the recorded sizes are not fetched again, a broken download goes on where it stopped, and a file that is
    fetched anew must have the recorded hash. No published hashes are known: the first download is the one that counts.
    An archive that already lies in its place is taken as downloaded. Archives are removed once unpacked.

    Args:
        names: of the releases, as in :data:`~tensor_stereo.datasets.download.releases.RELEASES`.
        out: folder for all of them, made if missing; one process at a time may write to it.
        base_url: mirror, whose scheme, host and path replace scheme and host of every address.
        progress: called with what is going on, often.

    Returns:
        The folders of the releases, in the order of ``names``.

    Raises:
        TypeError: if ``names`` is one string.
        ValueError: if a release is unknown (lists those known), ``base_url`` is no http address, an archive is damaged
            or wants to write outside its folder, a hash differs from the recorded one (names both hashes and how to
            accept the new file), or the lock file is damaged.
        ImportError: if an archive needs py7zr, which is not installed; the archive stays.
        OSError: if a server refuses, the connection breaks again and again (resumable), or the disk is full.

    >>> download_releases(["kitti-2051"], "data")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    ValueError: unknown release 'kitti-2051'; known are middlebury-2001, middlebury-2003, ...
    """
    releases = _select(names)
    _check_base_url(base_url)
    root = Path(out)
    root.mkdir(parents=True, exist_ok=True)
    for release in releases:
        for file in release.files:
            entry = _read_lock(root).get(file.url)
            if entry is None or not entry.is_complete(root):
                _fetch(file, root, release.name, None if entry is None else entry.sha256, base_url, progress)
    return [root / release.name for release in releases]


def _select(names: Iterable[str]) -> list[Release]:
    if isinstance(names, str):
        raise TypeError(f"names must be a sequence of releases, got the string {names!r}")
    names = list(dict.fromkeys(names))
    for name in names:
        if name not in RELEASES:
            raise ValueError(f"unknown release {name!r}; known are {', '.join(RELEASES)}")
    if not names:
        raise ValueError(f"names must hold at least one release; known are {', '.join(RELEASES)}")
    return [RELEASES[name] for name in names]


def _check_base_url(base_url: str | None) -> None:
    if base_url is not None and (urlsplit(base_url).scheme not in ("http", "https") or not urlsplit(base_url).netloc):
        raise ValueError(f"base_url must be an address as https://mirror.example.org, got {base_url!r}")


def _fetch(
    file: RemoteFile,
    root: Path,
    release: str,
    sha256: str | None,
    base_url: str | None,
    progress: Callable[[DownloadProgress], None] | None,
) -> None:
    """Retrieve one file, unpack it if it is an archive, and record both."""

    def report(step: Literal["download", "check", "unpack"], done: int, total: int | None) -> None:
        if progress is not None:
            progress(DownloadProgress(file.name, step, done, total))

    folder = root / release / file.folder
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / file.name
    url = file.url if base_url is None else base_url.rstrip("/") + urlsplit(file.url).path
    try:
        found = _retrieve(url, path, sha256, partial(report, "download"))
    except ValueError as error:
        raise ValueError(
            f"{path} is not what {root / LOCK_NAME} records. {error} To accept what the server has now, delete the "
            f"entry {file.url} there"
        ) from error
    if is_archive(file.name):
        files = unpack_archive(path, folder, progress=report)
    else:
        files = [path]
        _check_image(path)
    sizes = {unpacked.relative_to(root).as_posix(): unpacked.stat().st_size for unpacked in files}
    _write_lock(root, {**_read_lock(root), file.url: _Entry(found, sizes)})
    if is_archive(file.name):
        path.unlink()


def _check_image(path: Path) -> None:
    """Raise unless ``path`` is an image: servers and networks may answer with a page of text and status 200."""
    try:
        image_size(path)
    except ValueError as error:
        raise ValueError(f"{error}; delete it to have it downloaded again") from error


def _retrieve(url: str, path: Path, sha256: str | None, progress: Callable[[int, int | None], None]) -> str:
    """Have ``url`` at ``path`` and return its SHA-256; ValueError by pooch if it is not ``sha256``."""
    import pooch  # here, as nothing else needs it

    part = path.with_name(f"{path.name}.part")

    def fetch(url: str, output_file: str, _: object) -> None:
        fetch_part(url, part, progress=progress)
        Path(output_file).unlink()
        try:
            os.link(part, output_file)  # pooch removes its file if it is interrupted while hashing; the part survives
        except OSError:  # no links on this file system
            part.replace(output_file)

    with _quiet(pooch.get_logger()):
        try:
            pooch.retrieve(url, known_hash=sha256, fname=path.name, path=path.parent, downloader=fetch)
        except ValueError:
            discard_part(part)
            raise
    discard_part(part)
    return pooch.file_hash(path) if sha256 is None else sha256


@contextmanager
def _quiet(logger: logging.Logger) -> Iterator[None]:
    """Keep pooch from writing to the terminal, where progress is drawn."""
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)


def _read_lock(root: Path) -> dict[str, _Entry]:
    path = root / LOCK_NAME
    if not path.exists():
        return {}
    try:
        lock = json.loads(path.read_text(encoding="utf-8"))
        if lock["version"] != _LOCK_VERSION:
            raise ValueError(f"its version is {lock['version']}, not {_LOCK_VERSION}")
        return {url: _Entry(str(entry["sha256"]), dict(entry["files"])) for url, entry in lock["entries"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} is no readable record of downloads ({error}); mend it, or delete it to have all files fetched anew"
        ) from error


def _write_lock(root: Path, entries: Mapping[str, _Entry]) -> None:
    """Write the lock file in one step: there is the old one or the new one."""
    lock = {"version": _LOCK_VERSION, "entries": {url: asdict(entry) for url, entry in sorted(entries.items())}}
    with whole_file(root / LOCK_NAME) as part:
        part.write_text(json.dumps(lock, indent=1) + "\n", encoding="utf-8")
