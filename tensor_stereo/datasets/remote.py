"""Files of object stores and other hosts, by URLs of fsspec (s3://, gs://, memory://, ...). Imports no torch."""

from __future__ import annotations

import importlib
import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from tensor_stereo.datasets.files import READ, Location, PairFiles

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")
_ANY_ERROR = Exception  # what the packages behind fsspec raise has no common base


def is_url(location: Location) -> bool:
    """Whether a location is a URL.

    >>> is_url("s3://bucket/left.png"), is_url("/data/left.png"), is_url(Path("left.png"))
    (True, False, False)
    """
    return isinstance(location, str) and _URL.match(location) is not None


def to_location(text: str) -> Location:
    """A path, or a URL as it is; ``file://`` is a path.

    >>> to_location("file:///data/left%20view.png").name, to_location("gs://bucket/left.png")
    ('left view.png', 'gs://bucket/left.png')
    """
    if not is_url(text):
        return Path(text)
    return Path(unquote(urlsplit(text).path)) if text.lower().startswith("file://") else text


def absolute(location: Location) -> Location:
    """A path without links and dots, or a URL as it is.

    >>> absolute("gs://bucket/left.png")
    'gs://bucket/left.png'
    """
    return location if is_url(location) else Path(location).resolve()


def local_paths(*locations: Location | None) -> tuple[Path, ...]:
    """Those that are paths.

    >>> local_paths(Path("left.png"), "gs://bucket/right.png", None)[0].name
    'left.png'
    """
    return tuple(Path(location) for location in locations if location is not None and not is_url(location))


def beside(listed: Location, name: str) -> Location:
    """A location that a list names, absolute or relative to the folder of the list.

    >>> beside("s3://bucket/pairs/list.csv", "left.png")
    's3://bucket/pairs/left.png'
    """
    if is_url(name) or Path(name).is_absolute():
        return to_location(name)
    if isinstance(listed, Path):
        return Path(os.path.normpath(listed.absolute().parent / name))
    return f"{listed.rsplit('/', 1)[0]}/{name}"


def fetch(url: str, folder: Path, *, tables: bool = False) -> Path:
    """Copy a remote file into a local folder.

    Args:
        url: Of fsspec; credentials are those that its packages find.
        folder: That exists.
        tables: Whether the URL may be that of a folder, whose ``.parquet`` files are copied then.

    Returns:
        The local file, of the same name; or the local folder.

    Raises:
        FileNotFoundError: if there is nothing at the URL.
        ImportError: if the package for this kind of URL is not installed.
        OSError: if it cannot be read; with the reason.
    """
    fsspec: Any = importlib.import_module("fsspec")
    try:
        store, path = fsspec.core.url_to_fs(url)
        if tables and store.isdir(path):
            local = folder / "files"
            local.mkdir()
            for found in store.glob(f"{path}/*.parquet"):
                store.get_file(found, str(local / found.rsplit("/", 1)[-1]))
            return local
        name = str(path).rstrip("/").rsplit("/", 1)[-1]
        local = folder / (name.split("?", 1)[0] if url.lower().startswith("http") else name)
        store.get_file(path, str(local))
    except FileNotFoundError as error:
        raise FileNotFoundError(f"there is no file {url}") from error
    except ImportError as error:
        raise ImportError(f"{url} needs another package: {error}") from error
    except _ANY_ERROR as error:
        raise OSError(f"{url} cannot be read: {type(error).__name__}: {error}") from error
    return local


@contextmanager
def fetched(files: PairFiles, names: Sequence[str] = READ) -> Iterator[PairFiles]:
    """The same files, some of those of URLs as local copies for as long as the block runs; errors name the URLs.

    Args:
        files: Of a pair.
        names: Which are needed, of ``PATHS``.

    >>> with fetched(PairFiles("mine", "a", Path("a.png"), Path("b.png"))) as local:
    ...     local.image0.name
    'a.png'
    """
    remote = {name: url for name in names if is_url(url := getattr(files, name) or "")}
    if not remote:
        yield files
        return
    with tempfile.TemporaryDirectory(prefix="tensor-stereo-") as folder:
        local: dict[str, Any] = {}
        copies: dict[str, Path] = {}
        for name, url in remote.items():
            if url not in copies:
                place = Path(folder, name)
                place.mkdir()
                copies[url] = fetch(url, place)
            local[name] = copies[url]
        try:
            yield replace(files, **local)
        except (ValueError, OSError) as error:
            text = str(error)
            for name, path in local.items():
                text = text.replace(str(path), remote[name])
            raise type(error)(text) from error
