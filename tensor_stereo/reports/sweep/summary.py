"""The tables that page and Markdown share."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import polars as pl

from tensor_stereo.reports.sweep.compare import METRICS, Comparison
from tensor_stereo.reports.sweep.drawing import run_prefix
from tensor_stereo.reports.sweep.pooling import best_trials, stage_times
from tensor_stereo.reports.sweep.results import RunResults
from tensor_stereo.reports.sweep.rows import SCORE_RATES, VERDICT_RATES
from tensor_stereo.reports.sweep.settings import (
    PERTURBATIONS,
    SETTINGS,
    setting_text,
    settings_label,
    varying_settings,
)
from tensor_stereo.reports.tables import Cell, Table

RATE_HEADINGS = {
    "fraction_incorrect": "incorrect",
    "sensitivity": "sens.",
    "specificity": "spec.",
    "ppv": "PPV",
    "npv": "NPV",
    "precision": "precision",
    "recall": "recall",
    "auc": "AUC",
    "specificity_at_sensitivity_96": "spec.@.96",
}
EXPLANATION = (
    "Positive means estimated incorrectly: sensitivity is the fraction of incorrect matches that are rejected, "
    "specificity the fraction of correct matches that are kept; precision and recall are those of the kept correct "
    "matches, and equal to NPV and specificity; spec.@.96 is the specificity that a score reaches at "
    "sensitivity .96."
)
MAX_FAILURES = 1000  # of one run, written out
_MAX_VALUES = 12  # of a setting, written out


def run_counts(run: RunResults) -> dict[str, int]:
    """How much a run holds."""
    units = run.rows.units
    return {
        "pairs": units["pair"].n_unique(),
        "units": units["unit"].n_unique(),
        "trials": len(run.rows.trials),
        "rows": len(units),
        "pairs outside of the domain": units.filter("is_outside")["pair"].n_unique(),
        "failed units": run.errors["unit"].n_unique(),
    }


def summary_table(runs: Sequence[RunResults]) -> Table:
    """What there is, a row per run."""
    counts = [run_counts(run) for run in runs]
    rows: list[tuple[Cell, ...]] = [
        (f"{run_prefix(runs, k)}{run.name}", *counts[k].values()) for k, run in enumerate(runs)
    ]
    return Table("Runs", ("run", *counts[0]), tuple(rows))


def settings_table(runs: Sequence[RunResults]) -> Table:
    """What varies in the grid, what follows from it and what is the same everywhere, a row per setting."""
    varying = varying_settings([run.rows.trials for run in runs])
    rows: list[tuple[Cell, ...]] = []
    for name in [*varying, *(name for name in SETTINGS if name not in varying)]:
        values = pl.concat([run.rows.trials[name] for run in runs]).unique().sort(nulls_last=True).to_list()
        texts: list[str] = [setting_text(name, value) for value in values]
        more = f", ... ({len(texts)} values)" if len(texts) > _MAX_VALUES else ""
        role = "varies" if name in varying else "follows another" if len(texts) > 1 else "fixed"
        rows.append((SETTINGS[name].heading, role, ", ".join(texts[:_MAX_VALUES]) + more))
    return Table("Settings", ("setting", "role", "values"), tuple(rows))


def best_table(run: RunResults) -> Table:
    """The best trial of each detector, pairs pooled."""
    names = _mild_names(run)
    rates = ("fraction_incorrect", "sensitivity", "specificity", *SCORE_RATES)
    rows = tuple(
        (row["detector"].upper(), row["trial"], settings_label(row, names), *(_number(row[name]) for name in rates))
        for row in best_trials(run.rows.trials).iter_rows(named=True)
    )
    columns = ("detector", "trial", "settings", *(RATE_HEADINGS[name] for name in rates))
    title = f"{run.name}: highest mean of sensitivity and specificity on the mildest perturbation, pairs pooled"
    return Table(title, columns, rows, decimals=3)


def trial_tables(run: RunResults, pooled: pl.DataFrame, varying: Sequence[str]) -> list[Table]:
    """Rates of every trial from the counts of all pairs together, and as means over the pairs."""
    rates = VERDICT_RATES + SCORE_RATES
    tables = []
    for title, prefix in (("pairs pooled", ""), ("mean over the pairs", "mean_")):
        rows = tuple(
            (
                row["trial"],
                *(setting_text(name, row[name]) for name in varying),
                row["num_pairs"],
                row["num_valid"],
                *(_number(row[prefix + name]) for name in rates),
            )
            for row in pooled.iter_rows(named=True)
        )
        headings = ("trial", *(SETTINGS[name].heading for name in varying), "pairs", "matches")
        columns = (*headings, *(RATE_HEADINGS[name] for name in rates))
        tables.append(Table(f"{run.name}: trials, {title}", columns, rows, decimals=3))
    return tables


def runtime_table(runs: Sequence[RunResults]) -> Table:
    """Mean ms by stage and detector, over the rows in which a stage ran."""
    times = [stage_times(run.rows.trials) for run in runs]
    stages = list(dict.fromkeys(name for frame in times for name in frame.columns[1:]))
    stages.sort(key=lambda name: name == "total")
    rows = tuple(
        (f"{run_prefix(runs, k)}{row['detector'].upper()}", *(_number(row.get(stage)) for stage in stages))
        for k, frame in enumerate(times)
        for row in frame.iter_rows(named=True)
    )
    return Table("Run-time in ms per pair, mean over the trials in which a stage ran", ("detector", *stages), rows)


def worst_table(run: RunResults) -> Table:
    """The pairs on which even the best trial does badly."""
    columns = ("pair", "detector", "trial", "settings", "matches", "incorrect", "sens.", "spec.", "mean of both")
    names = _mild_names(run)
    rates = ("fraction_incorrect", "sensitivity", "specificity", "balanced_accuracy")
    rows = tuple(
        (
            pair_name(row),
            row["detector"].upper(),
            row["trial"],
            settings_label(row, names),
            row["num_valid"],
            *(row[name] for name in rates),
        )
        for row in run.worst.iter_rows(named=True)
    )
    return Table(f"{run.name}: pairs on which even the best trial does badly", columns, rows, decimals=3)


def failure_table(run: RunResults) -> Table:
    """Units without a result, and why; the first ``MAX_FAILURES`` at most."""
    columns = ("pair", "detector", "stage", "error", "message", "attempts")
    shown = run.errors.bottom_k(MAX_FAILURES, by="unit").sort("unit")
    rows = tuple((pair_name(row), *(_text(row[name]) for name in columns[1:])) for row in shown.iter_rows(named=True))
    which = (
        f"the first {len(shown):,} of {len(run.errors):,} failed units"
        if len(shown) < len(run.errors)
        else "failed units"
    )
    return Table(f"{run.name}: {which}", columns, rows)


def failure_kinds_table(run: RunResults) -> Table:
    """How many units failed by what, the most frequent first."""
    kinds = (
        run.errors.group_by("stage", "error")
        .len("units")
        .sort("units", "stage", "error", descending=[True, False, False])
    )
    rows = tuple((_text(stage), _text(error), units) for stage, error, units in kinds.rows())
    return Table(f"{run.name}: failed units by error", ("stage", "error", "units"), rows)


def environment_table(run: RunResults) -> Table:
    """Versions and machines, a row per entry; sessions that agree share a column."""
    sessions = list(dict.fromkeys(tuple(flatten(item).items()) for item in run.environment))
    names = list(dict.fromkeys(name for session in sessions for name, _ in session))
    rows = tuple((name, *(dict(session).get(name, "") for session in sessions)) for name in names)
    headings = (f"session {k + 1}" for k in range(len(sessions))) if len(sessions) > 1 else ("value",)
    return Table(f"{run.name}: environment", ("entry", *(headings if sessions else ())), rows)


def changed_table(comparison: Comparison) -> Table:
    """The settings that the runs as a whole differ in."""
    rows = tuple((SETTINGS[name].heading, *values) for name, values in comparison.changed.items())
    return Table("What differs between the runs", ("setting", "A", "B"), rows)


def difference_table(comparison: Comparison) -> Table:
    """Mean differences per detector over the common settings, with their intervals."""
    rows = tuple(
        (
            row["detector"] if row["detector"] == "all" else row["detector"].upper(),
            row["num_settings"],
            row["num_pairs"],
            *(interval_text(*(row[f"{name}_{end}"] for end in ("mean", "low", "high"))) for name in METRICS),
        )
        for row in comparison.detectors.iter_rows(named=True)
    )
    columns = ("detector", "settings", "pairs", *METRICS.values())
    return Table("B - A, mean over the common pairs [95 % interval]", columns, rows)


def interval_text(mean: float, low: float, high: float) -> str:
    """A signed mean with its interval.

    >>> interval_text(0.0214, -0.003, 0.045), interval_text(math.nan, math.nan, math.nan)
    ('+0.021 [-0.003, +0.045]', '–')
    """
    if math.isnan(mean):
        return "–"
    return f"{mean:+.3f}" if math.isnan(low) else f"{mean:+.3f} [{low:+.3f}, {high:+.3f}]"


def pair_name(row: Mapping[str, Any]) -> str:
    """Data set and scene."""
    return "/".join(filter(None, (row["dataset"], row["scene"])))


def _mild_names(run: RunResults) -> list[str]:
    """Settings worth a label where run and detector are named and the perturbation is the mildest."""
    return [name for name in varying_settings([run.rows.trials]) if name not in ("detector", *PERTURBATIONS)]


def flatten(value: Any, name: str = "") -> dict[str, str]:
    """Nested settings as text under dotted names.

    >>> flatten({"python": "3.11", "versions": {"torch": "2.4"}})
    {'python': '3.11', 'versions.torch': '2.4'}
    """
    if isinstance(value, Mapping):
        parts = (flatten(item, f"{name}.{key}" if name else str(key)) for key, item in value.items())
        return {key: text for part in parts for key, text in part.items()}
    return {name: _text(value)}


def _text(value: Any) -> str:
    return "" if value is None else str(value)


def _number(value: float | None) -> Cell:
    return math.nan if value is None else value
