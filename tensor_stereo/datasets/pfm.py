"""Portable float maps, the disparity format of Middlebury (2014, 2021, MiddEval3) and ETH3D.

Source: https://www.pauldebevec.com/Research/HDR/PFM/ and the Middlebury evaluation SDK.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tensor_stereo.datasets.files import StrPath

FloatMap: TypeAlias = NDArray[np.float32]

_HEADER = re.compile(rb"(PF|Pf)\s+(\d{1,9})\s+(\d{1,9})\s+([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)[ \t]*(?:\r\n|\s)")
_HEADER_BYTES = 256  # more than any header needs


def read_pfm(path: StrPath) -> FloatMap:
    """Read a portable float map, first row on top.

    The sign of the header's scale gives the byte order. Its magnitude is *not* multiplied: Middlebury writes 1/255
    there, and its values are pixels as stored. Unknown disparity is +inf in the benchmarks and is left so.

    Args:
        path: the file.

    Returns:
        (H, W) float32 for ``Pf``, (H, W, 3) for ``PF``, in native byte order.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the header is wrong, or the file's size is not what the header promises (checked before reading).

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_pfm(f"{folder}/disp0.pfm", np.array([[1.5, np.inf]], dtype=np.float32))
    ...     read_pfm(f"{folder}/disp0.pfm")
    array([[1.5, inf]], dtype=float32)
    """
    path = Path(path)
    num_bytes = path.stat().st_size
    with path.open("rb") as file:
        start = file.read(_HEADER_BYTES)
    header = _HEADER.match(start)
    if header is None:
        raise ValueError(f"{path} is no PFM file: expected 'Pf' or 'PF', width, height and scale, got {start[:40]!r}")
    width, height, scale = int(header[2]), int(header[3]), float(header[4])
    if width == 0 or height == 0:
        raise ValueError(f"{path}: width and height must be positive, the header says {width} x {height}")
    if scale == 0 or not np.isfinite(scale):
        raise ValueError(f"{path}: the scale's sign must give the byte order, the header says {header[4].decode()}")
    shape = (height, width) if header[1] == b"Pf" else (height, width, 3)
    count = int(np.prod(shape, dtype=object))
    if num_bytes - header.end() != 4 * count:
        held = num_bytes - header.end()
        raise ValueError(
            f"{path}: {width} x {height} values need {4 * count} bytes after the header, the file has {held}"
        )
    values = np.fromfile(path, dtype="<f4" if scale < 0 else ">f4", count=count, offset=header.end())
    return np.ascontiguousarray(values.reshape(shape)[::-1], dtype=np.float32)  # rows are stored bottom-up


def write_pfm(path: StrPath, values: FloatMap, *, byte_order: Literal["little", "big"] = "little") -> None:
    """Write a portable float map with scale 1, replacing the file.

    Args:
        path: the file.
        values: (H, W) or (H, W, 3) float32, first row on top; +inf where disparity is unknown.
        byte_order: of the stored values.

    Raises:
        TypeError: if ``values`` is not float32.
        ValueError: if its shape fits neither form or is empty, or ``byte_order`` is unknown.

    >>> write_pfm("disp0.pfm", np.zeros((2, 2)))
    Traceback (most recent call last):
    TypeError: values must be float32, got float64
    """
    if values.dtype != np.float32:
        raise TypeError(f"values must be float32, got {values.dtype}")
    if values.size == 0 or values.ndim not in (2, 3) or values.shape[2:] not in ((), (3,)):
        raise ValueError(f"values must be (H, W) or (H, W, 3) and not empty, got shape {values.shape}")
    if byte_order not in ("little", "big"):
        raise ValueError(f"byte_order must be 'little' or 'big', got {byte_order!r}")
    kind, scale = "Pf" if values.ndim == 2 else "PF", "-1.0" if byte_order == "little" else "1.0"
    header = f"{kind}\n{values.shape[1]} {values.shape[0]}\n{scale}\n"
    stored = values[::-1].astype("<f4" if byte_order == "little" else ">f4")
    Path(path).write_bytes(header.encode() + stored.tobytes())
