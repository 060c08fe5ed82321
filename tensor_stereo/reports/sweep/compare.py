"""Two runs on the same pairs: what differs, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tensor_stereo.reports.sweep.pooling import with_repeat
from tensor_stereo.reports.sweep.rows import RunRows, pair_key
from tensor_stereo.reports.sweep.settings import SETTINGS, order_detectors, setting_text

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
_WEIGHTS_AT_ONCE = 1 << 24  # of pairs in resamples


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


def compare_runs(a: RunRows, b: RunRows) -> Comparison:
    """Pair the rows of two runs by settings and pair of images.

    A setting that has one value in run A and another one in run B, be it per detector or score, is what the runs are
    compared for: trials that agree in all others are paired.

    Intervals are percentiles (95 %) of the mean over pairs drawn with replacement, 2000 times from seed 0; all points
    see the same draws. They say how far the mean depends on which pairs there are, nothing about other data sets.
    """
    changed = _changed_settings(a.trials, b.trials)
    keys = [*(name for name in SETTINGS if name not in changed), "repeat"]
    points_a, points_b = _points(a.trials, keys), _points(b.trials, keys)
    both = [(row, points_b[key]["trial"]) for key, row in points_a.items() if key in points_b]
    names_a, names_b = _pair_names(a), _pair_names(b)
    common = names_a.join(names_b.select("pair"), on="pair", how="semi").sort(_PAIR)["pair"]
    values = [_metrics(rows, common, trials) for rows, trials in (
        (a, [row["trial"] for row, _ in both]), (b, [trial for _, trial in both])
    )]  # fmt: skip
    there = values[0][1] & values[1][1]
    differences = np.where(there, values[1][0] - values[0][0], np.nan)
    compared = [k for k in range(len(both)) if there[:, k].any()]
    of_trials = _summarise(differences, there, [[k] for k in compared])
    trials = [both[k][0] | {"trial_b": both[k][1]} | found for k, found in zip(compared, of_trials, strict=True)]
    of_detector = {
        name: [k for k in compared if both[k][0]["detector"] == name]
        for name in order_detectors({both[k][0]["detector"] for k in compared})
    }
    if len(of_detector) > 1:
        of_detector["all"] = compared
    detectors = [
        {"detector": name} | _summarise(differences, there, [of])[0] | {"num_settings": len(of)}
        for name, of in of_detector.items()
    ]
    only = [
        {"run": run} | row
        for run, points, others in (("A", points_a, points_b), ("B", points_b, points_a))
        for key, row in points.items()
        if key not in others
    ]
    schema: dict[str, Any] = {name: a.trials.schema[name] for name in ("trial", *SETTINGS)}
    ends = {"num_pairs": pl.Int64} | {f"{name}_{end}": pl.Float64 for name in METRICS for end in ENDS}
    return Comparison(
        changed={name: (_values(a.trials, name), _values(b.trials, name)) for name in changed},
        trials=pl.DataFrame(trials, schema=schema | {"trial_b": pl.Int32} | ends).sort("trial"),
        detectors=pl.DataFrame(detectors, schema={"detector": pl.String} | ends | {"num_settings": pl.Int64}),
        only=pl.DataFrame(only, schema={"run": pl.String} | schema),
        num_common_pairs=len(common),
        only_pairs=(_only(names_a, names_b), _only(names_b, names_a)),
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
        rng, means = np.random.default_rng(SEED), []
        at_once = max(1, _WEIGHTS_AT_ONCE // num_pairs)
        for first in range(0, NUM_RESAMPLES, at_once):
            draws = rng.integers(0, num_pairs, (min(at_once, NUM_RESAMPLES - first), num_pairs))
            weight = np.stack([np.bincount(draw, minlength=num_pairs) for draw in draws]).astype(np.float64)
            drawn = weight @ known[:, enough]
            means.append(np.divide(weight @ filled[:, enough], drawn, out=np.full_like(drawn, np.nan), where=drawn > 0))
        low[enough], high[enough] = np.nanquantile(np.concatenate(means), [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return mean, low, high


def _changed_settings(trials_a: pl.DataFrame, trials_b: pl.DataFrame) -> list[str]:
    """Settings that follow from the detector, or detector and score, in both runs, but not in the same way."""
    changed = []
    for name in SETTINGS:
        for parents in (("detector",), ("detector", "score")):
            if name not in parents:
                a, b = _follows(trials_a, parents, name), _follows(trials_b, parents, name)
                if a is not None and b is not None:
                    changed += [name] if any(a[key] != b[key] for key in a.keys() & b.keys()) else []
                    break
    return changed


def _follows(trials: pl.DataFrame, parents: Sequence[str], name: str) -> dict[tuple[Any, ...], Any] | None:
    """The value of a setting for each value of its parents; None if some have several."""
    rows = trials.select(*parents, name).unique().rows()
    values = {row[:-1]: row[-1] for row in rows}
    return values if len(values) == len(rows) else None


def _values(trials: pl.DataFrame, name: str) -> str:
    return ", ".join(setting_text(name, value) for value in trials[name].unique().sort(nulls_last=True))


def _points(trials: pl.DataFrame, keys: Sequence[str]) -> dict[tuple[Any, ...], dict[str, Any]]:
    """Trial and settings of each point, by some of them and its number among those that agree in all."""
    points = with_repeat(trials).select("trial", *SETTINGS, "repeat").sort("trial")
    return {tuple(row[name] for name in keys): row for row in points.iter_rows(named=True)}


def _pair_names(rows: RunRows) -> pl.DataFrame:
    """``pair`` and the names of each pair."""
    return rows.lazy.select(pair_key().alias("pair"), *_PAIR).unique("pair").collect(engine="streaming")


def _only(names: pl.DataFrame, others: pl.DataFrame) -> list[str]:
    """The names of the pairs that the others lack."""
    rows = names.join(others.select("pair"), on="pair", how="anti").select(_PAIR).rows()
    return sorted("/".join(row) for row in rows)


def _metrics(rows: RunRows, pairs: pl.Series, trials: Sequence[int]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(M, P, T) of each of ``METRICS``, NaN where undefined, and (P, T) whether there is such a row."""
    place = pl.DataFrame({"pair": pairs}).with_row_index("p")
    column = pl.DataFrame({"trial": pl.Series(trials, dtype=rows.trials.schema["trial"])}).with_row_index("t")
    found = (
        rows.lazy.select("trial", pair_key().alias("pair"), *METRICS)
        .join(column.lazy(), on="trial")
        .join(place.lazy(), on="pair")
        .collect(engine="streaming")
    )
    values = np.full((len(METRICS), len(pairs), len(trials)), np.nan)
    there = np.zeros((len(pairs), len(trials)), bool)
    p, t = found["p"].to_numpy(), found["t"].to_numpy()
    there[p, t] = True
    for k, name in enumerate(METRICS):
        values[k, p, t] = found[name].fill_null(np.nan).to_numpy()
    return values, there


