"""HTTP downloads that go on where they stopped, with the standard library alone.

A partial file ``NAME.part`` has its source beside it, ``NAME.part.json``. The rest is asked for with ``Range`` and
``If-Range`` (RFC 9110, sections 13.1.5 and 14.2) and appended only if the answer still describes the same file.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from http.client import HTTPException, HTTPResponse
from pathlib import Path
from typing import TypeAlias
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

from tensor_stereo.datasets.download.disk_space import check_free_space, explain_full_disk

ByteProgress: TypeAlias = Callable[[int, int | None], None]  # bytes done, bytes in all if the server tells

_PAUSES_S = (1.0, 5.0, 25.0)  # before the second try and the following ones
_TIMEOUT_S = 60.0
_CHUNK_BYTES = 1 << 18
_CONTENT_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+)")


class _Interrupted(Exception):  # noqa: N818 (no error yet: the next try may succeed)
    """The connection broke or the server was busy."""


@dataclass(frozen=True)
class _Source:
    """What tells one state of a remote file from another."""

    url: str
    etag: str | None
    last_modified: str | None
    size: int | None


def fetch_part(url: str, part: Path, *, progress: ByteProgress) -> None:
    """Fetch all of ``url`` into ``part``, going on from what is there of it.

    What is there is thrown away if its source is unknown or has changed, and if the server knows no ranges.

    Args:
        url: http or https.
        part: the partial file, in an existing folder; it is left in place, complete on return.
        progress: called with the bytes that are there and those in all, after each block.

    Raises:
        OSError: if the server refuses (the message names URL and status), the connection breaks again and again without
            a new byte (the message says that it can be resumed), or the disk is full.
    """
    pauses = iter(_PAUSES_S)
    while True:
        before = _num_bytes(part)
        try:
            _fetch_rest(url, part, progress)
        except _Interrupted as error:
            done = _num_bytes(part)
            if done > before:
                pauses = iter(_PAUSES_S)
            pause = next(pauses, None)
            if pause is None:
                raise OSError(
                    f"{url}: {error}, also after {len(_PAUSES_S)} more tries. The first {done:,} bytes are kept in "
                    f"{part}; the same command goes on from there"
                ) from error
            time.sleep(pause)
        else:
            return


def discard_part(part: Path) -> None:
    """Remove a partial file and what is known of its source; nothing happens if there is none."""
    part.unlink(missing_ok=True)
    _source_path(part).unlink(missing_ok=True)


def _fetch_rest(url: str, part: Path, progress: ByteProgress) -> None:
    known = _read_source(part, url)
    start = 0 if known is None else _num_bytes(part)
    if known is not None and start == known.size:
        progress(start, start)
        return
    response, start = _open(url, known, start)
    with response, explain_full_disk(part.parent):
        size = _num_bytes_in_all(response)
        if start == 0:
            discard_part(part)
            source = _Source(url, response.headers["ETag"], response.headers["Last-Modified"], size)
            _source_path(part).write_text(json.dumps(asdict(source)), encoding="utf-8")
        if size is not None:
            check_free_space(part.parent, size - start, purpose=f"the rest of {url}")
        _append(response, part, start, size, progress)


def _append(response: HTTPResponse, part: Path, start: int, size: int | None, progress: ByteProgress) -> None:
    done = start
    progress(done, size)
    with part.open("ab") as file:
        while True:
            with _interruptible():
                chunk = response.read(_CHUNK_BYTES)
            if not chunk:
                break
            file.write(chunk)
            done += len(chunk)
            progress(done, size)
    if size is not None and _num_bytes(part) != size:
        raise _Interrupted(f"the connection ended after {done:,} of {size:,} bytes")


def _open(url: str, known: _Source | None, start: int) -> tuple[HTTPResponse, int]:
    """Ask for the bytes from ``start`` on; return the answer and the byte that it begins with, ``start`` or 0."""
    headers = {"User-Agent": "tensor-stereo"}
    validator = None if known is None else _validator(known)
    if known is not None and validator is not None and start > 0:
        ranged = headers | {"Range": f"bytes={start}-"}
        if not validator.startswith("W/"):  # a weak one is not allowed there
            ranged["If-Range"] = validator
        response = _request(url, ranged)
        if _continues(response, known, start):
            return response, start
        if response.status == 200:
            return response, 0
        response.close()
    response = _request(url, headers)
    if response.status != 200:
        response.close()
        raise OSError(f"{url}: expected status 200, the server answered {response.status} {response.reason}")
    return response, 0


def _request(url: str, headers: dict[str, str]) -> HTTPResponse:
    try:
        with _interruptible():
            response: HTTPResponse = urlopen(Request(url, headers=headers), timeout=_TIMEOUT_S)
    except HTTPError as error:
        error.close()
        if error.code == 416 and "Range" in headers:  # the file is shorter than what is there
            return _request(url, {name: value for name, value in headers.items() if name not in ("Range", "If-Range")})
        answer = f"the server answered {error.code} {error.reason}"
        if error.code >= 500 or error.code in (408, 429):
            raise _Interrupted(answer) from error
        raise OSError(f"{url}: {answer}") from error
    return response


def _continues(response: HTTPResponse, known: _Source, start: int) -> bool:
    match = _CONTENT_RANGE.fullmatch(response.headers.get("Content-Range", ""))
    if response.status != 206 or match is None or int(match[1]) != start or known.size not in (None, int(match[2])):
        return False
    found = response.headers["ETag"], response.headers["Last-Modified"]
    return all(new in (None, old) for new, old in zip(found, (known.etag, known.last_modified), strict=True))


def _validator(known: _Source) -> str | None:
    if known.etag is not None and (known.last_modified is None or not known.etag.startswith("W/")):
        return known.etag
    return known.last_modified


@contextmanager
def _interruptible() -> Iterator[None]:
    try:
        yield
    except HTTPError:
        raise
    except (OSError, HTTPException) as error:
        reason = error.reason if isinstance(error, URLError) else error
        raise _Interrupted(f"the connection broke ({reason})") from error


def _num_bytes_in_all(response: HTTPResponse) -> int | None:
    match = _CONTENT_RANGE.fullmatch(response.headers.get("Content-Range", ""))
    text = response.headers.get("Content-Length", "") if match is None else match[2]
    return int(text) if text.isdecimal() else None


def _num_bytes(part: Path) -> int:
    return part.stat().st_size if part.exists() else 0


def _source_path(part: Path) -> Path:
    return part.with_name(f"{part.name}.json")


def _read_source(part: Path, url: str) -> _Source | None:
    """What ``part`` is the beginning of; None if that is unknown, or another address."""
    try:
        source = _Source(**json.loads(_source_path(part).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):  # missing, or cut short when the machine went down
        return None
    return source if source.url == url else None
