"""Parquet tables with odd columns: matches, and manifests of pairs."""

from __future__ import annotations

import datetime
import io
from collections.abc import Callable, Sequence
from contextlib import suppress
from random import Random
from typing import Any

import polars as pl

from tests.fuzz.mutations import FLOATS, NUMBERS, mutate_bytes
from tests.fuzz.seeds import write_parquet

_NAMES = (
    "x0", "y0", "x1", "y1", "pair", "cost", "group", "inlier", "score", "relation", "inlier_adjacency",
    "inlier_cardinality",
    "probability", "", "ü", "a" * 3000, "^x.*$", "*", "image0", "scene", "dataset", "gt_scale", "width_px", "mask",
    "x0\n",
)  # fmt: skip
_STRINGS = (
    "", " ", "a", "x" * 300_000, "a\x00b", "a\nb", "/dev/null", "/", ".", "..", "a" * 300, "left.png", "right.png",
    "gt.png",
    "s.toml", "m.parquet", "[left].png", "~", "\u2028", "sintel", "scaled", "Scaled", "nan", "-1", "1e5", "a/" * 3000,
    "\ufeff",
)  # fmt: skip
_DTYPES: tuple[Any, ...] = (
    pl.Int8, pl.Int16, pl.Int32, pl.Int64, pl.Int128, pl.UInt8, pl.UInt16, pl.UInt32, pl.UInt64, pl.Float32,
    pl.Float64, pl.String,
    pl.Boolean, pl.Binary, pl.Date, pl.Datetime("us"), pl.Datetime("ns", "Asia/Tokyo"), pl.Duration("ms"), pl.Time,
    pl.Categorical, pl.Decimal(20, 3), pl.Null, pl.Enum(["a", "scene 0"]),
)  # fmt: skip
_FORMS: tuple[dict[str, Any], ...] = (
    {}, {"compression": "uncompressed"}, {"compression": "uncompressed", "statistics": False},
    {"compression": "snappy"},
    {"compression": "lz4"}, {"compression": "gzip"}, {"compression": "brotli"}, {"row_group_size": 3},
    {"data_page_size": 16},
)  # fmt: skip


def mutate_parquet(data: bytes, others: Sequence[bytes], rng: Random) -> bytes:
    """Write a table again with other columns, and maybe change its bytes."""
    rows = pl.read_parquet(io.BytesIO(data))
    for _ in range(rng.choice((1, 1, 2, 3))):
        with suppress(pl.exceptions.PolarsError, pl.exceptions.PanicException, TypeError, ValueError, OverflowError):
            rows = rng.choice(_CHANGES)(rows, rng)
    try:
        made = write_parquet(rows, **rng.choice(_FORMS))
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException):  # a type that Parquet has not
        made = data
    return mutate_bytes(made, others, rng) if rng.random() < 0.25 or made == data else made


def _column(rows: pl.DataFrame, rng: Random) -> str:
    return rng.choice(rows.columns) if rows.columns else "x0"


def _cast(rows: pl.DataFrame, rng: Random) -> pl.DataFrame:
    name = _column(rows, rng)
    return rows.with_columns(rows[name].cast(rng.choice(_DTYPES), strict=False))


def _extreme(rows: pl.DataFrame, rng: Random) -> pl.DataFrame:
    name = _column(rows, rng)
    values = rows[name].to_list()
    for _ in range(rng.choice((1, 1, 2, len(values))) if values else 0):
        values[rng.randrange(len(values))] = _value(rows[name].dtype, rng)
    return rows.with_columns(pl.Series(name, values, dtype=rows[name].dtype, strict=False))


def _value(dtype: pl.DataType, rng: Random) -> Any:
    if rng.random() < 0.1:
        return None
    if dtype == pl.String:
        return rng.choice(_STRINGS)
    return rng.choice(FLOATS if dtype.is_float() else NUMBERS)


def _replace(rows: pl.DataFrame, rng: Random) -> pl.DataFrame:
    """A column of another kind altogether."""
    num = len(rows)
    nested: tuple[Any, ...] = (
        [[1.0, 2.0]] * num, [[]] * num, [None] * num, [{"a": 1, "b": [2]}] * num, [{}] * num, [b"\xff"] * num,
        [True] * num,
        [datetime.date(1, 1, 1)] * num, [datetime.time(1)] * num, [[[["a"]]]] * num, ["x" * 10_000] * num,
        [{"a": None}] * num,
    )  # fmt: skip
    name = _column(rows, rng) if rng.random() < 0.7 else rng.choice(_NAMES)
    return rows.with_columns(pl.Series(name, rng.choice(nested)))


def _arrays(rows: pl.DataFrame, rng: Random) -> pl.DataFrame:
    name, width = _column(rows, rng), rng.choice((0, 1, 2, 50))
    return rows.with_columns(pl.Series(name, [[0.0] * width] * len(rows), dtype=pl.Array(pl.Float64, width)))


def _drop(rows: pl.DataFrame, rng: Random) -> pl.DataFrame:
    return rows.drop(_column(rows, rng))


def _rename(rows: pl.DataFrame, rng: Random) -> pl.DataFrame:
    return rows.rename({_column(rows, rng): rng.choice(_NAMES)})


def _copy(rows: pl.DataFrame, rng: Random) -> pl.DataFrame:
    return rows.with_columns(rows[_column(rows, rng)].alias(rng.choice(_NAMES)))


def _resize(rows: pl.DataFrame, rng: Random) -> pl.DataFrame:
    if rng.random() < 0.2:
        return rows.select(pl.col(_column(rows, rng)))
    return rng.choice((rows.head(0), rows.head(1), rows.head(3), pl.concat([rows] * 20), rows[::-1], pl.DataFrame()))


def _nothing(rows: pl.DataFrame, rng: Random) -> pl.DataFrame:
    name = _column(rows, rng)
    return rows.with_columns(pl.when(pl.int_range(pl.len()) % rng.choice((1, 2, 5)) > 0).then(pl.col(name)).alias(name))


_CHANGES: tuple[Callable[[pl.DataFrame, Random], pl.DataFrame], ...] = (
    _cast, _cast, _cast, _extreme, _extreme, _extreme, _replace, _replace, _arrays, _drop, _rename, _copy, _resize,
    _nothing,
)  # fmt: skip
