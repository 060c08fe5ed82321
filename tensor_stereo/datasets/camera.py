"""Middlebury's ``calib.txt`` (2014, 2021, MiddEval3), which ETH3D shares."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

from tensor_stereo.datasets.files import StrPath

_LINE = re.compile(r"\s*(\w+)\s*=\s*(.*?)\s*")


@dataclass(frozen=True)
class Calibration:
    """Intrinsics of a rectified pair; depth in mm = ``baseline_mm * focal_length_px / (disparity + doffs_px)``.

    Attributes:
        focal_length_px: of both cameras.
        cx0: x of the principal point of view 0, in px.
        cx1: x of the principal point of view 1, in px.
        cy: y of the principal point of both views, in px.
        doffs_px: cx1 - cx0.
        baseline_mm: distance of the camera centres.
        width: of the images, in px.
        height: of the images, in px.
        ndisp: bound on the number of disparity levels that the release suggests; None if it gives none.
        vmin_px: smallest disparity for display, None if not given.
        vmax_px: largest disparity for display, None if not given.
    """

    focal_length_px: float
    cx0: float
    cx1: float
    cy: float
    doffs_px: float
    baseline_mm: float
    width: int
    height: int
    ndisp: int | None = None
    vmin_px: float | None = None
    vmax_px: float | None = None


def read_calibration(path: StrPath) -> Calibration:
    r"""Read a ``calib.txt``; blanks around names and values are ignored, as are names that are not asked for.

    Args:
        path: the file. KITTI's calibration has another format and is not read.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a value is missing or no number, or the cameras are not those of a rectified pair; the message
            names the file and the value.

    >>> import tempfile
    >>> text = "cam0=[700 0 320; 0 700 240; 0 0 1]\ncam1=[700 0 352; 0 700 240; 0 0 1]\n"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "calib.txt").write_text(text + "doffs=32\nbaseline=178.2\nwidth=720\nheight=486\n")
    ...     read_calibration(f"{folder}/calib.txt").focal_length_px
    700.0
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no calib.txt: it is not text ({error})") from error
    values = {line[1]: line[2] for line in map(_LINE.fullmatch, lines) if line}
    focal_length, cx0, cy = _camera(path, values, "cam0")
    focal_length1, cx1, cy1 = _camera(path, values, "cam1")
    if (focal_length, cy) != (focal_length1, cy1):
        raise ValueError(
            f"{path}: cam0 and cam1 of a rectified pair must share focal length and cy, got {values['cam1']}"
        )
    optional = {name: _number(path, values, name) if name in values else None for name in ("ndisp", "vmin", "vmax")}
    return Calibration(
        focal_length_px=focal_length,
        cx0=cx0,
        cx1=cx1,
        cy=cy,
        doffs_px=_number(path, values, "doffs"),
        baseline_mm=_number(path, values, "baseline"),
        width=_count(path, values, "width"),
        height=_count(path, values, "height"),
        ndisp=None if optional["ndisp"] is None else _count(path, values, "ndisp"),
        vmin_px=optional["vmin"],
        vmax_px=optional["vmax"],
    )


def _camera(path: Path, values: dict[str, str], name: str) -> tuple[float, float, float]:
    """Focal length, cx and cy of a matrix ``[f 0 cx; 0 f cy; 0 0 1]``."""
    text = _text(path, values, name)
    try:
        rows = [[float(entry) for entry in row.split()] for row in text.strip("[]").split(";")]
        (fx, skew, cx), (zero, fy, cy), last = rows
    except ValueError:
        raise ValueError(f"{path}: {name} must be a matrix [f 0 cx; 0 f cy; 0 0 1], got {text!r}") from None
    if fx != fy or skew != 0 or zero != 0 or last != [0, 0, 1] or not fx > 0:
        raise ValueError(f"{path}: {name} must be a matrix [f 0 cx; 0 f cy; 0 0 1], got {text!r}")
    return fx, cx, cy


def _number(path: Path, values: dict[str, str], name: str) -> float:
    text = _text(path, values, name)
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{path}: {name} must be a number, got {text!r}")
    return number


def _count(path: Path, values: dict[str, str], name: str) -> int:
    number = _number(path, values, name)
    if number != int(number) or number < 1:
        raise ValueError(f"{path}: {name} must be a positive integer, got {values[name]!r}")
    return int(number)


def _text(path: Path, values: dict[str, str], name: str) -> str:
    if name not in values:
        raise ValueError(
            f"{path}: expected a line '{name}=...', found only {', '.join(sorted(values)) or 'no such lines'}"
        )
    return values[name]
