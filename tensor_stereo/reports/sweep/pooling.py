"""From the sums of every trial to rates: counts added up over the pairs, and means over them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import polars as pl
import torch

from tensor_stereo.evaluation.metrics import PAPER_SENSITIVITY, Confusion, ScoreCounts
from tensor_stereo.evaluation.rows import SCORE_BINS
from tensor_stereo.reports.sweep.rows import (
    BALANCED,
    CELLS,
    COUNTS,
    RATE_UNIT,
    SCORE_RATES,
    SECONDS_UNIT,
    TIMES,
    TOTALS,
    VERDICT_RATES,
    RunRows,
)
from tensor_stereo.reports.sweep.settings import PERTURBATIONS, SETTINGS, order_detectors


def decided_by_score(row: Mapping[str, Any]) -> bool:
    """Whether the verdict of a row is one of the score.

    >>> decided_by_score({"verdict": "adjacency"}), decided_by_score({"verdict": "score"})
    (False, True)
    """
    return bool(row["verdict"] == "score")


def mildest(trials: pl.DataFrame) -> pl.DataFrame:
    """The trials with the fewest added outliers of their detector and, of these, the least noise."""
    for name in PERTURBATIONS:
        trials = trials.filter(pl.col(name) == pl.col(name).min().over("detector"))
    return trials


def pool_trials(trials: pl.DataFrame, *, over: Sequence[str] = ()) -> pl.DataFrame:
    """One row per trial.

    Args:
        trials: sums of one run, as :attr:`RunRows.trials`, or some rows of them.
        over: settings to pool as well, ``("seed",)`` adds the repetitions up; ``trial`` is the first one then, and
            ``num_pairs`` that of the one with the most.

    Returns:
        ``trial``, ``repeat``, the settings but those of ``over``, ``num_pairs``; the counts ``TOTALS`` and ``COUNTS``
        added up, with the rates that follow from them under their own names; ``mean_`` + name, the mean of each rate
        over the pairs where it is defined; ``seconds``, the mean over the pairs. Undefined rates are NaN, undefined
        means null; AUC and specificity at sensitivity .96 are null without score.
    """
    rates = VERDICT_RATES + SCORE_RATES
    keys = [name for name in SETTINGS if name not in over]
    sums = (
        with_repeat(trials)
        .sort("trial")
        .group_by(*keys, "repeat", maintain_order=True)
        .agg(
            pl.col("trial").first(),
            pl.col("num_pairs").max(),
            pl.col(TOTALS).sum(),
            *(_mean(name, RATE_UNIT).alias(f"mean_{name}") for name in rates),
            (pl.col("sum_total").sum() * SECONDS_UNIT / pl.col("num_rows").sum()).alias("seconds"),
            *(pl.col(name) for name in COUNTS),
        )
    )
    added = [pl.Series(name, [_added(lists) for lists in sums[name]], sums.schema[name].inner) for name in COUNTS]  # type: ignore[attr-defined]
    pooled = sums.with_columns(added)
    found = [_rates(row) for row in pooled.iter_rows(named=True)]
    return pooled.hstack(pl.DataFrame(found, schema=dict.fromkeys(rates, pl.Float64))).sort("trial")


def _mean(name: str, unit: float) -> pl.Expr:
    """The mean of a rate or time over the rows where it is defined; null without one."""
    num = pl.col(f"num_{name}").sum()
    return pl.when(num > 0).then(pl.col(f"sum_{name}").sum() * unit / num)


def _added(lists: pl.Series) -> list[int] | None:
    """The sum of the score counts of some trials; None if one has none."""
    if lists.null_count():
        return None
    return [sum(column) for column in zip(*lists.to_list(), strict=True)]


def _rates(row: Mapping[str, Any]) -> dict[str, float | None]:
    """The rates of added-up counts."""
    rates: dict[str, float | None] = asdict(Confusion(*(row[name] for name in CELLS)).rates())
    if row[COUNTS[0]] is None:
        return rates | dict.fromkeys(SCORE_RATES)
    counts = score_counts(row)
    return rates | {"auc": counts.auc(), "specificity_at_sensitivity_96": counts.specificity_at(PAPER_SENSITIVITY)}


def with_repeat(trials: pl.DataFrame) -> pl.DataFrame:
    """The same trials with ``repeat``, which numbers those that agree in all ``SETTINGS``.

    There are such where a grid varies a setting that has no column, as the threshold of a detector.
    """
    seen: Counter[tuple[Any, ...]] = Counter()
    numbers = {}
    for trial, *point in trials.select("trial", *SETTINGS).sort("trial").iter_rows():
        numbers[trial] = seen[tuple(point)]
        seen[tuple(point)] += 1
    return trials.with_columns(pl.Series("repeat", [numbers[trial] for trial in trials["trial"]], pl.Int32))


def score_counts(row: Mapping[str, Any]) -> ScoreCounts:
    """The binned scores of a row with a score; a bin stands for its lower end."""
    edges = torch.arange(SCORE_BINS, dtype=torch.float64) / SCORE_BINS
    return ScoreCounts(edges, *(torch.tensor(row[name], dtype=torch.int64) for name in COUNTS))


def stage_times(trials: pl.DataFrame) -> pl.DataFrame:
    """Mean ms of each stage over the rows in which it ran, and of all together, per detector.

    Stages that never ran have no column, and null is for a detector that never had it.
    """
    means = trials.group_by("detector").agg(_mean(name, 1000 * SECONDS_UNIT).alias(name) for name in TIMES)
    ran = [name for name in TIMES if means[name].is_not_null().any()]
    return _in_order(means).select("detector", *ran)


def best_trials(trials: pl.DataFrame) -> pl.DataFrame:
    """The trial of each detector with the highest mean of sensitivity and specificity.

    Of those with the mildest perturbation, pairs pooled. Columns as of :func:`pool_trials`.
    """
    pooled = pool_trials(mildest(trials)).with_columns(balanced_accuracy=BALANCED)
    known = pooled.filter(pl.col("balanced_accuracy").is_not_nan())
    # of equal ones rather one with a score, which tells more
    best = known.sort("balanced_accuracy", pl.col("auc").is_not_null(), "trial", descending=[True, True, False])
    return _in_order(best.unique("detector", keep="first", maintain_order=True))


def worst_pairs(rows: RunRows, num: int = 3) -> pl.DataFrame:
    """The pairs on which even the best trial does badly.

    Of the rows with the mildest perturbation, each pair and detector keeps the one with the highest mean of
    sensitivity and specificity, the first of equal ones. Rows that lack correct or incorrect matches say nothing and
    are left out.

    Args:
        rows: of one run.
        num: how many per detector at most.

    Returns:
        The kept rows where that mean is lowest, the lowest first within a detector, with the mean as
        ``balanced_accuracy``.
    """
    mild = mildest(rows.trials).select("trial", "detector")
    known = rows.units.filter(pl.col("balanced_accuracy").is_not_nan()).join(mild, on="trial")
    best = known.sort("balanced_accuracy", "trial", descending=[True, False]).unique(["pair", "detector"], keep="first")
    limit = pl.col("balanced_accuracy").bottom_k(num).max().over("detector")
    keys = best.filter(pl.col("balanced_accuracy") <= limit).select("unit", "trial", "balanced_accuracy")
    worst = rows.find(keys).sort("balanced_accuracy", "dataset", "scene", "detector")
    return _in_order(worst.group_by("detector", maintain_order=True).head(num))


def _in_order(rows: pl.DataFrame) -> pl.DataFrame:
    """The same rows by detector, those of one detector as they were."""
    parts = [rows.filter(pl.col("detector") == name) for name in order_detectors(rows["detector"].unique())]
    return pl.concat(parts) if parts else rows
