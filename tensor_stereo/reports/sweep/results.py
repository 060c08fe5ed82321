"""What a report is made from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import polars as pl

from tensor_stereo.reports.sweep.pooling import worst_pairs
from tensor_stereo.reports.sweep.rows import RunRows

ERROR_COLUMNS = ("unit", "dataset", "scene", "detector", "stage", "error", "message", "attempts")
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
        rows: one per unit and trial, and what they add up to.
        errors: one row per failed unit, columns ``ERROR_COLUMNS``.
        config: settings of the run, ready for JSON.
        environment: versions and machine of each session that worked on the run.
        overlays: pictures of the worst pairs, in the order in which they are shown.

    Raises:
        ValueError: if a column of ``errors`` is missing.
    """

    name: str
    rows: RunRows
    errors: pl.DataFrame
    config: dict[str, Any]
    environment: list[dict[str, Any]]
    overlays: tuple[Overlay, ...] = ()

    @cached_property
    def worst(self) -> pl.DataFrame:
        """The :func:`~tensor_stereo.reports.sweep.pooling.worst_pairs` that page and Markdown list."""
        return worst_pairs(self.rows)

    def __post_init__(self) -> None:
        missing = [name for name in ERROR_COLUMNS if name not in self.errors.columns]
        if missing:
            raise ValueError(f"errors must have the columns {', '.join(missing)}, got {', '.join(self.errors.columns)}")
