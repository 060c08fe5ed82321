"""Image files by the letter of their formats, with what encoders do not write."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence


def chunk(kind: bytes, body: bytes) -> bytes:
    """A chunk of a PNG."""
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png16(rows: Sequence[Sequence[int]], significant: bytes | None = None, channels: int = 1) -> bytes:
    """A PNG of 16 bits; a row holds the samples of its pixels one after the other."""
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    header = struct.pack(">IIBBBBB", len(rows[0]) // channels, len(rows), 16, kind, 0, 0, 0)
    body = b"".join(b"\0" + struct.pack(f">{len(row)}H", *row) for row in rows)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + (b"" if significant is None else chunk(b"sBIT", significant))
        + chunk(b"IDAT", zlib.compress(body))
        + chunk(b"IEND", b"")
    )


def tiff(
    samples: Sequence[int],
    bits: int,
    *,
    order: str = "<",
    big: bool = False,
    tags: dict[int, int] | None = None,
    deflate: bool = False,
) -> bytes:
    """A grey TIFF or BigTIFF of one row of 16-bit samples in the given order of bytes, or of packed ones."""
    if bits == 16:
        body = struct.pack(f"{order}{len(samples)}H", *samples)
    else:
        text = "".join(format(sample, f"0{bits}b") for sample in samples)
        text += "0" * (-len(text) % 8)
        body = int(text, 2).to_bytes(len(text) // 8, "big")
    if deflate:
        body = zlib.compress(body)
    entries = {256: len(samples), 257: 1, 258: bits, 259: 8 if deflate else 1, 262: 1, 273: 0, 277: 1, 278: 1}
    entries |= {279: len(body)} | (tags or {})
    start = 16 if big else 8
    directory = start + (8 + 20 * len(entries) + 8 if big else 2 + 12 * len(entries) + 4)
    entries[273] = directory
    mark = b"II" if order == "<" else b"MM"
    if big:
        head = mark + struct.pack(order + "HHHQ", 43, 8, 0, 16) + struct.pack(order + "Q", len(entries))
        rows = [struct.pack(order + "HHQQ", tag, 16, 1, value) for tag, value in sorted(entries.items())]
    else:
        head = mark + struct.pack(order + "HI", 42, 8) + struct.pack(order + "H", len(entries))
        rows = [struct.pack(order + "HHII", tag, 4, 1, value) for tag, value in sorted(entries.items())]
    return head + b"".join(rows) + bytes(8 if big else 4) + body
