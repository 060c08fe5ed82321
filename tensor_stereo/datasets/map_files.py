"""Files of disparity maps that some method has made, and of confidences: PFM, PNG, npy, TIFF."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tensor_stereo.atomic import whole_file
from tensor_stereo.datasets.decoding import decode
from tensor_stereo.datasets.files import StrPath
from tensor_stereo.datasets.images import decode_grey
from tensor_stereo.datasets.pfm import read_pfm, write_pfm
from tensor_stereo.paths import MAPS, check_ending, check_source, ending_of, has_ending

_INTEGER_PNG = (".png", ".pgm")
_FULL = 65535  # of a PNG of 16 bits, which stands for 1


def read_map(
    path: StrPath,
    *,
    scale: float | None = None,
    unknown: float | None = None,
    name: str = "disparity",
    scale_name: str = "scale",
) -> NDArray[np.float32]:
    """Read a disparity map of any method.

    Args:
        path: ``.pfm`` (infinity is unknown), ``.png`` or ``.pgm`` of 8 or 16 bits (0 is unknown), ``.npy``, ``.tif`` or
            ``.tiff`` of floats or integers.
        scale: Stored value / px of disparity; integers need it: 256 for KITTI, 16 for what OpenCV's matchers return.
        unknown: A stored value that stands for an unknown disparity.
        name: Name of the argument, for errors.
        scale_name: Name of the argument ``scale``, for errors.

    Returns:
        (H, W) float32 px, NaN where unknown.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for another ending, a damaged file, other than one channel, or integers without ``scale``.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.save(f"{folder}/map.npy", np.array([[32, -16]], np.int16))
    ...     read_map(f"{folder}/map.npy", scale=16, unknown=-16)
    array([[ 2., nan]], dtype=float32)
    """
    path = check_source(name, Path(path), (*MAPS, ".pgm"))
    if scale is not None and not 0 < scale < float("inf"):
        raise ValueError(f"{scale_name} must be a positive number, got {scale}")
    values = _read_values(name, path, scale, scale_name)
    if unknown is not None:
        values[values == unknown] = np.nan
    with np.errstate(over="ignore"):  # what single precision cannot hold is unknown too
        found = (values / (1 if scale is None else scale)).astype(np.float32)
    found[~np.isfinite(found)] = np.nan
    return found


def _read_values(name: str, path: Path, scale: float | None, scale_name: str) -> NDArray[np.float64]:
    """(H, W) values as they are stored; NaN for 0 in a PNG."""
    if has_ending(path, ".pfm"):
        stored = read_pfm(path)
    elif has_ending(path, _INTEGER_PNG):
        stored = decode_grey(path)
    elif has_ending(path, ".npy"):
        try:
            stored = np.load(path, allow_pickle=False)
        except (ValueError, EOFError, OSError) as error:
            raise ValueError(f"{name}: {path} is no .npy file that can be read: {error}") from error
    else:
        stored = decode(path).samples
    if not isinstance(stored, np.ndarray):
        raise ValueError(f"{name}: {path} is no .npy file that can be read: it is an archive")
    while stored.ndim > 2 and 1 in (stored.shape[0], stored.shape[-1]):  # axes of a batch and of channels
        stored = stored[0] if stored.shape[0] == 1 else stored[..., 0]
    if stored.ndim != 2 or not stored.size:
        raise ValueError(f"{name}: {path} must hold one channel (H, W), got shape {stored.shape}")
    if not np.issubdtype(stored.dtype, np.floating):
        if not np.issubdtype(stored.dtype, np.integer):
            raise ValueError(f"{name}: {path} must hold numbers, got {stored.dtype}")
        if scale is None:
            raise ValueError(f"{scale_name} must be given for {path}, which holds integers: the stored value of one px")
    values = stored.astype(np.float64)
    if has_ending(path, _INTEGER_PNG):
        values[stored == 0] = np.nan
    return values


def write_confidence(path: StrPath, probability: NDArray[np.float32]) -> None:
    """Write probabilities; the file appears whole or not at all.

    Args:
        path: ``.pfm``, ``.npy`` or ``.tiff`` for float32; ``.png`` for 16 bits, where 65535 stands for 1.
        probability: (H, W) float32 in [0, 1].

    Raises:
        ValueError: for another ending.
        OSError: if it cannot be written.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_confidence(f"{folder}/c.npy", np.full((1, 2), 0.5, np.float32))
    ...     np.load(f"{folder}/c.npy")
    array([[0.5, 0.5]], dtype=float32)
    """
    path = Path(path)
    check_ending("out", path, MAPS)
    with whole_file(path) as part:
        if has_ending(path, ".pfm"):
            write_pfm(part, probability)
        elif has_ending(path, ".npy"):
            with part.open("wb") as file:  # np.save would add an ending
                np.save(file, probability)
        else:
            stored = probability
            if has_ending(path, ".png"):
                stored = np.rint(probability.astype(np.float64) * _FULL).astype(np.uint16)
            part.write_bytes(cv2.imencode(ending_of(path), stored)[1].tobytes())


def read_confidence(path: StrPath) -> NDArray[np.float32]:
    """Read probabilities that :func:`write_confidence` has written.

    Returns:
        (H, W) float32 in [0, 1], 0 where unknown.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_confidence(f"{folder}/c.png", np.array([[0, 0.25]], np.float32))
    ...     read_confidence(f"{folder}/c.png").round(3)
    array([[0.  , 0.25]], dtype=float32)
    """
    values = read_map(path, scale=_FULL if has_ending(Path(path), ".png") else None, name="confidence")
    return np.nan_to_num(values, nan=0.0)
