"""CSV lists of pairs. Imports no torch."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from tensor_stereo.datasets.files import (
    GT_ENCODINGS,
    PATHS,
    SCALES,
    Location,
    PairFiles,
    check_sample_bits,
    check_scale,
)
from tensor_stereo.datasets.remote import beside
from tensor_stereo.paths import has_ending
from tensor_stereo.table_files import read_csv

_LISTED = ("image0", "image1")  # what a list must have
COLUMNS = ("dataset", "scene", *PATHS, *SCALES, "gt_encoding", "sample_bits", "width_px", "height_px")


def read_list(path: Path, check_files: bool = True, listed: Location | None = None) -> list[PairFiles]:
    """The pairs of a CSV of paths.

    Args:
        path: The list; its paths are absolute or relative to its folder.
        check_files: Whether a listed file that is missing is an error; nobody looks at URLs.
        listed: Where the list comes from, if not from ``path``.

    Raises:
        FileNotFoundError: if the list, or a listed file, is missing.
        ValueError: if it is wrong; the message names file, line and column.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no list of pairs {path}")
    table = read_csv(path).with_columns(pl.all().str.strip_chars())
    for name in _LISTED:
        if name not in table.columns:
            raise ValueError(f"{path} has no column {name!r}, it has {table.columns}")
    unknown = sorted(set(table.columns) - set(COLUMNS))
    if unknown:
        raise ValueError(f"{path} has the unknown column {unknown[0]!r}; known are {list(COLUMNS)}")
    pairs = []
    for row, values in enumerate(table.iter_rows(named=True)):
        for name in _LISTED:
            if not values[name]:
                raise ValueError(f"{path}, line {row + 2}: column {name!r} is empty")
        paths = {name: beside(listed or path, values[name]) for name in PATHS if values.get(name)}
        for name, file in paths.items():
            if check_files and isinstance(file, Path) and not file.is_file():
                raise FileNotFoundError(f"{path}, line {row + 2}: column {name!r} names {file}, which is no file")
        scale, est_scale = (_scale(path, row, name, values.get(name)) for name in SCALES)
        try:
            bits = _whole(values["sample_bits"]) if values.get("sample_bits") else None
            check_sample_bits(bits)
        except ValueError as error:
            raise ValueError(f"{path}, line {row + 2}: column 'sample_bits': {error}") from error
        encoding = values.get("gt_encoding") or "scaled"
        if encoding not in GT_ENCODINGS:
            raise ValueError(
                f"{path}, line {row + 2}: column 'gt_encoding' must be one of {GT_ENCODINGS}, got {encoding!r}"
            )
        disparity = paths.get("disparity_gt")
        if disparity is not None and scale is None and encoding == "scaled" and not has_ending(Path(disparity), ".pfm"):
            raise ValueError(f"{path}, line {row + 2}: column 'gt_scale' is empty, but {disparity} is no PFM file")
        dataset, scene = values.get("dataset") or path.stem, values.get("scene") or Path(paths["image0"]).stem
        scales = {"gt_scale": scale, "est_scale": est_scale}
        pairs.append(PairFiles(dataset, scene, gt_encoding=encoding, sample_bits=bits, **scales, **paths))  # type: ignore[arg-type]
    return pairs


def _scale(path: Path, row: int, name: str, text: str | None) -> float | None:
    """A scale of a line of a list, None if it is empty."""
    try:
        scale = float(text) if text else None
        check_scale(name, scale)
    except ValueError as error:
        raise ValueError(f"{path}, line {row + 2}: column {name!r}: {error}") from error
    return scale


def _whole(text: str) -> int:
    """A whole number, which some programs write as 12.0."""
    number = float(text)
    if not number.is_integer():
        raise ValueError(f"must be a whole number, got {text!r}")
    return int(number)
