"""Manifests: tables of pairs, found once and read by every sweep. Imports no torch."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import polars as pl

from tensor_stereo.atomic import whole_file
from tensor_stereo.datasets.discovery import find_pairs
from tensor_stereo.datasets.files import (
    GT_ENCODINGS,
    SAMPLE_BITS,
    PairFiles,
    StrPath,
    check_sample_bits,
    check_scale,
)
from tensor_stereo.datasets.image_size import image_size
from tensor_stereo.paths import check_ending, has_ending
from tensor_stereo.table_files import check_name, read_csv, read_parquet, write_table

_ESTIMATES = ("disparity_est", "disparity1_est")
_PATHS = ("image0", "image1", "disparity_gt", "disparity_noc_gt", "mask", "calibration", *_ESTIMATES)
_SCALES = ("gt_scale", "est_scale")
SCHEMA = {
    "dataset": pl.String,  # release, e.g. middlebury-2005
    "scene": pl.String,  # unique within its dataset
    **dict.fromkeys(_PATHS[:6], pl.String),  # absolute paths; null where the release has no such file
    "gt_scale": pl.Float64,  # stored value / gt_scale = disparity in px; null without ground truth
    "gt_encoding": pl.String,  # scaled, or sintel: how the maps hold their values
    "width_px": pl.Int32,  # of image0
    "height_px": pl.Int32,
    "sample_bits": pl.Int32,  # in use, of views that store 16 bits and do not tell; null: nothing says so
    **dict.fromkeys(_ESTIMATES, pl.String),  # absolute paths of maps that some method has made
    "est_scale": pl.Float64,  # stored value / est_scale = disparity in px in these maps
}
OPTIONAL = ("sample_bits", *_ESTIMATES, "est_scale")  # not there in manifests of earlier releases
_REQUIRED = ("dataset", "scene", "image0", "image1", "gt_encoding", "width_px", "height_px")
_LISTED = ("image0", "image1")  # what a CSV of paths must have


def build_manifest(
    roots: Sequence[StrPath], *, gt_scale: float | None = None, sample_bits: int | None = None
) -> pl.DataFrame:
    r"""Find the pairs of folders and lists of paths; only headers of images are read.

    A list is a CSV file with the columns ``image0`` and ``image1`` and any of ``disparity_gt``, ``gt_scale``,
    ``gt_encoding``, ``disparity_noc_gt``, ``mask``, ``calibration``, ``sample_bits``, ``disparity_est``,
    ``disparity1_est``, ``est_scale``, ``dataset`` (default: the file's name) and ``scene`` (default: the name of
    ``image0`` without ending). Its paths are absolute or relative to its own folder. Blanks around values do not count.

    Args:
        roots: folders as :func:`~tensor_stereo.datasets.find_pairs` takes them, and ``.csv`` files. A pair that lies
            below several of them is taken once.
        gt_scale: as in :func:`~tensor_stereo.datasets.find_pairs`, for the folders.
        sample_bits: as in :func:`~tensor_stereo.datasets.find_pairs`, for the folders and for the pairs of lists that
            do not give it.

    Returns:
        One row per pair with the columns of ``SCHEMA``, sorted by (dataset, scene without case).

    Raises:
        FileNotFoundError, NotADirectoryError: if a root or a listed file is missing.
        ValueError: if there is no root, a list is wrong (naming file, line and column), two different pairs share
            dataset and scene, or as :func:`~tensor_stereo.datasets.find_pairs`.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as root:
    ...     for name in ("a.ppm", "b.ppm"):
    ...         _ = Path(root, name).write_bytes(b"P6 64 48 255 ")
    ...     _ = Path(root, "mine.csv").write_text("image0,image1\na.ppm,b.ppm\n")
    ...     build_manifest([f"{root}/mine.csv"]).select("dataset", "scene", "width_px", "height_px").rows()
    [('mine', 'a', 64, 48)]
    """
    if isinstance(roots, (str, os.PathLike)):
        raise TypeError(f"roots must be a sequence of paths, got the single path {os.fspath(roots)!r}")
    if not roots:
        raise ValueError("roots must name at least one folder or CSV file")
    check_sample_bits(sample_bits)
    found: dict[tuple[Path, Path], PairFiles] = {}
    for root in map(Path, roots):
        is_list = has_ending(root, ".csv") and not root.is_dir()
        for pair in _read_list(root) if is_list else find_pairs(root, gt_scale=gt_scale):
            if pair.sample_bits is None and sample_bits is not None:
                pair = replace(pair, sample_bits=int(sample_bits))
            found.setdefault((pair.image0.resolve(), pair.image1.resolve()), pair)
    pairs = sorted(found.values(), key=lambda pair: (pair.dataset, pair.scene.casefold()))
    _check_names(pairs)
    rows = []
    for pair in pairs:
        check_name(pair.image0.resolve())
        width, height = image_size(pair.image0)
        paths = {name: getattr(pair, name) for name in _PATHS}
        rows.append(
            {
                "dataset": pair.dataset,
                "scene": pair.scene,
                **{name: None if path is None else str(path.resolve()) for name, path in paths.items()},
                "gt_scale": pair.gt_scale,
                "gt_encoding": pair.gt_encoding,
                "width_px": width,
                "height_px": height,
                "sample_bits": pair.sample_bits,
                "est_scale": pair.est_scale,
            }
        )
    return pl.DataFrame(rows, schema=SCHEMA)


def write_manifest(manifest: pl.DataFrame, path: StrPath) -> None:
    """Write a manifest as Parquet, in one step: there is the whole file or none.

    Raises:
        ValueError: if ``path`` does not end in ``.parquet``.
        OSError: if it cannot be written.
    """
    path = Path(path)
    check_ending("path", path, (".parquet",))
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as part:
        write_table(manifest, part)


def read_manifest(path: StrPath, *, check_files: bool = True) -> list[PairFiles]:
    """Read a manifest and check every entry; no image is opened.

    Args:
        path: Parquet file as :func:`write_manifest` writes it; further columns are ignored. Or a CSV list of paths as
            :func:`build_manifest` takes it.
        check_files: whether a file that is missing is an error now, or only when it is read.

    Returns:
        The pairs in the order of its rows.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no such file, or an entry is wrong; the message names file, row (from 1) and column.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no manifest {path}")
    if has_ending(path, ".csv"):
        listed = _read_list(path, check_files)
        _check_names(listed)
        return listed
    table = read_parquet(path)
    missing = [name for name in OPTIONAL if name not in table.columns]
    table = table.with_columns(pl.lit(None, dtype=SCHEMA[name]).alias(name) for name in missing)
    for name, dtype in SCHEMA.items():
        if name not in table.columns:
            raise ValueError(f"{path} has no column {name!r}, it has {table.columns}")
        if table[name].dtype not in (dtype, pl.Null):
            raise ValueError(f"{path}: column {name!r} must be {dtype}, got {table[name].dtype}")
    pairs = [
        _to_pair(path, row, values, check_files)
        for row, values in enumerate(table.select(list(SCHEMA)).iter_rows(named=True))
    ]
    _check_names(pairs)
    return pairs


