"""The rows of a manifest, checked by columns and read a window at a time, so that a million of them cost little."""

from __future__ import annotations

import bisect
import copy
import filecmp
import math
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

from tensor_stereo.datasets.files import (
    ESTIMATES,
    GT_ENCODINGS,
    PATHS,
    SAMPLE_BITS,
    SCALES,
    Location,
    PairFiles,
    StrPath,
)
from tensor_stereo.datasets.pair_lists import read_list
from tensor_stereo.datasets.remote import fetch, is_url, to_location
from tensor_stereo.paths import has_ending
from tensor_stereo.table_files import lazy_parquet, write_lazy

SCHEMA: dict[str, Any] = {
    "dataset": pl.String,  # release, e.g. middlebury-2005
    "scene": pl.String,  # unique within its dataset
    **dict.fromkeys(PATHS[:6], pl.String),  # absolute paths; null where the release has no such file
    "gt_scale": pl.Float64,  # stored value / gt_scale = disparity in px; null without ground truth
    "gt_encoding": pl.String,  # scaled, or sintel: how the maps hold their values
    "width_px": pl.Int32,  # of image0
    "height_px": pl.Int32,
    "sample_bits": pl.Int32,  # in use, of views that store 16 bits and do not tell; null: nothing says so
    **dict.fromkeys(ESTIMATES, pl.String),  # absolute paths of maps that some method has made
    "est_scale": pl.Float64,  # stored value / est_scale = disparity in px in these maps
}
OPTIONAL = ("sample_bits", *ESTIMATES, "est_scale")  # not there in manifests of earlier releases
_REQUIRED = ("dataset", "scene", "image0", "image1", "gt_encoding", "width_px", "height_px")
_VALUES = ("dataset", "scene", "gt_encoding", "sample_bits", *SCALES)  # of PairFiles, besides its paths
_ROWS_AT_ONCE = 1 << 15


class _Part(NamedTuple):
    """Rows of one file."""

    path: Path
    rows: pl.LazyFrame  # with the columns of SCHEMA
    first: int  # number of its first row


