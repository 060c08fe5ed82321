"""Images, integer disparity maps and occlusion masks, decoded by OpenCV."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tensor_stereo.datasets.files import StrPath, check_gt_scale

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

# mask0nocc.png of MiddEval3 and ETH3D
UNKNOWN, OCCLUDED, VISIBLE = 0, 128, 255


def read_image(path: StrPath) -> Tensor:
    """Read an image as it is stored, without the rotation that its metadata may ask for.

    Palettes are expanded and an alpha channel is dropped. 16 bits become 8 by rounding value / 257, which takes 65535
    to 255 and 257 times an 8-bit value back to it.

    Args:
        path: any format that OpenCV reads (PNG, PPM, PGM, JPEG, TIFF, ...).

    Returns:
        (C, H, W) uint8; C = 1 for grey, 3 for colour in the order RGB.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is empty, damaged, no image, or holds other than 8 or 16 bits per channel.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "im0.ppm").write_bytes(b"P6 1 1 255 " + bytes([10, 20, 30]))
    ...     read_image(f"{folder}/im0.ppm").flatten()
    tensor([10, 20, 30], dtype=torch.uint8)
    """
    pixels = _decode(path)
    if pixels.dtype == np.uint16:
        pixels = (pixels.astype(np.uint32) + 128) // 257
    elif pixels.dtype != np.uint8:
        raise ValueError(f"{path} must hold 8 or 16 bits per channel, got {pixels.dtype}")
    channels = pixels[None] if pixels.ndim == 2 else pixels[..., 2::-1].transpose(2, 0, 1)  # BGR(A) -> RGB
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
    encoded = cv2.imencode(Path(path).suffix, np.ascontiguousarray(pixels))[1]
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
    stored = _decode_grey(path)
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
    stored = _decode_grey(path)
    others = np.setdiff1d(stored, (UNKNOWN, OCCLUDED, VISIBLE))
    if len(others):
        raise ValueError(f"{path} must hold only 0, 128 and 255, found {others[:5].tolist()}")
    occluded: NDArray[np.bool_] = stored == OCCLUDED
    return occluded


def read_sintel_disparity(path: StrPath) -> NDArray[np.float32]:
    """Read a disparity map of Sintel stereo: 4 R + G / 64 px in an 8-bit RGB image, known everywhere to 1/64 px.

    Returns:
        (H, W) float32 in px.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is empty, damaged, or no 8-bit colour image.
    """
    pixels = _decode(path)
    if pixels.ndim != 3 or pixels.dtype != np.uint8:
        raise ValueError(f"{path} must be an 8-bit RGB image, got {pixels.dtype} of shape {pixels.shape}")
    red, green = pixels[..., 2].astype(np.float32), pixels[..., 1].astype(np.float32)  # decoded as BGR
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
    maps = [_decode(file) for file in (path, beside) if file == path or file.is_file()]
    for file, values in zip((path, beside), maps, strict=False):
        if values.shape != maps[0].shape or values.ndim != 2:
            raise ValueError(f"{file} must be a map (H, W) of one channel, got shape {values.shape}")
    hidden: NDArray[np.bool_] = np.any([values != 0 for values in maps], axis=0)
    return hidden


def _decode_grey(path: StrPath) -> NDArray[Any]:
    """(H, W) stored values of a one-channel image."""
    pixels = _decode(path)
    if pixels.ndim == 2:
        return pixels
    if (pixels[..., :3] != pixels[..., :1]).any():
        raise ValueError(f"{path} must be grey, got an image with {pixels.shape[2]} different channels")
    return np.ascontiguousarray(pixels[..., 0])


def _decode(path: StrPath) -> NDArray[Any]:
    """(H, W) or (H, W, C) stored values, channels as BGR or BGRA."""
    # imread answers None to a missing and to a damaged file alike, and takes only ASCII paths on some systems
    content = Path(path).read_bytes()
    if not content:
        raise ValueError(f"{path} is empty (0 bytes), expected an image")
    if content.startswith(PNG_SIGNATURE) and not _is_whole_png(content):
        raise ValueError(f"{path} cannot be decoded as an image: the PNG file is truncated or damaged")
    encoded = np.frombuffer(content, dtype=np.uint8)
    try:
        pixels: NDArray[Any] | None = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(f"{path} cannot be decoded as an image: {error}") from error
    if pixels is None:
        raise ValueError(f"{path} cannot be decoded as an image: the format is unknown or the file is damaged")
    return pixels


def _is_whole_png(content: bytes) -> bool:
    """Whether all chunks are there and match their checksums; libpng would print its own complaint otherwise.

    Source: PNG specification, 3rd edition, section 5.3.
    """
    start = len(PNG_SIGNATURE)
    while start + 12 <= len(content):
        length = int.from_bytes(content[start : start + 4])
        stop = start + 8 + length
        if zlib.crc32(memoryview(content)[start + 4 : stop]) != int.from_bytes(content[stop : stop + 4]):
            return False
        if content[start + 4 : start + 8] == b"IEND":
            return True
        start = stop + 4
    return False
