"""Files of images -> the samples that they store, and the range that these have. OpenCV does most of the decoding."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tensor_stereo.datasets.decoder_messages import caught_messages
from tensor_stereo.datasets.files import StrPath
from tensor_stereo.datasets.image_size import image_size
from tensor_stereo.datasets.netpbm import MAX_MAXVAL, decode_netpbm, is_netpbm
from tensor_stereo.datasets.structure import PNG_SIGNATURE, damaged_format, significant_bits
from tensor_stereo.datasets.tiff import STARTS, has_white_zero, sample_range, without_orientation

MAX_PIXELS = 1 << 27  # 11585 x 11585


class Stored(NamedTuple):
    """What a file holds.

    Attributes:
        samples: (H, W), or (H, W, C) in the order RGB or RGBA, as they are stored.
        largest: The value of full brightness; None where it may be less than the type of the samples can hold, and the
            file does not say.
        significant_bits: What a PNG of 16 bits says of the bits that its samples had before they were scaled up.
    """

    samples: NDArray[Any]
    largest: int | None
    significant_bits: int | None = None

    def to_view(self) -> Stored:
        """Undo what the writer of a PNG did to samples of fewer bits; other samples stay as they are.

        Source: PNG specification, 3rd edition, section 12.4. Left shift and bit replication are undone. Some writers
        leave the samples as they are, and these are taken so.

        >>> Stored(np.array([[0x1231]], dtype=np.uint16), None, 12).to_view()
        Stored(samples=array([[291]], dtype=uint16), largest=4095, significant_bits=None)
        """
        bits = self.significant_bits
        if bits is None or not 0 < bits < 16:  # 16 is what many writers put there, whatever the samples are
            return self
        colors = self.samples if self.samples.ndim == 2 else self.samples[..., :3]
        original = colors >> (16 - bits)
        if np.array_equal(colors, original << (16 - bits)) or np.array_equal(colors, _replicated(original, bits)):
            return Stored(original, 2**bits - 1)
        return Stored(colors, 2**bits - 1 if colors.max() < 2**bits else None)


def decode(path: StrPath) -> Stored:
    """Decode an image file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is empty, truncated, damaged or of an unknown format.
    """
    # imread answers None to a missing and to a damaged file alike, and takes only ASCII paths on some systems
    content = Path(path).read_bytes()
    if not content:
        raise ValueError(f"{path} is empty (0 bytes), expected an image")
    if is_netpbm(content):
        try:
            samples, maxval = decode_netpbm(content)
        except ValueError as error:
            raise ValueError(f"{path} cannot be decoded as an image: {error}") from error
        return Stored(samples, None if maxval == MAX_MAXVAL else maxval)
    damaged = damaged_format(content)
    if damaged is not None:
        raise ValueError(f"{path} cannot be decoded as an image: the {damaged} file is truncated or damaged")
    _check_size(path)
    is_tiff = content.startswith(STARTS)
    samples = _decode_by_opencv(path, without_orientation(content) if is_tiff else content)
    if samples.dtype != np.uint16:
        return Stored(samples, 255)
    if content.startswith(PNG_SIGNATURE):
        return Stored(samples, None, significant_bits(content))
    if is_tiff:
        bits, largest = sample_range(content)
        fill = 16 - bits
        if fill > 0 and not (samples & (2**fill - 1)).any():  # OpenCV shifts samples of 10, 12 and 14 bits up
            samples = samples >> fill
        if has_white_zero(content):
            samples = (2**bits - 1 if largest is None else largest) - samples.astype(np.int64)
            samples = samples.clip(0).astype(np.uint16)
        return Stored(samples, largest)
    return Stored(samples, None)


def _check_size(path: StrPath) -> None:
    """Raise for headers that ask for more memory than any view of a pair needs; OpenCV would take 2**30 pixels."""
    try:
        width, height = image_size(path)
    except ValueError:  # the decoder says it better, and knows more formats
        return
    if width * height > MAX_PIXELS:
        raise ValueError(f"{path} must have at most {MAX_PIXELS} pixels, its header says {width} x {height}")


def _replicated(original: NDArray[Any], bits: int) -> NDArray[Any]:
    """Samples of 16 bits that repeat the given ones of fewer bits from the most significant bit on."""
    filled = np.zeros_like(original)
    for shift in range(16 - bits, -bits, -bits):
        filled |= original << shift if shift >= 0 else original >> -shift
    return filled


def _decode_by_opencv(path: StrPath, content: bytes) -> NDArray[Any]:
    """(H, W), or (H, W, C) in the order RGB or RGBA."""
    encoded = np.frombuffer(content, dtype=np.uint8)
    try:
        with caught_messages() as messages:
            pixels: NDArray[Any] | None = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(f"{path} cannot be decoded as an image: {error}") from error
    if messages.damage:
        raise ValueError(f"{path} cannot be decoded as an image: {messages.damage}")
    if pixels is None:
        raise ValueError(f"{path} cannot be decoded as an image: the format is unknown or the file is damaged")
    if pixels.ndim == 2:
        return pixels
    return pixels[..., [2, 1, 0, 3][: pixels.shape[2]]] if pixels.shape[2] >= 3 else pixels[..., 0]