class PairTable:
    r"""The pairs of a manifest, by number.

    Only one window of rows is held. Rows of several files count through, in the order of the files' names.

    Args:
        path: A Parquet file as :func:`tensor_stereo.datasets.write_manifest` writes it, a folder of such files, or a
            CSV list of paths as :func:`tensor_stereo.datasets.build_manifest` takes it; also by a URL of fsspec.
            Further columns are ignored.

    Raises:
        FileNotFoundError: if there is no such file, or none in the folder.
        ValueError: if it is no manifest, or an entry is wrong; the message names file, row (from 1) and column.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "mine.csv").write_text("image0,image1\na.ppm,b.ppm\n")
    ...     table = PairTable(Path(folder, "mine.csv"), check_files=False)
    ...     len(table), table[0].scene
    (1, 'a')
    """

    def __init__(self, path: StrPath, *, check_files: bool = True) -> None:
        self.path: Location = os.fspath(path) if is_url(os.fspath(path)) else Path(path)
        found = self.path if isinstance(self.path, Path) else self._fetch(self.path)
        self._parts: list[_Part] = []
        self._num_rows = 0
        self._window = 0, pl.DataFrame(schema=SCHEMA)
        for file, rows in _files(self.path, found, check_files):
            self._parts.append(_Part(file, rows, self._num_rows))
            self._num_rows += _check_rows(file, rows)
        self._starts = [part.first for part in self._parts]
        self._check_names()
        if check_files:
            self._check_files()

    def _fetch(self, url: str) -> Path:
        """A local copy, which ends with this table."""
        folder = Path(tempfile.mkdtemp(prefix="tensor-stereo-"))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        return fetch(url, folder, tables=True)

    def __len__(self) -> int:
        return self._num_rows

    def __getitem__(self, number: int) -> PairFiles:
        if not 0 <= number < self._num_rows:
            raise IndexError(f"{self.path} has {self._num_rows} pairs, got number {number}")
        first, window = self._window
        if not first <= number < first + len(window):
            part = self._parts[bisect.bisect_right(self._starts, number) - 1]
            offset = (number - part.first) // _ROWS_AT_ONCE * _ROWS_AT_ONCE
            first, window = part.first + offset, part.rows.slice(offset, _ROWS_AT_ONCE).collect()
            self._window = first, window
        return to_pair(window.row(number - first, named=True))

    def __iter__(self) -> Iterator[PairFiles]:
        return (self[number] for number in range(self._num_rows))

    def rows(self) -> pl.LazyFrame:
        """All rows, with the columns of ``SCHEMA``."""
        return pl.concat([part.rows for part in self._parts])

    def copy_to(self, path: Path) -> None:
        """Write all rows as one Parquet file.

        Raises:
            OSError: if it cannot be written.
        """
        if len(self._parts) == 1 and has_ending(self._parts[0].path, ".parquet"):
            shutil.copyfile(self._parts[0].path, path)
            return
        write_lazy(self.rows(), path)

    def moved_to(self, path: Path) -> PairTable:
        """The same pairs, read from a copy that :meth:`copy_to` has written, or that :meth:`first_difference` knows."""
        table = copy.copy(self)
        table.path = path
        rows = _complete(path, lazy_parquet(path, check=False))
        table._parts, table._starts = [_Part(path, rows, 0)], [0]
        table._window = 0, pl.DataFrame(schema=SCHEMA)
        return table

    def find(self, dataset: str, scene: str) -> PairFiles:
        """The pair of a name.

        Raises:
            KeyError: if there is none.
        """
        rows = self.rows().filter(pl.col("dataset") == dataset, pl.col("scene") == scene).collect()
        if not len(rows):
            raise KeyError(f"{self.path} has no pair {dataset}/{scene}")
        return to_pair(rows.row(0, named=True))

    def first_difference(self, other: Path) -> str | None:
        """What differs first from the manifest in another file, in words; None if both say the same.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is no manifest.
        """
        if len(self._parts) == 1 and filecmp.cmp(self._parts[0].path, other, shallow=False):
            return None
        table = PairTable(other, check_files=False)
        if len(self) != len(table):
            return f"it has {len(table)} pairs there, {len(self)} here"
        both = zip(windows(self.rows(), len(self)), windows(table.rows(), len(self)), strict=True)
        for (first, here), (_, there) in both:
            if not here.equals(there):
                row = next(k for k, (a, b) in enumerate(zip(here.rows(), there.rows(), strict=True)) if a != b)
                name = next(name for name in SCHEMA if here[name][row] != there[name][row])
                return f"row {first + row + 1}: {name} is {there[name][row]!r} there, {here[name][row]!r} here"
        return None

    def _check_names(self) -> None:
        """Raise if two pairs have one name."""
        names = pl.struct("dataset", "scene")
        hashes = [rows.select(names.hash().alias("hash")) for _, rows in windows(self.rows(), len(self))]
        if not hashes or pl.concat(hashes)["hash"].n_unique() == len(self):
            return
        twice = self.rows().filter(names.is_duplicated()).select("dataset", "scene", "image0").collect()
        if len(twice):
            dataset, scene, image0 = twice.row(0)
            other = twice[1:].filter(pl.col("dataset") == dataset, pl.col("scene") == scene).row(0)
            raise two_of_one_name(dataset, scene, image0, other[2])

    def _check_files(self) -> None:
        for part in self._parts:
            if has_ending(part.path, ".csv"):
                continue  # its reader has looked
            rows = part.rows.select(PATHS).collect()
            for name in PATHS:
                for file in rows[name].drop_nulls().unique(maintain_order=True):
                    location = to_location(file)
                    if isinstance(location, Path) and not location.is_file():
                        row = int((rows[name] == file).arg_true()[0])
                        raise _wrong(part.path, row, name, f"names {file}, which is no file")


def two_of_one_name(dataset: str, scene: str, image0: object, other: object) -> ValueError:
    """The error for two pairs of one name."""
    return ValueError(f"two pairs are named {dataset}/{scene}: {image0} and {other}; give them other names")


def to_pair(values: dict[str, Any]) -> PairFiles:
    """One row, checked before."""
    paths: dict[str, Any] = {name: None if values[name] is None else to_location(values[name]) for name in PATHS}
    return PairFiles(**{name: values[name] for name in _VALUES}, **paths)


