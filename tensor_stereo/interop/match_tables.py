"""Tables of matches, CSV and Parquet: one row per match of one or many pairs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import torch

from tensor_stereo.batching import lengths_to_ptr
from tensor_stereo.interop.image_filter import ImageFilter, PairImages, filter_pairs
from tensor_stereo.interop.result_names import earlier_results, free_name, later_results, name_results
from tensor_stereo.interop.verdicts import Array, FilterSummary, Improved, Int, MatchFilter
from tensor_stereo.ops.segments import check_range
from tensor_stereo.paths import has_ending
from tensor_stereo.scores import Origin
from tensor_stereo.table_files import read_csv, read_parquet, write_table
from tensor_stereo.types import Matches, Relation

_POINTS = ("x0", "y0", "x1", "y1")
_RELATIONS = {relation.value: relation.name.lower() for relation in Relation}
_ORIGINS = {origin.value: origin.name.lower() for origin in Origin}
_IMAGES = ("image0", "image1")
_IMPROVED = ("improved_x1", "improved_y1", "improved_inlier", "improved_score", "origin")
_OF_CLASSIFY = ("inlier_adjacency", "inlier_cardinality")  # columns that nothing else writes


def filter_table(source: Path, target: Path, run: MatchFilter, *, score_name: str | None = None) -> FilterSummary:
    """Copy a table and add ``inlier``, ``score`` if the settings name one, and ``relation``, by name in lower case.

    Columns: ``x0, y0, x1, y1`` in px, and optionally ``pair``, a string or an integer that names the pair of a row,
    whose rows need not be adjacent; ``cost``, lower is better; ``group``, integer. All rows and columns are kept, in
    order. Results of an earlier filter are replaced; where a column of the user's has the name of a result, the result
    gets another one by :func:`~tensor_stereo.interop.result_names.name_results`.
    What ``tensor-stereo classify --out`` writes is such a table of one pair.

    A filter that looks at the images needs their names in the columns ``image0`` and ``image1``, the same in all rows
    of a pair. If it repairs or refines, ``improved_x1, improved_y1`` follow, where the partner is then,
    ``improved_inlier`` and ``improved_score``, the verdict on that, and ``origin``: given, refined or repaired.

    Raises:
        ValueError: if the file is damaged or a column or value is wrong; the message names file, line of a
            CSV file or row (from 1) of a Parquet file, and column.
        OSError: if the copy cannot be written.
    """
    table = read_csv(source) if has_ending(source, ".csv") else read_parquet(source)
    for name in _POINTS:
        if name not in table.columns:
            raise ValueError(f"{source} has no column {name!r}, it has {table.columns}")
    pair = _pair_numbers(source, table)
    order = np.argsort(pair, kind="stable")  # whole pairs, their rows in the order of the file
    images = _images(source, table, pair) if isinstance(run, ImageFilter) else []
    verdicts, improved = filter_pairs(_to_matches(source, table, pair, order), images, run)
    back = np.argsort(order, kind="stable")
    verdicts, improved = verdicts.take(back), None if improved is None else improved.take(back)
    if set(_OF_CLASSIFY) <= set(table.columns):  # its verdicts are replaced by those of this filter
        table = table.drop("probability", "score", "inlier_score", *_OF_CLASSIFY, strict=False)
    table = table.drop(_earlier(table))
    names = name_results(str(source), table.columns, score_name)
    table = table.with_columns(
        pl.Series(names.inlier, verdicts.inlier),
        *([] if verdicts.score is None else [pl.Series(names.score, verdicts.score)]),
        pl.Series(names.relation, verdicts.relation).replace_strict(_RELATIONS, return_dtype=pl.String),
    )
    if improved is not None:
        table = table.with_columns(_improved_columns(improved, table.columns))
    write_table(table, target)
    return FilterSummary().add(int(pair.max(initial=-1)) + 1, verdicts, improved)


def _improved_columns(improved: Improved, taken: list[str]) -> list[pl.Series]:
    """The matches after repair and refinement, in the rows of the given ones."""
    names = [free_name(name, taken) for name in _IMPROVED]
    origin = pl.Series(improved.origin).replace_strict(_ORIGINS, return_dtype=pl.String)
    columns = (*improved.keypoints1.T, improved.inlier, improved.score, origin)
    return [pl.Series(name, values) for name, values in zip(names, columns, strict=True) if values is not None]


def _images(source: Path, table: pl.DataFrame, pair: Int) -> list[PairImages]:
    """The images of each pair, in the order of the numbers of the pairs."""
    for name in _IMAGES:
        if name not in table.columns:
            raise ValueError(
                f"{source} has no column {name!r}, which names the images of each pair, it has {table.columns}"
            )
        if table[name].dtype != pl.String or table[name].has_nulls():
            raise ValueError(f"{source}: column {name!r} must name an image in every row")
    first = np.unique(pair, return_index=True)[1]
    for name in _IMAGES:
        differs = table[name].to_numpy() != table[name].to_numpy()[first][pair]
        if differs.any():
            row = int(differs.argmax())
            raise ValueError(f"{_place(source, table, row)}: column {name!r} must be the same in all rows of a pair")
    named = table.select(_IMAGES)[first]
    return [PairImages(*names) for names in named.iter_rows()]


def _earlier(table: pl.DataFrame) -> list[str]:
    """The columns that an earlier filter wrote."""
    for names in earlier_results(table.columns):
        inlier, relation = (table[name].cast(pl.String, strict=False) for name in (names.inlier, names.relation))
        if inlier.is_in(["true", "false"]).all() and relation.is_in(list(_RELATIONS.values())).all():
            return [name for name in (*names, *later_results(table.columns, names.relation, _IMPROVED)) if name]
    return []


def _pair_numbers(source: Path, table: pl.DataFrame) -> Int:
    """(M,) number of the pair of each row, in any order without gaps."""
    if "pair" not in table.columns:
        return np.zeros(len(table), dtype=np.int64)
    pair = table["pair"]
    if not (pair.dtype.is_integer() or pair.dtype in (pl.String, pl.Categorical, pl.Enum)):
        raise ValueError(f"{source}: column 'pair' must hold strings or integers, got {pair.dtype}")
    if pair.has_nulls():
        raise ValueError(f"{_line(source, pair.is_null().arg_max() or 0)}: column 'pair' is empty")
    if not pair.dtype.is_integer():
        pair = pair.cast(pl.String).str.strip_chars()
        if pair.str.contains(r"^-?(0|[1-9]\d{0,14})(\.0*)?$").all():  # then 1 and 1.0 are one pair
            pair = pair.cast(pl.Float64)
    ranks: Int = pair.rank("dense").to_numpy().astype(np.int64) - 1
    return ranks


def _to_matches(
    source: Path,
    table: pl.DataFrame,
    pair: Int,
    order: Int,
) -> Matches:
    """The checked matches, row k of them being row ``order[k]`` of the table."""
    x0, y0, x1, y1 = (_numbers(source, table, name, pl.Float64) for name in _POINTS)
    views = np.stack([x0, y0], axis=1), np.stack([x1, y1], axis=1)
    for names, points in zip(("x0, y0", "x1, y1"), views, strict=True):
        check_range(points, lambda row, names=names: f"{_place(source, table, row)}: ({names})")  # type: ignore[misc]
    cost = group = None
    if "cost" in table.columns:
        values = _numbers(source, table, "cost", pl.Float64)
        if np.isnan(values).any():
            row = int(np.isnan(values).argmax())
            raise ValueError(f"{_place(source, table, row)}: column 'cost' must not be NaN")
        cost = torch.from_numpy(values[order])
    if "group" in table.columns:
        group = torch.from_numpy(_numbers(source, table, "group", pl.Int64)[order])
    ptr = lengths_to_ptr(torch.from_numpy(np.bincount(pair, minlength=1)))
    left, right = (torch.from_numpy(points[order]) for points in views)
    return Matches(left, right, ptr, cost, group)


def _numbers(source: Path, table: pl.DataFrame, name: str, dtype: type[pl.DataType]) -> Array:
    """A column as numbers; raises for the first row that holds none."""
    column = table[name]
    noun = "an integer" if dtype == pl.Int64 else "a number"
    if column.dtype == pl.String:
        text = column.str.strip_chars()
        values = text.cast(dtype, strict=False)
        if dtype == pl.Int64:  # other tools write 1.0
            values = values.fill_null(_whole(text.cast(pl.Float64, strict=False)))
    elif column.dtype.is_integer() or (column.dtype.is_numeric() and dtype == pl.Float64):
        values = column.cast(dtype, strict=False)
    elif column.dtype.is_float():
        values = _whole(column.cast(pl.Float64))
    else:
        raise ValueError(f"{source}: column {name!r} must hold {noun} per row, got {column.dtype}")
    if values.has_nulls():
        row = values.is_null().arg_max() or 0
        place = f"{_place(source, table, row)}: column {name!r}"
        raise ValueError(f"{place} must be {noun}, got {column[row]!r}" if column[row] else f"{place} is empty")
    return values.to_numpy()


def _whole(values: pl.Series) -> pl.Series:
    """Numbers that are integers as such, null elsewhere."""
    is_whole = (values == values.round()) & (values.abs() < 2**53)
    return values.set(~is_whole.fill_null(value=False), None).cast(pl.Int64, strict=False)


def _place(source: Path, table: pl.DataFrame, row: int) -> str:
    return _line(source, row) + (f" (pair {table['pair'][row]!r})" if "pair" in table.columns else "")


def _line(source: Path, row: int) -> str:
    """Where a row of the table stands: the line that an editor shows, below the header, or a number from 1."""
    return f"{source}, line {row + 2}" if has_ending(source, ".csv") else f"{source}, row {row + 1}"
