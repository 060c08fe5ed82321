"""Size of an image from its header alone, so that a folder of pairs is listed without decoding one."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

from tensor_stereo.datasets.files import StrPath
from tensor_stereo.datasets.structure import JPEG_START
from tensor_stereo.datasets.tiff import STARTS, tiff_size

_PNG_START = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"  # W3C PNG, sections 5.2 and 11.2.1: IHDR comes first
_PNM_HEADER = re.compile(rb"P[1-6](?:\s+(?:#[^\n]*\n\s*)*)(\d{1,9})(?:\s+(?:#[^\n]*\n\s*)*)(\d{1,9})\s")
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
    if start.startswith(b"RIFF") and start[8:12] == b"WEBP":
        return _webp_size(path, start)
    if start.startswith((JPEG_START, b"BM")):
        return _size_by_pillow(path, start)
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


def _size_by_pillow(path: Path, start: bytes) -> tuple[int, int]:
    """The size that a file's own plug-in of Pillow reads.

    ``Image.open`` would warn of large images, which is no matter before decoding, and of damaged additions to JPEG.
    """
    from PIL.BmpImagePlugin import BmpImageFile
    from PIL.JpegImagePlugin import JpegImageFile

    kinds: dict[bytes, Any] = {b"\xff\xd8": JpegImageFile, b"BM": BmpImageFile}
    try:
        with kinds[start[:2]](path) as image:
            width, height = image.size
            return int(width), int(height)
    except FileNotFoundError:
        raise
    except Exception as error:  # damaged headers raise anything, struct.error and IndexError among it
        raise ValueError(f"{path} is no readable image, its header is damaged: {error}") from error