def _files(given: Location, path: Path, check_files: bool) -> Iterator[tuple[Path, pl.LazyFrame]]:
    """The files of a manifest and their rows."""
    if path.is_dir():
        files = sorted(file for file in path.glob("*.parquet") if not file.name.startswith("."))
        if not files:
            raise FileNotFoundError(f"there is no manifest in the folder {path}: it holds no .parquet file")
    elif path.is_file():
        files = [path]
    else:
        raise FileNotFoundError(f"there is no manifest {given}")
    for file in files:
        if has_ending(file, ".csv"):
            rows = [pair_row(pair) | {"width_px": 1, "height_px": 1} for pair in read_list(file, check_files, given)]
            yield file, pl.DataFrame(rows, schema=SCHEMA).lazy()
        else:
            yield file, _complete(file, lazy_parquet(file))


def pair_row(pair: PairFiles) -> dict[str, Any]:
    """A pair as a row, but for the size of its images."""
    paths = {name: getattr(pair, name) for name in PATHS}
    return {name: getattr(pair, name) for name in _VALUES} | {
        name: None if path is None else str(path) for name, path in paths.items()
    }


def _complete(path: Path, rows: pl.LazyFrame) -> pl.LazyFrame:
    """The columns of SCHEMA."""
    found = rows.collect_schema()
    for name, dtype in SCHEMA.items():
        if name not in found and name not in OPTIONAL:
            raise ValueError(f"{path} has no column {name!r}, it has {list(found)}")
        if name in found and found[name] not in (dtype, pl.Null):
            raise ValueError(f"{path}: column {name!r} must be {dtype}, got {found[name]}")
    return rows.select(
        (pl.col(name) if name in found else pl.lit(None)).cast(dtype).alias(name) for name, dtype in SCHEMA.items()
    )


def _check_rows(path: Path, rows: pl.LazyFrame) -> int:
    """Raise for the first wrong row; their number."""
    rules = [(name, pl.col(name).is_null(), "is empty") for name in _REQUIRED]
    rules += [(name, pl.col(name) == "", "is empty") for name in _REQUIRED if SCHEMA[name] == pl.String]
    rules += [(name, pl.col(name) <= 0, "must be positive, got {}") for name in ("width_px", "height_px")]
    rules += [
        (name, ~((pl.col(name) > 0) & (pl.col(name) < math.inf)), "must be positive and finite, got {}")
        for name in SCALES
    ]
    bits = pl.col("sample_bits")
    rules.append(("sample_bits", ~bits.is_between(SAMPLE_BITS.low, SAMPLE_BITS.high), f"must {SAMPLE_BITS}, got {{}}"))
    known = f"must be one of {GT_ENCODINGS}, got {{!r}}"
    rules.append(("gt_encoding", ~pl.col("gt_encoding").is_in(GT_ENCODINGS), known))
    number = pl.int_range(pl.len(), dtype=pl.Int64)
    places = [number.filter(wrong.fill_null(value=False)).min().alias(f"{k}") for k, (_, wrong, _) in enumerate(rules)]
    num_rows = int(rows.select(pl.len()).collect().item())
    for first, window in windows(rows, num_rows):
        wrong = [(row, k) for k, row in enumerate(window.select(places).row(0)) if row is not None]
        if wrong:
            row, k = min(wrong)
            name, _, text = rules[k]
            raise _wrong(path, first + row, name, text.format(window[name][row]))
    return num_rows


def windows(rows: pl.LazyFrame, num_rows: int) -> Iterator[tuple[int, pl.DataFrame]]:
    """The number of its first row, and the rows of one window after the other.

    >>> [(first, len(window)) for first, window in windows(pl.LazyFrame({"a": [1, 2]}), 2)]
    [(0, 2)]
    """
    for first in range(0, num_rows, _ROWS_AT_ONCE):
        yield first, rows.slice(first, _ROWS_AT_ONCE).collect()


def _wrong(path: Path, row: int, name: str, text: str) -> ValueError:
    return ValueError(f"{path}, row {row + 1}: column {name!r} {text}")
