"""PGM and PPM files with their own range of samples, which OpenCV scales in some forms and leaves out in others.

Source: the manual pages ppm(5) and pgm(5) of netpbm, https://netpbm.sourceforge.net/doc/.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

_GAP = rb"(?:\s|#[^\n]*\n)+"
_HEADER = re.compile(rb"P([2356])" + 3 * (_GAP + rb"(\d{1,9})") + rb"(?:#[^\n]*\n|\s)")
_COMMENT = re.compile(rb"#[^\n]*")
MAX_MAXVAL = 65535


def is_netpbm(content: bytes) -> bool:
    """Whether a file is a PGM or PPM, in text or in binary.

    >>> is_netpbm(b"P6 1 1 255 abc"), is_netpbm(b"P4 8 1 a")
    (True, False)
    """
    return content[:1] == b"P" and content[1:2] in (b"2", b"3", b"5", b"6")


def decode_netpbm(content: bytes) -> tuple[NDArray[Any], int]:
    r"""Decode a PGM or PPM file.

    Args:
        content: The whole file. Of several images in one file the first is taken.

    Returns:
        The samples as they are stored, (H, W), or (H, W, 3) in the order RGB, uint8 or uint16; and maxval, the value of
        full brightness.

    Raises:
        ValueError: if the header is wrong or samples are missing.

    >>> decode_netpbm(b"P2\n# grey\n3 1\n15\n0 7 15\n")
    (array([[ 0,  7, 15]], dtype=uint8), 15)
    """
    header = _HEADER.match(content)
    if header is None:
        raise ValueError("the header must give width, height and maxval")
    width, height, maxval = (int(number) for number in header.groups()[1:])
    if not width or not height or not 1 <= maxval <= MAX_MAXVAL:
        raise ValueError(f"{width} x {height} samples up to {maxval} are no image")
    shape = (height, width, 3) if header[1] in b"36" else (height, width)
    count = int(np.prod(shape, dtype=object))
    kind = np.dtype(np.uint8 if maxval < 256 else ">u2")
    if header[1] in b"56":
        if len(content) - header.end() < count * kind.itemsize:
            raise ValueError("the file is truncated")
        samples = np.frombuffer(content, dtype=kind, count=count, offset=header.end())
    else:
        words = _COMMENT.sub(b"", content[header.end() :]).split(maxsplit=count)[:count]
        if len(words) < count:
            raise ValueError("the file is truncated")
        numbers = np.array([int(word) for word in words])
        if numbers.min() < 0 or numbers.max() > np.iinfo(kind).max:
            raise ValueError(f"samples must lie in [0, {maxval}]")
        samples = numbers
    return samples.reshape(shape).astype(kind.newbyteorder("=")), maxval
