"""The first directory of a TIFF file: size, bits and where the samples lie. OpenCV tells none of it.

Source: TIFF 6.0 (Adobe, 1992), sections 2 and 8, and the layout of BigTIFF in libtiff's documentation.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import BinaryIO, NamedTuple, TypeAlias

Tags: TypeAlias = dict[int, tuple[int, ...]]

STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC, ORIENTATION, MAX_SAMPLE = 256, 257, 258, 259, 262, 274, 281
_PLACES = ((273, 279), (324, 325))  # offsets and byte counts of strips, or of tiles
_DEFLATE = (8, 32946)
_CODES = {1: "B", 3: "H", 4: "I", 16: "Q"}  # types of whole numbers


class _Entry(NamedTuple):
    """One tag of a directory: where its value stands in the file if it fits there, and its whole numbers."""

    tag: int
    place: int
    form: str  # of one number, for struct
    numbers: tuple[int, ...]


def read_tags(file: BinaryIO) -> Tags:
    r"""Read the whole numbers of the first directory.

    Args:
        file: An open TIFF or BigTIFF file.

    Raises:
        ValueError: if it is none, or ends before its directory does.

    >>> read_tags(BytesIO(b"II*\0" + struct.pack("<IHHHIII", 8, 1, 256, 3, 1, 7, 0)))
    {256: (7,)}
    """
    return {entry.tag: entry.numbers for entry in _read_entries(file)}


def _read_entries(file: BinaryIO) -> Iterator[_Entry]:
    start = file.read(16)
    if not start.startswith(STARTS):
        raise ValueError("it starts like no TIFF file")
    size = file.seek(0, 2)
    order, is_big = "<" if start[:1] == b"I" else ">", b"+" in start[:4]
    number, counts, rest, inline = ("Q", "Q", "HHQ", 8) if is_big else ("I", "H", "HHI", 4)

    def take(offset: int, num_bytes: int) -> bytes:
        if offset + num_bytes > size:
            raise ValueError("it ends before its directory does")
        file.seek(offset)
        return file.read(num_bytes)

    if len(start) < 2 * inline:
        raise ValueError("it ends before its directory does")
    (place,) = struct.unpack_from(order + number, start, inline)
    (num_entries,) = struct.unpack(order + counts, take(place, struct.calcsize(counts)))
    place += struct.calcsize(counts)
    head = struct.calcsize("<" + rest)
    entries = take(place, num_entries * (head + inline))
    for k in range(num_entries):
        first = k * (head + inline)
        tag, kind, count = struct.unpack_from(order + rest, entries, first)
        code = _CODES.get(kind)
        if code is None:
            continue
        value, num_bytes = entries[first + head : first + head + inline], count * struct.calcsize(code)
        if num_bytes > inline:
            value = take(struct.unpack(order + number, value)[0], num_bytes)
        yield _Entry(tag, place + first + head, order + code, struct.unpack_from(f"{order}{count}{code}", value))


def without_orientation(content: bytes) -> bytes:
    """The file with the orientation in which its image is stored, which OpenCV would turn as the file asks for.

    Raises:
        ValueError: if the file is damaged.
    """
    for entry in _read_entries(BytesIO(content)):
        if entry.tag == ORIENTATION and entry.numbers != (1,):
            stop = entry.place + struct.calcsize(entry.form)
            return content[: entry.place] + struct.pack(entry.form, 1) + content[stop:]
    return content


def has_white_zero(content: bytes) -> bool:
    """Whether 0 is white: OpenCV turns such samples over if they have 8 bits, and leaves those of 16 bits alone."""
    return read_tags(BytesIO(content)).get(PHOTOMETRIC, (1,))[0] == 0


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
