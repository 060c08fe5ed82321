"""Two runs on the same pairs: what differs, and how sure that is."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tensor_stereo.reports.sweep.pooling import SETTINGS, order_detectors, setting_text, with_repeat

METRICS = {
    "sensitivity": "sensitivity",
    "specificity": "specificity",
    "auc": "AUC",
    "specificity_at_sensitivity_96": "spec.@.96",
}
ENDS = ("mean", "low", "high")
NUM_RESAMPLES = 2000
SEED = 0
LEVEL = 0.95
_PAIR = ("dataset", "scene")


@dataclass(frozen=True, eq=False)
class Comparison:
    """Run B minus run A.

    Attributes:
        changed: the settings that the runs as a whole differ in, with the values of run A and of run B as text.
        trials: one row per common point of the other settings: ``trial`` of run A and ``trial_b``, the settings of run
            A, ``num_pairs``, and for each of ``METRICS`` the mean difference over the pairs (``_mean``) and the ends of
            its interval (``_low``, ``_high``); NaN where no pair has a difference, and for the interval where just one
            has.
        detectors: the same per ``detector``, and for ``all`` if there are several; each pair's differences are
            averaged over its ``num_settings`` points first.
        only: ``run`` (A or B), ``trial`` and settings of the points that one run alone has.
        num_common_pairs: pairs that both runs have rows of.
        only_pairs: names of the pairs that A alone has, and B alone.
    """

    changed: dict[str, tuple[str, str]]
    trials: pl.DataFrame
    detectors: pl.DataFrame
    only: pl.DataFrame
    num_common_pairs: int
    only_pairs: tuple[list[str], list[str]]


def compare_runs(results_a: pl.DataFrame, results_b: pl.DataFrame) -> Comparison:
    """Pair the rows of two runs by settings and pair of images.

    A setting that has one value in run A and another one in run B, be it per detector or score, is what the runs are
    compared for: trials that agree in all others are paired.

    Intervals are percentiles (95 %) of the mean over pairs drawn with replacement, 2000 times from seed 0; all points
    see the same draws. They say how far the mean depends on which pairs there are, nothing about other data sets.
    """
    changed = _changed_settings(results_a, results_b)
    keys = [*(name for name in SETTINGS if name not in changed), "repeat"]
    points_a, points_b = _points(results_a, keys), _points(results_b, keys)
    partner = {row["trial"]: points_b[key]["trial"] for key, row in points_a.items() if key in points_b}
    rows_a = results_a.filter(pl.col("trial").is_in(list(partner)))
    rows_a = rows_a.with_columns(pl.Series("trial_b", [partner[trial] for trial in rows_a["trial"]], pl.Int32))
    both = rows_a.join(results_b, left_on=[*_PAIR, "trial_b"], right_on=[*_PAIR, "trial"], suffix="_b")
    differences = both.select(
        "trial", "detector", *_PAIR, *((pl.col(f"{name}_b") - pl.col(name)).alias(name) for name in METRICS)
    ).sort("trial", *_PAIR)
    trials = _summarise(differences, "trial")
    settings = [row | {"trial_b": partner[row["trial"]]} for row in points_a.values() if row["trial"] in partner]
    detectors = order_detectors(differences["detector"].unique())
    parts = [differences.filter(pl.col("detector") == name) for name in detectors]
    if len(parts) > 1:
        parts.append(differences.with_columns(detector=pl.lit("all")))
    only = [
        {"run": run} | row
        for run, points, others in (("A", points_a, points_b), ("B", points_b, points_a))
        for key, row in points.items()
        if key not in others
    ]
    names = [{"/".join(row) for row in frame.select(*_PAIR).unique().iter_rows()} for frame in (results_a, results_b)]
    schema: dict[str, Any] = {name: results_a.schema[name] for name in ("trial", *SETTINGS)}
    return Comparison(
        changed={name: (_values(results_a, name), _values(results_b, name)) for name in changed},
        trials=pl.DataFrame(settings, schema=schema | {"trial_b": pl.Int32}).join(trials, on="trial").sort("trial"),
        detectors=pl.concat([_of_detector(part) for part in parts or [differences]]),
        only=pl.DataFrame(only, schema={"run": pl.String} | schema),
        num_common_pairs=len(names[0] & names[1]),
        only_pairs=(sorted(names[0] - names[1]), sorted(names[1] - names[0])),
    )


def bootstrap_means(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Means over pairs with percentile intervals.

    Args:
        values: (P, T) one column per quantity, NaN where a pair has none.

    Returns:
        mean, low, high: (T,) each. The mean is NaN without a value, the ends with fewer than two.

    Source: Efron, "Bootstrap methods: another look at the jackknife", 1979; the percentile interval.

    Example:
        >>> mean, low, high = bootstrap_means(np.array([[1.0, np.nan], [3.0, 5.0]]))
        >>> mean.tolist(), low.tolist(), high.tolist()
        ([2.0, 5.0], [1.0, nan], [3.0, nan])
    """
    num_pairs, num_values = values.shape
    known = ~np.isnan(values)
    filled = np.where(known, values, 0.0)
    count = known.sum(0)
    mean = np.divide(filled.sum(0), count, out=np.full(num_values, np.nan), where=count > 0)
    low, high = np.full((2, num_values), np.nan)
    enough = np.flatnonzero(count > 1)
    if len(enough):
        draws = np.random.default_rng(SEED).integers(0, num_pairs, (NUM_RESAMPLES, num_pairs))
        weight = np.zeros((NUM_RESAMPLES, num_pairs))
        np.add.at(weight, (np.arange(NUM_RESAMPLES)[:, None], draws), 1)
        drawn = weight @ known[:, enough]
        means = np.divide(weight @ filled[:, enough], drawn, out=np.full_like(drawn, np.nan), where=drawn > 0)
        low[enough], high[enough] = np.nanquantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return mean, low, high


