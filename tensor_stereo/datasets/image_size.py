"""Size of an image from its header alone, so that a folder of pairs is listed without decoding one."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import IO

from tensor_stereo.datasets.files import StrPath
from tensor_stereo.datasets.structure import JPEG_START
from tensor_stereo.datasets.tiff import STARTS, tiff_size

_PNG_START = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"  # W3C PNG, sections 5.2 and 11.2.1: IHDR comes first
_PNM_HEADER = re.compile(rb"P[1-6](?:\s+(?:#[^\n]*\n\s*)*)(\d{1,9})(?:\s+(?:#[^\n]*\n\s*)*)(\d{1,9})\s")
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0 to SOF15 without tables and extensions
_HEADER_BYTES = 1024  # netpbm headers may hold comments


def image_size(path: StrPath) -> tuple[int, int]:
    """Return (width, height) in px of a PNG, PPM, PGM, PBM, TIFF, JPEG, WebP or BMP file.

    It is the size of the stored image, which metadata may ask to rotate. Whether the file is whole is not looked at.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is empty, starts like none of these formats, or its header is damaged.

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
        if start.startswith(STARTS):
            file.seek(0)
            try:
                return tiff_size(file)
            except ValueError as error:
                raise ValueError(f"{path} is no readable TIFF file: {error}") from error
        if start.startswith(JPEG_START):
            return _jpeg_size(path, file)
    if start.startswith(b"RIFF") and start[8:12] == b"WEBP":
        return _webp_size(path, start)
    if start.startswith(b"BM"):
        return _bmp_size(path, start)
    header = _PNM_HEADER.match(start)
    if header is None:
        formats = "PNG, PPM, PGM, PBM, TIFF, JPEG, WebP or BMP"
        raise ValueError(f"{path} is no readable {formats} file, it starts with {start[:16]!r}")
    return int(header[1]), int(header[2])


def _webp_size(path: Path, start: bytes) -> tuple[int, int]:
    """By RFC 9649, sections 2.5 to 2.7 and 3.4, and RFC 6386, section 9.1; Pillow would decode the whole file."""
    kind, body = start[12:16], start[20:30]
    if kind == b"VP8X" and len(body) == 10:
        return int.from_bytes(body[4:7], "little") + 1, int.from_bytes(body[7:10], "little") + 1
    if kind == b"VP8L" and len(body) >= 5 and body[0] == 0x2F:
        bits = int.from_bytes(body[1:5], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8 " and len(body) == 10 and body[3:6] == b"\x9d\x01\x2a":
        width, height = struct.unpack("<HH", body[6:10])
        return width & 0x3FFF, height & 0x3FFF
    raise ValueError(f"{path} is no readable image, its WebP header is damaged")


def _jpeg_size(path: Path, file: IO[bytes]) -> tuple[int, int]:
    """By the header of the frame: ITU-T T.81, sections B.1.1 and B.2.2. Pillow would warn of damaged metadata."""
    place = 2
    while True:
        file.seek(place)
        head = file.read(9)
        if len(head) < 9 or head[0] != 0xFF:
            raise ValueError(f"{path} is no readable image, its JPEG header is damaged")
        if head[1] in _JPEG_FRAMES:
            height, width = struct.unpack(">HH", head[5:9])
            return width, height
        place += 1 if head[1] == 0xFF else 2 + int.from_bytes(head[2:4])  # FF before a marker is padding


def _bmp_size(path: Path, start: bytes) -> tuple[int, int]:
    """By Microsoft's BITMAPINFOHEADER; the height of bitmaps that begin at the top is negative."""
    if len(start) < 26 or int.from_bytes(start[14:18], "little") < 40:
        raise ValueError(f"{path} is no readable image, its BMP header is damaged")
    width, height = struct.unpack("<ii", start[18:26])
    return width, abs(height)
