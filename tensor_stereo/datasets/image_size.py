"""Size of an image from its header alone, so that a folder of pairs is listed without decoding one."""

from __future__ import annotations

import re
import struct
from pathlib import Path

from tensor_stereo.datasets.files import StrPath

_PNG_START = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"  # W3C PNG, sections 5.2 and 11.2.1: IHDR comes first
_PNM_HEADER = re.compile(rb"P[1-6](?:\s+(?:#[^\n]*\n\s*)*)(\d{1,9})(?:\s+(?:#[^\n]*\n\s*)*)(\d{1,9})\s")
_HEADER_BYTES = 1024  # netpbm headers may hold comments


def image_size(path: StrPath) -> tuple[int, int]:
    """Return (width, height) in px of a PNG, PPM, PGM or PBM file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is empty or starts like none of these formats.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "im2.ppm").write_bytes(b"P6 450 375 255 ")
    ...     image_size(f"{folder}/im2.ppm")
    (450, 375)
    """
    path = Path(path)
    with path.open("rb") as file:
        start = file.read(_HEADER_BYTES)
    if not start:
        raise ValueError(f"{path} is empty (0 bytes), expected an image")
    if start.startswith(_PNG_START) and len(start) >= 24:
        width, height = struct.unpack(">II", start[16:24])
        return width, height
    header = _PNM_HEADER.match(start)
    if header is None:
        raise ValueError(f"{path} is no readable PNG, PPM, PGM or PBM file, it starts with {start[:16]!r}")
    return int(header[1]), int(header[2])
