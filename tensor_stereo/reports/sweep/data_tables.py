"""The tables that the page's script sorts and filters, as plain data."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from tensor_stereo.reports.sweep.compare import ENDS, METRICS, Comparison
from tensor_stereo.reports.sweep.pooling import pool_trials
from tensor_stereo.reports.sweep.results import RunResults
from tensor_stereo.reports.sweep.rows import SCORE_RATES, VERDICT_RATES, total_seconds
from tensor_stereo.reports.sweep.settings import SETTINGS, setting_text, varying_settings
from tensor_stereo.reports.sweep.summary import MAX_FAILURES, RATE_HEADINGS

MAX_ROWS = 20_000  # of pairs and trials; more would make a page that no browser likes
_RATES = VERDICT_RATES + SCORE_RATES


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        heading: its name.
        values: one per row: numbers, None where there is none, or texts.
        group: heading over several neighbours.
        decimals: digits after the point; None prints numbers as they are.
        none: what stands for None.
        select: whether a list of its values filters the table.
        kind: ``rate`` draws a bar from 0 to 1, ``signed`` prints a plus.
    """

    heading: str
    values: list[Any]
    group: str = ""
    decimals: int | None = None
    none: str = "–"
    select: bool = False
    kind: str = ""

    def payload(self) -> dict[str, Any]:
        """What the script reads: texts as places in a list of distinct ones."""
        head = {"heading": self.heading, "group": self.group, "select": self.select, "kind": self.kind}
        if any(isinstance(value, str) for value in self.values):
            places = {text: k for k, text in enumerate(dict.fromkeys(map(str, self.values)))}
            return head | {"texts": list(places), "values": [places[str(value)] for value in self.values]}
        digits = 6 if self.decimals is None else self.decimals + 1
        numbers = [_number(value, digits) for value in self.values]
        return head | {"decimals": self.decimals, "none": self.none, "values": numbers}


@dataclass(frozen=True)
class DataTable:
    """A table of the page: ``id`` of its element, a caption for screen readers, the columns."""

    id: str
    caption: str
    columns: tuple[Column, ...]

    def payload(self) -> dict[str, Any]:
        """What the script reads."""
        return {"id": self.id, "caption": self.caption, "columns": [column.payload() for column in self.columns]}


def script_json(value: Any) -> str:
    r"""JSON that is safe inside a script element: nothing in it can end the element or open another.

    >>> script_json({"scene": "</script>"})
    '{"scene":"\\u003c/script\\u003e"}'
    """
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def trials_data(runs: Sequence[RunResults]) -> DataTable:
    """One row per trial of every run."""
    frame = _stack([pool_trials(run.rows.trials) for run in runs])
    columns = [
        *_run_column(runs, frame),
        Column("trial", frame["trial"].to_list(), decimals=0),
        *_setting_columns(frame, varying_settings([run.rows.trials for run in runs])),
        Column("pairs", frame["num_pairs"].to_list(), decimals=0),
        Column("matches", frame["num_valid"].to_list(), decimals=0),
        *_rate_columns(frame, group="pairs pooled"),
        *_rate_columns(frame, group="mean over pairs", prefix="mean_")[1:],  # without the fraction that is incorrect
        Column("ms", (1000 * frame["seconds"]).to_list(), decimals=1),
    ]
    return DataTable("trials", "Trials", tuple(columns))


