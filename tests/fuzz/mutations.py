"""Changes of a file that know nothing of its format."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from random import Random
from typing import TypeVar

T = TypeVar("T")

TEXTS = (
    "0", "-1", "1", "-0", "1.5", "255", "256", "65535", "65536", "2147483647", "2147483648", "4294967295", "4294967296",
    "9223372036854775807", "9223372036854775808", "18446744073709551616", "1e308", "-1e308", "1e39", "1e999", "5e-324",
    "nan", "NaN", "inf", "-inf", "Infinity", "", " ", "0x10", "1_000", "+5", "1e", "--1", "٣", "1,5", "None", "null",
    "true", "a", "\x00", "ünï", "9" * 400, "9" * 5000, "x" * 3000,
)  # fmt: skip
BYTES = (0, 1, 0x0A, 0x0D, 0x20, 0x22, 0x27, 0x2C, 0x2F, 0x30, 0x5B, 0x7B, 0x7F, 0x80, 0xC3, 0xFE, 0xFF)
NUMBERS = (0, 1, -1, 2, 3, 7, 255, 256, 32767, 32768, 65535, 65536, 1 << 20, 1 << 24, 1 << 26, (1 << 31) - 1, 1 << 31,
           (1 << 32) - 1, 1 << 32, 1 << 40, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)  # fmt: skip
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-320, 1e30, 1e300, -1e300, float("inf"), float("-inf"), float("nan"))
LARGEST = 1 << 22  # bytes of a file that is made
_ASCII_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")


def mutate_bytes(data: bytes, others: Sequence[bytes], rng: Random, num: int | None = None) -> bytes:
    """Change a file in one to some places.

    Args:
        data: The file.
        others: Other files of its format, for splices.
        rng: Source of all choices.
        num: How many changes; a random number, mostly small, if not given.
    """
    for _ in range(num or rng.choice((1, 1, 1, 2, 3, 8))):
        if rng.random() < 0.1 and others:
            data = _splice(data, rng.choice(others), rng)
        else:
            data = rng.choice(_CHANGES)(data, rng)
    return data[:LARGEST]


def place(data: bytes, rng: Random) -> int:
    """A position in a file, more often near its ends, where most headers are."""
    if not data:
        return 0
    reach = min(len(data), rng.choice((16, 64, 512, len(data), len(data))))
    offset = rng.randrange(reach)
    return offset if rng.random() < 0.5 else len(data) - 1 - offset


def pick(choices: Sequence[T], rng: Random) -> T:
    """One of several values."""
    return choices[rng.randrange(len(choices))]


def word(rng: Random) -> bytes:
    """An extreme number as 2, 4 or 8 bytes in either order."""
    order = rng.choice("<>")
    if rng.random() < 0.2:
        kind = rng.choice("fd")
        value = rng.choice(FLOATS)
        return struct.pack(order + kind, value if kind == "d" or abs(value) < 1e38 or abs(value) > 1e308 else 1e38)
    size = rng.choice((2, 4, 8))
    return (rng.choice(NUMBERS) % (1 << 8 * size)).to_bytes(size, "little" if order == "<" else "big")


def _flip(data: bytes, rng: Random) -> bytes:
    at = place(data, rng)
    return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :] if data else data


def _replace(data: bytes, rng: Random) -> bytes:
    at = place(data, rng)
    return data[:at] + bytes([rng.choice(BYTES)]) + data[at + 1 :]


def _noise(data: bytes, rng: Random) -> bytes:
    at, num = place(data, rng), rng.choice((1, 2, 4, 16))
    return data[:at] + rng.randbytes(num) + data[at + num :]


def _cut(data: bytes, rng: Random) -> bytes:
    return data[: place(data, rng)]


def _insert(data: bytes, rng: Random) -> bytes:
    at = place(data, rng)
    what = rng.choice((rng.randbytes(rng.choice((1, 4, 100))), bytes(rng.choice((1, 1000))), b"\xff" * 64))
    return data[:at] + what + data[at:]


def _delete(data: bytes, rng: Random) -> bytes:
    at = place(data, rng)
    return data[:at] + data[at + rng.choice((1, 2, 4, 8, 100, 1000)) :]


def _double(data: bytes, rng: Random) -> bytes:
    start, stop = sorted((place(data, rng), place(data, rng)))
    times = rng.choice((1, 1, 2, 30))
    return data[:stop] + data[start:stop][:10_000] * times + data[stop:]


def _number(data: bytes, rng: Random) -> bytes:
    found = [match.span() for match in _ASCII_NUMBER.finditer(data)]
    if not found:
        return _word(data, rng)
    start, stop = found[rng.randrange(min(len(found), rng.choice((4, 20, len(found)))))]
    return data[:start] + rng.choice(TEXTS).encode() + data[stop:]


def _word(data: bytes, rng: Random) -> bytes:
    at, what = place(data, rng), word(rng)
    at -= at % len(what) if rng.random() < 0.7 else 0
    return data[:at] + what + data[at + len(what) :]


def _splice(data: bytes, other: bytes, rng: Random) -> bytes:
    if rng.random() < 0.5:
        return data[: place(data, rng)] + other[place(other, rng) :]
    at, start = place(data, rng), place(other, rng)
    num = rng.choice((8, 64, 1000))
    return data[:at] + other[start : start + num] + data[at + num :]


_CHANGES: tuple[Callable[[bytes, Random], bytes], ...] = (
    _flip, _flip, _replace, _replace, _noise, _cut, _insert, _delete, _double, _number, _number, _word, _word, _word,
)  # fmt: skip