def _to_pair(path: Path, row: int, values: dict[str, object], check_files: bool) -> PairFiles:
    """One checked row."""
    for name in _REQUIRED:
        if values[name] is None or values[name] == "":
            raise ValueError(f"{path}, row {row + 1}: column {name!r} is empty")
    for name in ("width_px", "height_px"):
        if not int(str(values[name])) > 0:
            raise ValueError(f"{path}, row {row + 1}: column {name!r} must be positive, got {values[name]}")
    for name in _SCALES:
        scale = values[name]
        if scale is not None and not (isinstance(scale, float) and 0 < scale < math.inf):
            raise ValueError(f"{path}, row {row + 1}: column {name!r} must be positive and finite, got {scale}")
    bits = values["sample_bits"]
    if bits is not None and bits not in SAMPLE_BITS:  # type: ignore[operator]
        raise ValueError(f"{path}, row {row + 1}: column 'sample_bits' must {SAMPLE_BITS}, got {bits}")
    encoding = str(values["gt_encoding"])
    if encoding not in GT_ENCODINGS:
        raise ValueError(f"{path}, row {row + 1}: column 'gt_encoding' must be one of {GT_ENCODINGS}, got {encoding!r}")
    paths = {name: None if values[name] is None else Path(str(values[name])) for name in _PATHS}
    for name, file in paths.items():
        if check_files and file is not None and not file.is_file():
            raise ValueError(f"{path}, row {row + 1}: column {name!r} names {file}, which is no file")
    return PairFiles(
        str(values["dataset"]),
        str(values["scene"]),
        gt_scale=values["gt_scale"],  # type: ignore[arg-type]
        gt_encoding=encoding,
        sample_bits=bits,  # type: ignore[arg-type]
        est_scale=values["est_scale"],  # type: ignore[arg-type]
        **paths,  # type: ignore[arg-type]
    )


def _read_list(path: Path, check_files: bool = True) -> list[PairFiles]:
    """The pairs of a CSV of paths."""
    if not path.is_file():
        raise FileNotFoundError(f"there is no list of pairs {path}")
    table = read_csv(path).with_columns(pl.all().str.strip_chars())
    for name in _LISTED:
        if name not in table.columns:
            raise ValueError(f"{path} has no column {name!r}, it has {table.columns}")
    unknown = sorted(set(table.columns) - set(SCHEMA))
    if unknown:
        raise ValueError(f"{path} has the unknown column {unknown[0]!r}; known are {list(SCHEMA)}")
    pairs = []
    for row, values in enumerate(table.iter_rows(named=True)):
        for name in _LISTED:
            if not values[name]:
                raise ValueError(f"{path}, line {row + 2}: column {name!r} is empty")
        paths = {name: path.parent / values[name] for name in _PATHS if values.get(name)}
        for name, file in paths.items():
            if check_files and not file.is_file():
                raise FileNotFoundError(f"{path}, line {row + 2}: column {name!r} names {file}, which is no file")
        scale, est_scale = (_scale(path, row, name, values.get(name)) for name in _SCALES)
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
        if disparity is not None and scale is None and encoding == "scaled" and not has_ending(disparity, ".pfm"):
            raise ValueError(f"{path}, line {row + 2}: column 'gt_scale' is empty, but {disparity} is no PFM file")
        dataset, scene = values.get("dataset") or path.stem, values.get("scene") or paths["image0"].stem
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


def _check_names(pairs: Sequence[PairFiles]) -> None:
    """Raise if two pairs have one name."""
    named: dict[tuple[str, str], PairFiles] = {}
    for pair in pairs:
        other = named.setdefault((pair.dataset, pair.scene), pair)
        if other is not pair:
            name = f"{pair.dataset}/{pair.scene}"
            raise ValueError(f"two pairs are named {name}: {other.image0} and {pair.image0}; give them other names")