def _summarise(
    differences: NDArray[np.float64], there: NDArray[np.bool_], groups: Sequence[Sequence[int]]
) -> list[dict[str, float]]:
    """Number of pairs, mean and interval of each metric for some groups of points, which see the same draws of pairs.

    Args:
        differences: (M, P, T) of ``METRICS``.
        there: (P, T) whether both runs have the row.
        groups: points; every pair's mean over those of a group counts once.
    """
    some = there[:, [k for of in groups for k in of]].any(1)
    if not groups:
        return []
    averaged = np.stack([_mean(differences[:, some][:, :, of]) for of in groups])  # (G, M, P)
    ends = bootstrap_means(averaged.reshape(-1, averaged.shape[2]).T)
    parts = [values.reshape(averaged.shape[:2]) for values in ends]
    return [
        {"num_pairs": int(there[:, of].any(1).sum())}
        | {f"{name}_{end}": float(parts[e][g, m]) for m, name in enumerate(METRICS) for e, end in enumerate(ENDS)}
        for g, of in enumerate(groups)
    ]


def _mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Over the known ones of the last axis; NaN without any."""
    known = ~np.isnan(values)
    count = known.sum(-1)
    mean = np.full(count.shape, np.nan)
    np.divide(np.where(known, values, 0).sum(-1), count, out=mean, where=count > 0)
    return mean
