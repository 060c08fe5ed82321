"""What the decoders inside OpenCV print, caught so that it becomes an error with the name of the file."""

from __future__ import annotations

import os
import re
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

# What libjpeg and libpng print where samples are missing or wrong, and what they print about padding and metadata.
# Source: jerror.h of libjpeg-turbo (its warnings, JWRN_*), png.h of libpng.
_DAMAGE = re.compile(
    r"libpng error.*|.*premature end .*|.*bad (Huffman|arithmetic) code.*|.*instead of RST.*|"
    r".*[Cc]orrupt JPEG data: found.*|Inconsistent progression sequence.*"
)
_OF_DECODERS = re.compile(
    r"libpng (warning|error): .*|Corrupt JPEG data: .*|Premature end of JPEG .*|Invalid SOS parameters .*|"
    r"Unknown Adobe color transform .*|Inconsistent progression .*|Application transferred too many scanlines|"
    r"Warning: unknown JFIF revision .*|Unsupported marker type .*|\[ *(WARN|ERROR|INFO):\d+@.*"
)
_LOCK = threading.Lock()


def _renew_lock() -> None:
    global _LOCK  # a thread of the parent may have held it when this process was forked
    _LOCK = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_lock)


class DecoderMessages:
    """What was printed while a block ran."""

    damage: str = ""


@contextmanager
def caught_messages() -> Iterator[DecoderMessages]:
    """Catch what native code prints to standard error while the block runs; what is not of a decoder is printed after.

    Standard error is one for the whole process, so blocks of several threads run one after the other.

    Yields:
        An object whose ``damage`` is, after the block, the first message that says that samples are damaged, or empty.
    """
    messages = DecoderMessages()
    with _LOCK, tempfile.TemporaryFile() as file:
        with suppress(OSError, ValueError, AttributeError):
            sys.stderr.flush()
        try:
            before = os.dup(2)
        except OSError:  # there is no standard error
            yield messages
            return
        try:
            os.dup2(file.fileno(), 2)
            yield messages
        finally:
            os.dup2(before, 2)
            os.close(before)
        file.seek(0)
        said = file.read().decode(errors="replace").splitlines()
    found = (_DAMAGE.fullmatch(line.strip()) for line in said)
    messages.damage = next((match[0] for match in found if match), "")
    others = [line for line in said if line.strip() and not _OF_DECODERS.fullmatch(line.strip())]
    if others:
        os.write(2, "".join(f"{line}\n" for line in others).encode())