def pairs_data(runs: Sequence[RunResults]) -> DataTable:
    """One row per pair and trial of every run, the first ``MAX_ROWS`` at most."""
    frames = [run.rows.head(MAX_ROWS // len(runs)) for run in runs]
    frames = [frame.with_columns((total_seconds() * 1000).alias("ms")) for frame in frames]
    names = ("trial", *SETTINGS, "dataset", "scene", "num_valid", "num_untested", *_RATES, "ms")
    frame = _stack([frame.select(names) for frame in frames])
    columns = [
        *_run_column(runs, frame),
        Column("data set", frame["dataset"].to_list(), select=frame["dataset"].n_unique() > 1),
        Column("scene", frame["scene"].to_list()),
        Column("trial", frame["trial"].to_list(), decimals=0),
        *_setting_columns(frame, varying_settings([run.rows.trials for run in runs])),
        Column("matches", frame["num_valid"].to_list(), decimals=0),
        Column("untested", frame["num_untested"].to_list(), decimals=0),
        *_rate_columns(frame),
        Column("ms", frame["ms"].to_list(), decimals=1),
    ]
    return DataTable("pairs", "Pairs and trials", tuple(columns))


def failures_data(runs: Sequence[RunResults]) -> DataTable:
    """One row per failed unit of every run, the first ``MAX_FAILURES`` of each at most."""
    names = ("dataset", "scene", "detector", "stage", "error", "message", "attempts")
    frame = _stack([run.errors.bottom_k(MAX_FAILURES, by="unit").sort("unit").select(names) for run in runs])
    headings = {"dataset": "data set"}
    columns = [
        Column(
            headings.get(name, name),
            ["" if value is None else value for value in frame[name]],
            decimals=0,
            select=name in ("detector", "stage", "error") and frame[name].n_unique() > 1,
        )
        for name in names
    ]
    return DataTable("failures", "Failed units", (*_run_column(runs, frame), *columns))


def differences_data(runs: Sequence[RunResults], comparison: Comparison) -> DataTable:
    """One row per point of settings that both runs have."""
    frame = comparison.trials
    varying = varying_settings([run.rows.trials for run in runs])
    columns = [
        Column("trial of A", frame["trial"].to_list(), decimals=0),
        Column("trial of B", frame["trial_b"].to_list(), decimals=0),
        *_setting_columns(frame, [name for name in varying if name not in comparison.changed]),
        Column("pairs", frame["num_pairs"].to_list(), decimals=0),
        *(
            Column({"mean": "B - A"}.get(end, end), frame[f"{name}_{end}"].to_list(), heading, 3, kind="signed")
            for name, heading in METRICS.items()
            for end in ENDS
        ),
    ]
    return DataTable("differences", "Differences by trial", tuple(columns))


def only_data(runs: Sequence[RunResults], comparison: Comparison) -> DataTable:
    """Points of settings that one run alone has."""
    frame = comparison.only
    columns = [
        Column("run", frame["run"].to_list(), select=True),
        Column("trial", frame["trial"].to_list(), decimals=0),
        *_setting_columns(frame, varying_settings([run.rows.trials for run in runs])),
    ]
    return DataTable("only", "Settings of one run alone", tuple(columns))


def _stack(frames: Sequence[pl.DataFrame]) -> pl.DataFrame:
    """The rows of all runs, with their letter as ``run``."""
    lettered = [frame.with_columns(run=pl.lit("AB"[k])) for k, frame in enumerate(frames)]
    return pl.concat(lettered, how="vertical_relaxed")


def _run_column(runs: Sequence[RunResults], frame: pl.DataFrame) -> list[Column]:
    return [Column("run", frame["run"].to_list(), select=True)] if len(runs) > 1 else []


def _setting_columns(frame: pl.DataFrame, names: Iterable[str]) -> list[Column]:
    """Words and switches as text, numbers as numbers."""
    columns = []
    for name in names:
        values = frame[name].to_list()
        if not frame.schema[name].is_numeric():
            values = [setting_text(name, value) for value in values]
        columns.append(Column(SETTINGS[name].heading, values, none=SETTINGS[name].none, select=True))
    return columns


def _rate_columns(frame: pl.DataFrame, group: str = "", prefix: str = "") -> list[Column]:
    return [Column(RATE_HEADINGS[name], frame[prefix + name].to_list(), group, 3, kind="rate") for name in _RATES]


def _number(value: float | None, digits: int) -> float | None:
    """JSON has no NaN; more digits than are shown would only swell the page."""
    if value is None or math.isnan(value):
        return None
    return value if isinstance(value, int) else round(value, digits)