def _changed_settings(results_a: pl.DataFrame, results_b: pl.DataFrame) -> list[str]:
    """Settings that follow from the detector, or detector and score, in both runs, but not in the same way."""
    changed = []
    for name in SETTINGS:
        for parents in (("detector",), ("detector", "score")):
            if name not in parents:
                a, b = _follows(results_a, parents, name), _follows(results_b, parents, name)
                if a is not None and b is not None:
                    changed += [name] if any(a[key] != b[key] for key in a.keys() & b.keys()) else []
                    break
    return changed


def _follows(results: pl.DataFrame, parents: Sequence[str], name: str) -> dict[tuple[Any, ...], Any] | None:
    """The value of a setting for each value of its parents; None if some have several."""
    rows = results.select(*parents, name).unique().rows()
    values = {row[:-1]: row[-1] for row in rows}
    return values if len(values) == len(rows) else None


def _values(results: pl.DataFrame, name: str) -> str:
    return ", ".join(setting_text(name, value) for value in results[name].unique().sort(nulls_last=True))


def _points(results: pl.DataFrame, keys: Sequence[str]) -> dict[tuple[Any, ...], dict[str, Any]]:
    """Trial and settings of each point, by some of them and its number among those that agree in all."""
    points = with_repeat(results).select("trial", *SETTINGS, "repeat").unique().sort("trial")
    return {tuple(row[name] for name in keys): row for row in points.iter_rows(named=True)}


def _of_detector(differences: pl.DataFrame) -> pl.DataFrame:
    """One row: every pair's mean over its settings, then over the pairs."""
    averaged = differences.group_by("detector", *_PAIR, maintain_order=True).agg(
        pl.col(list(METRICS)).fill_nan(None).mean()
    )
    num_settings = pl.lit(differences["trial"].n_unique()).alias("num_settings")
    return _summarise(averaged, "detector").with_columns(num_settings)


def _summarise(differences: pl.DataFrame, key: str) -> pl.DataFrame:
    """Number of pairs, mean and interval of each metric, per value of ``key``."""
    row, pairs = _codes(differences.select(*_PAIR).rows())
    column, keys = _codes(differences[key].to_list())
    summary: dict[str, NDArray[np.float64]] = {}
    for name in METRICS:
        values = np.full((len(pairs), len(keys)), np.nan)
        values[row, column] = differences[name].fill_null(np.nan).to_numpy()
        ends = bootstrap_means(values)
        summary |= {f"{name}_{end}": part for end, part in zip(ENDS, ends, strict=True)}
    num_pairs = np.bincount(column, minlength=len(keys))
    return pl.DataFrame({key: pl.Series(keys, dtype=differences.schema[key]), "num_pairs": num_pairs} | summary)


def _codes(values: Sequence[Hashable]) -> tuple[list[int], list[Hashable]]:
    """The number of each value in order of first appearance, and the values in that order."""
    numbers: dict[Hashable, int] = {}
    return [numbers.setdefault(value, len(numbers)) for value in values], list(numbers)
