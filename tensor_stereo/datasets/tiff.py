"""The first directory of a TIFF file: size, bits and where the samples lie. OpenCV tells none of it.

Source: TIFF 6.0 (Adobe, 1992), sections 2 and 8, and the layout of BigTIFF in libtiff's documentation.
"""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from typing import BinaryIO, TypeAlias

Tags: TypeAlias = dict[int, tuple[int, ...]]

STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
WIDTH, HEIGHT, BITS, COMPRESSION, MAX_SAMPLE = 256, 257, 258, 259, 281
_PLACES = ((273, 279), (324, 325))  # offsets and byte counts of strips, or of tiles
_DEFLATE = (8, 32946)
_CODES = {1: "B", 3: "H", 4: "I", 16: "Q"}  # types of whole numbers


def read_tags(file: BinaryIO) -> Tags:
    r"""Read the whole numbers of the first directory.

    Args:
        file: An open TIFF or BigTIFF file.

    Raises:
        ValueError: if it is none, or ends before its directory does.

    >>> read_tags(BytesIO(b"II*\0" + struct.pack("<IHHHIII", 8, 1, 256, 3, 1, 7, 0)))
    {256: (7,)}
    """
    start = file.read(16)
    if not start.startswith(STARTS):
        raise ValueError("it starts like no TIFF file")
    size = file.seek(0, 2)
    order, is_big = "<" if start[:1] == b"I" else ">", b"+" in start[:4]
    counts, entry_format, inline = ("Q", "HHQ8s", 8) if is_big else ("H", "HHI4s", 4)

    def take(offset: int, num_bytes: int) -> bytes:
        if offset + num_bytes > size:
            raise ValueError("it ends before its directory does")
        file.seek(offset)
        return file.read(num_bytes)

    if len(start) < 2 * inline:
        raise ValueError("it ends before its directory does")
    (place,) = struct.unpack_from(order + ("Q" if is_big else "I"), start, 8 if is_big else 4)
    (num_entries,) = struct.unpack(order + counts, take(place, struct.calcsize(counts)))
    width = struct.calcsize("<" + entry_format)
    entries = take(place + struct.calcsize(counts), num_entries * width)
    tags: Tags = {}
    for tag, kind, count, value in struct.iter_unpack(order + entry_format, entries):
        code = _CODES.get(kind)
        if code is None:
            continue
        num_bytes = count * struct.calcsize(code)
        if num_bytes > inline:
            (offset,) = struct.unpack(order + ("Q" if is_big else "I"), value)
            value = take(offset, num_bytes)
        tags[tag] = struct.unpack_from(f"{order}{count}{code}", value)
    return tags


def tiff_size(file: BinaryIO) -> tuple[int, int]:
    """(width, height) in px of the first image.

    Raises:
        ValueError: if the file is damaged.
    """
    tags = read_tags(file)
    try:
        return tags[WIDTH][0], tags[HEIGHT][0]
    except (KeyError, IndexError):
        raise ValueError("its directory gives no size") from None


def is_whole_tiff(content: bytes) -> bool:
    """Whether a file holds all strips or tiles of its first image, and those that zlib packed can be unpacked.

    libtiff would fill in what it cannot read, and OpenCV would not say so.
    """
    try:
        tags = read_tags(BytesIO(content))
    except ValueError:
        return False
    places = [(tags[offsets], tags[counts]) for offsets, counts in _PLACES if {offsets, counts} <= tags.keys()]
    for offset, count in (place for pair in places for place in zip(*pair, strict=False)):
        if offset + count > len(content):
            return False
        if tags.get(COMPRESSION, (1,))[0] in _DEFLATE:
            try:
                zlib.decompress(memoryview(content)[offset : offset + count])
            except zlib.error:
                return False
    return True


def sample_range(content: bytes) -> tuple[int, int | None]:
    """Bits of a sample, and the largest value that it may have, None where the file does not say.

    The specification calls MaxSampleValue a statistic. So only a value such as 1023 or 4095, all bits of a smaller
    range set, is taken for the range.
    """
    tags = read_tags(BytesIO(content))
    bits = max(tags.get(BITS) or (1,))
    if bits < 16:
        return bits, 2**bits - 1
    largest = set(tags.get(MAX_SAMPLE, ()))
    known = largest.pop() if len(largest) == 1 else 0
    return bits, known if 255 <= known < 65535 and known & (known + 1) == 0 else None
