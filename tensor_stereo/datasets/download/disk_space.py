"""Errors of full disks that say which disk and what to do."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_FULL = (errno.ENOSPC, errno.EDQUOT)


def check_free_space(folder: Path, num_bytes: int, *, purpose: str) -> None:
    """Raise unless ``num_bytes`` fit on the disk of ``folder``.

    Args:
        folder: an existing folder.
        num_bytes: what is about to be written.
        purpose: start of the message, as "unpacking a.zip".

    Raises:
        OSError: if the disk has less; the message names folder and both numbers.

    >>> check_free_space(Path("."), 0, purpose="writing nothing")
    """
    free = shutil.disk_usage(folder).free
    if free < num_bytes:
        raise OSError(f"{purpose} needs {num_bytes:,} bytes, but the disk of {folder} has only {free:,} left")


@contextmanager
def explain_full_disk(folder: Path) -> Iterator[None]:
    """Turn the error of a disk that fills up in the middle of writing into one that names ``folder``.

    >>> with explain_full_disk(Path("data")):
    ...     raise OSError(errno.ENOSPC, "No space left on device")
    Traceback (most recent call last):
    ...
    OSError: the disk of data is full; with more space the same command goes on from what is there
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _FULL:
            raise
        raise OSError(
            f"the disk of {folder} is full; with more space the same command goes on from what is there"
        ) from error
