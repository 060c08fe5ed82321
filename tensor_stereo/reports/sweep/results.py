"""What a report is made from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import polars as pl

from tensor_stereo.evaluation.rows import ROW_SCHEMA, SCORE_BINS

RESULT_COLUMNS = ("unit", *ROW_SCHEMA, "host")
ERROR_COLUMNS = ("unit", "dataset", "scene", "detector", "stage", "error", "message", "attempts")
COUNTS = ("score_counts_correct", "score_counts_incorrect")
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Overlay:
    """A picture of one pair.

    Attributes:
        caption: what it shows; also its text alternative.
        png: the bytes of a PNG file.

    Raises:
        ValueError: if ``png`` does not start as a PNG file does.
    """

    caption: str
    png: bytes

    def __post_init__(self) -> None:
        if not self.png.startswith(_PNG_SIGNATURE):
            raise ValueError(f"png of {self.caption!r} must be a PNG file, got {self.png[:8]!r}...")


@dataclass(frozen=True, eq=False)
class RunResults:
    """One sweep: its rows, its failures and where they come from.

    Attributes:
        name: what the report calls the run.
        results: one row per unit (one pair under one detector setting) and trial (one point of the grid), with the
            columns of :data:`tensor_stereo.evaluation.dataset.ROW_SCHEMA` and ``unit``, ``host``; none is fine.
        errors: one row per failed unit, columns ``ERROR_COLUMNS``.
        config: settings of the run, ready for JSON.
        environment: versions and machine of each session that worked on the run.
        overlays: pictures of the worst pairs, in the order in which they are shown.

    Raises:
        ValueError: if a column is missing, a unit has two rows for one trial, or a score is not counted in
            ``SCORE_BINS`` bins.
    """

    name: str
    results: pl.DataFrame
    errors: pl.DataFrame
    config: dict[str, Any]
    environment: list[dict[str, Any]]
    overlays: tuple[Overlay, ...] = ()

    def __post_init__(self) -> None:
        _check_columns("results", self.results, RESULT_COLUMNS)
        _check_columns("errors", self.errors, ERROR_COLUMNS)
        twice = self.results.filter(self.results.select("unit", "trial").is_duplicated())
        if len(twice):
            unit, trial = twice.select("unit", "trial").row(0)
            raise ValueError(f"results must have one row per unit and trial, got unit {unit}, trial {trial} twice")
        for name in COUNTS:
            lengths = set(self.results[name].drop_nulls().list.len()) - {SCORE_BINS}
            if lengths:
                raise ValueError(f"results must have {SCORE_BINS} bins in {name}, got {min(lengths)}")


def _check_columns(name: str, frame: pl.DataFrame, expected: Iterable[str]) -> None:
    missing = [column for column in expected if column not in frame.columns]
    if missing:
        raise ValueError(f"{name} must have the columns {', '.join(missing)}, got {', '.join(frame.columns)}")
