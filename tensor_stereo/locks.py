"""Locks on open files, which their process loses when it closes them or ends, whatever ends it."""

from __future__ import annotations

import errno
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

_WAIT_SECONDS = 0.05
_LOCKED_BYTE = 1 << 30  # beyond the contents, which others may read on Windows too


def lock(file: IO[Any], *, wait: bool = False) -> bool:
    """Lock an open file for this process alone, until it is closed.

    Args:
        file: The file, opened for writing.
        wait: Whether to wait for another process that holds it.

    Returns:
        Whether the lock is held; False if another process has it.

    Raises:
        OSError: If the file system offers no locks.
    """
    while True:
        try:
            _try_lock(file)
        except OSError as error:
            if error.errno not in (errno.EACCES, errno.EAGAIN, errno.EDEADLK):
                reason = f"the file system of {file.name} offers no locks: {error.strerror}"
                raise OSError(error.errno, reason) from error
            if not wait:
                return False
            time.sleep(_WAIT_SECONDS)
        else:
            return True


@contextmanager
def hold(path: Path) -> Iterator[None]:
    """Wait for the lock on a file, which is made, and hold it for as long as the block runs."""
    with path.open("w") as file:
        lock(file, wait=True)
        yield


def is_held(path: Path) -> bool:
    """Whether another process holds the lock on a file; False of one that does not exist."""
    if not path.exists():
        return False
    with path.open("r+") as file:
        return not lock(file)


if sys.platform == "win32":
    import msvcrt

    def _try_lock(file: IO[Any]) -> None:
        file.seek(_LOCKED_BYTE)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)

else:
    import fcntl

    def _try_lock(file: IO[Any]) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
