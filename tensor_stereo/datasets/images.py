"""Images, integer disparity maps and occlusion masks as tensors and arrays."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tensor_stereo.datasets.decoding import decode
from tensor_stereo.datasets.files import StrPath, check_gt_scale, check_sample_bits

# mask0nocc.png of MiddEval3 and ETH3D
UNKNOWN, OCCLUDED, VISIBLE = 0, 128, 255


_DARK = 2**14  # samples of 16 bits that stay below it probably have 14 bits or fewer


class SampleRangeWarning(UserWarning):
    """A file stores dark samples of 16 bits and does not say how many of these bits are in use."""


def read_image(path: StrPath, *, sample_bits: int | None = None) -> Tensor:
    """Read an image as it is stored, without the rotation that its metadata may ask for.

    Palettes are expanded and an alpha channel is dropped. The result has 8 bits: a sample v becomes v * 255 / largest,
    rounded to the nearest whole number, half up. The file tells ``largest``: maxval of a PGM or PPM; the bits of a
    TIFF, or its MaxSampleValue if that is 1023, 4095 or another 2**n - 1; the chunk sBIT of a PNG of 16 bits, whose
    scaling by left shift or bit replication is undone, and whose samples are taken as they are if they were not scaled.
    Other samples of 8 bits stay unchanged, and other samples of 16 bits have ``largest`` = 65535.

    Args:
        path: The file, in any format that OpenCV reads (PNG, PPM, PGM, JPEG, TIFF, WebP, BMP, ...).
        sample_bits: Bits in use, 8 to 16, of samples that are stored in 16 bits, where the file does not tell it (nor
            says maxval 65535): ``largest`` = 2**sample_bits - 1. Other files are read as without it.

    Returns:
        (C, H, W) uint8; C = 1 for grey, 3 for colour in the order RGB.

    Warns:
        SampleRangeWarning: if nothing tells the range of samples of 16 bits and the largest one is below 2**14.

    Raises:
        FileNotFoundError: if there is no such file.
        TypeError: if ``sample_bits`` is no integer.
        ValueError: if ``sample_bits`` lies outside of its limits; if the file is empty, truncated, damaged, no image,
            holds other than 8 or 16 bits per channel, or a sample above its range.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "im0.ppm").write_bytes(b"P6 1 1 100 " + bytes([0, 20, 100]))
    ...     read_image(f"{folder}/im0.ppm").flatten()
    tensor([  0,  51, 255], dtype=torch.uint8)
    """
    check_sample_bits(sample_bits)
    samples, largest, _ = decode(path).to_view()
    if samples.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path} must hold 8 or 16 bits per channel, got {samples.dtype}")
    samples = samples if samples.ndim == 2 else samples[..., :3]
    brightest = int(samples.max())
    if largest is None and sample_bits is not None:
        largest = 2**sample_bits - 1
        if brightest > largest:
            raise ValueError(
                f"{path} must hold samples of at most {largest} for sample_bits (--sample-bits) {sample_bits}, "
                f"found {brightest}"
            )
    elif largest is None:
        largest = 65535
        if 0 < brightest < _DARK:
            warnings.warn(
                f"{path} holds samples of 16 bits, none above {brightest}, and does not tell their range; if fewer "
                "bits are in use, the image is too dark: give sample_bits (--sample-bits)",
                SampleRangeWarning,
                stacklevel=2,
            )
    if brightest > largest:
        raise ValueError(f"{path} must hold samples of at most {largest}, as it says itself, found {brightest}")
    if largest != 255:
        samples = (samples.astype(np.uint32) * 510 + largest) // (2 * largest)
    channels = samples[None] if samples.ndim == 2 else samples.transpose(2, 0, 1)
    return torch.from_numpy(np.ascontiguousarray(channels, dtype=np.uint8))


def write_image(path: StrPath, image: Tensor) -> None:
    """Write an image that :func:`read_image` reads back unchanged.

    Args:
        path: ends in ``.png``, or another lossless format of OpenCV's.
        image: (C, H, W) uint8; C = 1 for grey, 3 for RGB.

    Raises:
        OSError: if it cannot be written.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_image(f"{folder}/a.png", torch.tensor([[[1, 2]]], dtype=torch.uint8))
    ...     read_image(f"{folder}/a.png")
    tensor([[[1, 2]]], dtype=torch.uint8)
    """
    pixels = image.numpy(force=True).transpose(1, 2, 0)[..., ::-1]  # RGB -> BGR
    encoded = cv2.imencode(Path(path).suffix.casefold(), np.ascontiguousarray(pixels))[1]
    Path(path).write_bytes(encoded.tobytes())


def read_disparity_png(path: StrPath, scale: float) -> NDArray[np.float32]:
    """Read an 8-bit or 16-bit grey disparity map (PNG or PGM); 0 means unknown.

    Args:
        path: the map of Middlebury 2001-2006 (8 bits) or KITTI (16 bits). Three equal channels count as grey.
        scale: stored value / scale = disparity in px, e.g. 3 for Middlebury 2005 in third size, 256 for KITTI.

    Returns:
        (H, W) float32 in px, NaN where unknown.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is empty, damaged, coloured or no integer map, if ``scale`` is not positive, or if it exceeds
            what the map's bits can store (KITTI's 16-bit map saved again as 8-bit).

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "disp2.pgm").write_bytes(b"P5 3 1 255 " + bytes([0, 4, 9]))
    ...     read_disparity_png(f"{folder}/disp2.pgm", 4)
    array([[ nan, 1.  , 2.25]], dtype=float32)
    """
    check_gt_scale(scale)
    stored = decode_grey(path)
    if stored.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path} must be an 8-bit or 16-bit disparity map, got {stored.dtype}")
    largest = int(np.iinfo(stored.dtype).max)
    if scale > largest:
        raise ValueError(
            f"{path} must store more than {stored.itemsize * 8} bits for scale {scale:g}: 1 px exceeds {largest}"
        )
    disparity = stored.astype(np.float64) / scale
    disparity[stored == 0] = np.nan
    return disparity.astype(np.float32)


def read_occlusion_mask(path: StrPath) -> NDArray[np.bool_]:
    """Read a ``mask0nocc.png``: 255 visible in both views, 128 occluded in view 1, 0 ground truth unknown.

    Returns:
        (H, W) bool, True where occluded; False where visible and where unknown.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is empty, damaged, coloured, or holds other values.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "mask0nocc.pgm").write_bytes(b"P5 3 1 255 " + bytes([0, 128, 255]))
    ...     read_occlusion_mask(f"{folder}/mask0nocc.pgm")
    array([[False,  True, False]])
    """
    stored = decode_grey(path)
    others = np.setdiff1d(stored, (UNKNOWN, OCCLUDED, VISIBLE))
    if len(others):
        raise ValueError(f"{path} must hold only 0, 128 and 255, found {others[:5].tolist()}")
    occluded: NDArray[np.bool_] = stored == OCCLUDED
    return occluded


def read_nonzero_mask(path: StrPath) -> NDArray[np.bool_]:
    """Read a mask that is not 0 where a pixel is occluded, as of FlyingThings3D's subset.

    Returns:
        (H, W) bool.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is empty, damaged or coloured.
    """
    occluded: NDArray[np.bool_] = decode_grey(path) != 0
    return occluded


def read_sintel_disparity(path: StrPath) -> NDArray[np.float32]:
    """Read a disparity map of Sintel stereo: 4 R + G / 64 px in an 8-bit RGB image, known everywhere to 1/64 px.

    Returns:
        (H, W) float32 in px.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is empty, damaged, or no 8-bit colour image.
    """
    pixels = decode(path).samples
    if pixels.ndim != 3 or pixels.dtype != np.uint8:
        raise ValueError(f"{path} must be an 8-bit RGB image, got {pixels.dtype} of shape {pixels.shape}")
    red, green = pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32)
    return (4 * red + green / 64).astype(np.float32)


def read_sintel_occlusion(path: StrPath) -> NDArray[np.bool_]:
    """Read what Sintel's view 1 does not see: occluded pixels, and those out of its frame if that map lies beside.

    Returns:
        (H, W) bool.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a map is empty, damaged or of several channels, or both differ in size.
    """
    path = Path(path)
    beside = path.parents[2] / "outofframe" / path.parent.name / path.name
    maps = [decode(file).samples for file in (path, beside) if file == path or file.is_file()]
    for file, values in zip((path, beside), maps, strict=False):
        if values.shape != maps[0].shape or values.ndim != 2:
            raise ValueError(f"{file} must be a map (H, W) of one channel, got shape {values.shape}")
    hidden: NDArray[np.bool_] = np.any([values != 0 for values in maps], axis=0)
    return hidden


def decode_grey(path: StrPath) -> NDArray[Any]:
    """(H, W) stored values of a one-channel image, whatever their range."""
    samples = decode(path).samples
    if samples.ndim == 2:
        return samples
    if (samples[..., :3] != samples[..., :1]).any():
        raise ValueError(f"{path} must be grey, got an image with {samples.shape[2]} different channels")
    return np.ascontiguousarray(samples[..., 0])
