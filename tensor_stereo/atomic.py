"""Files that appear whole or not at all. Imports no torch."""

from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

_MAX_NAME_BYTES = 255  # of the usual file systems
_NOT_OFFERED = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Write a temporary file in the same folder, which takes the place of ``path`` when the block ends well.

    Contents and name are on disk when this returns, as far as the file system can tell. If the block raises, ``path``
    is what it was before.

    Args:
        path: file to make or replace; its folder exists.

    Yields:
        The path to write to, whose name begins with a dot and ends like ``path``.

    Raises:
        OSError: if it cannot be written.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with whole_file(Path(folder, "a.txt")) as part:
    ...         _ = part.write_text("all of it")
    ...     [entry.name for entry in Path(folder).iterdir()]
    ['a.txt']
    """
    own = f"{os.getpid()}-{os.urandom(4).hex()}"  # two nodes, or containers, may have processes of one number
    part = path.with_name(f".{own}.{path.name}")
    if len(os.fsencode(part.name)) > _MAX_NAME_BYTES:
        part = path.with_name(f".{own}.{hashlib.sha256(os.fsencode(path.name)).hexdigest()}{path.suffix}")
    try:
        yield part
        with part.open("r+b") as file:
            flush_file(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    _flush_rename(path.parent)


def flush_file(descriptor: int) -> None:
    """Wait until what was written to an open file is on disk, where the file system offers that.

    Raises:
        OSError: if the data cannot be written. A file system without this call, as of some network mounts, is no error.
    """
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NOT_OFFERED:
            raise


def append_line(line: bytes, file: IO[bytes]) -> None:
    """Add a line that is on disk when this returns, or is not there.

    Args:
        line: Without its line break.
        file: Opened for appending, without a buffer.

    Raises:
        OSError: if it cannot be written.
    """
    end = os.fstat(file.fileno()).st_size
    try:
        if file.write(line + b"\n") != len(line) + 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), file.name)
        flush_file(file.fileno())
    except OSError:
        file.truncate(end)
        raise


def drop_torn_line(file: IO[bytes], path: Path) -> None:
    """Cut off the last line of a file if the end of its process has torn it.

    Args:
        file: Opened for appending, without a buffer.
        path: Its path.
    """
    file.truncate(path.read_bytes().rfind(b"\n") + 1)


def _flush_rename(folder: Path) -> None:
    """Ask for the rename itself to be on disk. It has been done, so that nothing is wrong if this fails."""
    with suppress(OSError):  # Windows opens no folder, some network mounts flush none
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
