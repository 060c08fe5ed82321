"""What a worker gives back, as tables. Imports no torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import polars as pl

from tensor_stereo.evaluation.rows import ROW_SCHEMA

METRICS_SCHEMA: dict[str, Any] = {
    "unit": pl.Int32,  # number of the unit in the plan
    **ROW_SCHEMA,
    "host": pl.String,  # of the worker
    "attempt": pl.Int32,  # how many workers have tried the unit
}
ERRORS_SCHEMA: dict[str, Any] = {
    "unit": pl.Int32,
    "dataset": pl.String,
    "scene": pl.String,
    "detector": pl.String,
    "stage": pl.String,  # read, one of the stages of a trial, or worker
    "error": pl.String,  # name of the exception
    "message": pl.String,
    "attempts": pl.Int32,
}
MATCHES_SCHEMA: dict[str, Any] = {
    "unit": pl.Int32,
    "trial": pl.Int32,
    **dict.fromkeys(("x0", "y0", "x1", "y1"), pl.Float32),  # px
    "cost": pl.Float32,
    "inlier": pl.Boolean,
    "relation": pl.Int8,  # values of Relation
    "score": pl.Float32,  # null without score
    "correct": pl.Boolean,  # null where ground truth is unknown
}


class BatchResult(NamedTuple):
    """What became of the units of a batch.

    Attributes:
        done: numbers of the units with rows.
        errors: one record with the fields of ``ERRORS_SCHEMA`` for each other unit.
        metrics: the rows, with the columns of ``METRICS_SCHEMA``.
        matches: the matches of all rows, with the columns of ``MATCHES_SCHEMA``; None if the sweep does not keep them.
        seconds: that the batch took.
    """

    done: tuple[int, ...]
    errors: tuple[dict[str, Any], ...]
    metrics: pl.DataFrame
    matches: pl.DataFrame | None = None
    seconds: float = 0.0

    @property
    def num_units(self) -> int:
        return len(self.done) + len(self.errors)


def make_batch(
    rows: Sequence[dict[str, Any]],
    errors: Sequence[dict[str, Any]] = (),
    matches: Sequence[pl.DataFrame] | None = None,
    seconds: float = 0.0,
) -> BatchResult:
    """Put the rows, the failures and the matches of some units together.

    >>> make_batch([{"unit": 3, "trial": 0}, {"unit": 3, "trial": 1}]).done
    (3,)
    """
    done = tuple(dict.fromkeys(int(row["unit"]) for row in rows))
    stored = None
    if matches is not None:
        stored = pl.concat(matches) if matches else pl.DataFrame(schema=MATCHES_SCHEMA)
    return BatchResult(done, tuple(errors), pl.DataFrame(rows, METRICS_SCHEMA), stored, seconds)
