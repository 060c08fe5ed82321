"""Manifests: tables of pairs, found once and read by every sweep. Imports no torch."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl

from tensor_stereo.atomic import whole_file
from tensor_stereo.datasets.discovery import find_pairs
from tensor_stereo.datasets.files import PATHS, Location, PairFiles, StrPath, check_sample_bits
from tensor_stereo.datasets.image_size import image_size
from tensor_stereo.datasets.pair_lists import read_list
from tensor_stereo.datasets.pair_table import SCHEMA, PairTable, pair_row, two_of_one_name
from tensor_stereo.datasets.remote import absolute, fetched
from tensor_stereo.paths import check_ending, has_ending
from tensor_stereo.table_files import check_name, write_table


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
    found: dict[tuple[Location, Location], PairFiles] = {}
    for root in map(Path, roots):
        is_list = has_ending(root, ".csv") and not root.is_dir()
        for pair in read_list(root) if is_list else find_pairs(root, gt_scale=gt_scale):
            if pair.sample_bits is None and sample_bits is not None:
                pair = replace(pair, sample_bits=int(sample_bits))
            found.setdefault((absolute(pair.image0), absolute(pair.image1)), pair)
    pairs = sorted(found.values(), key=lambda pair: (pair.dataset, pair.scene.casefold()))
    _check_names(pairs)
    rows = []
    for pair in pairs:
        check_name(Path(absolute(pair.image0)))
        with fetched(PairFiles("", "", pair.image0, pair.image0)) as local:
            width, height = image_size(Path(local.image0))
        paths: dict[str, Any] = {name: absolute(path) for name in PATHS if (path := getattr(pair, name)) is not None}
        rows.append(pair_row(replace(pair, **paths)) | {"width_px": width, "height_px": height})
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
        path: Parquet file as :func:`write_manifest` writes it, or a folder of such files; further columns are ignored.
            Or a CSV list of paths as :func:`build_manifest` takes it.
        check_files: whether a file that is missing is an error now, or only when it is read.

    Returns:
        The pairs in the order of its rows.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no such file, or an entry is wrong; the message names file, row (from 1) and column.
    """
    return list(PairTable(path, check_files=check_files))


def _check_names(pairs: Sequence[PairFiles]) -> None:
    """Raise if two pairs have one name."""
    named: dict[tuple[str, str], PairFiles] = {}
    for pair in pairs:
        other = named.setdefault((pair.dataset, pair.scene), pair)
        if other is not pair:
            raise two_of_one_name(pair.dataset, pair.scene, other.image0, pair.image0)
