"""The rows of a run, read a batch at a time: what they add up to per trial, and single ones by their numbers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import polars as pl
import torch
from torch import Tensor

from tensor_stereo.evaluation.rows import ROW_SCHEMA, SCORE_BINS, STAGES
from tensor_stereo.reports.sweep.settings import SETTINGS

RESULT_COLUMNS = ("unit", *ROW_SCHEMA, "host")
CELLS = ("true_positive", "false_positive", "true_negative", "false_negative")
TOTALS = ("num_matches", "num_valid", "num_untested", *CELLS)
VERDICT_RATES = ("fraction_incorrect", "sensitivity", "specificity", "ppv", "npv", "precision", "recall")
SCORE_RATES = ("auc", "specificity_at_sensitivity_96")
COUNTS = ("score_counts_correct", "score_counts_incorrect")
TIMES = (*STAGES, "total")
# Added up as whole numbers, sums are the same in any order of the rows.
RATE_UNIT = 2.0**-32  # of two billion rows 64 bits hold the sum
SECONDS_UNIT = 1e-9
BALANCED = (pl.col("sensitivity") + pl.col("specificity")) / 2
_BATCH = 1 << 14
_UNIT_COLUMNS = ("unit", "trial")


@dataclass(frozen=True, eq=False)
class RunRows:
    """One row per unit (one pair under one detector setting) and trial (one point of the grid) of a run.

    Attributes:
        lazy: the rows, with ``RESULT_COLUMNS`` but those of the settings.
        trials: (T) one row per trial that has rows, by number: ``trial``, its settings, ``num_rows``, ``num_pairs``;
            the sums of ``TOTALS`` and ``COUNTS``, these null where a row has none; for each rate ``sum_`` + name in
            ``RATE_UNIT`` and ``num_`` + name, over the rows where it is defined; the same for each of ``TIMES`` in
            ``SECONDS_UNIT``, over the rows in which the stage ran; ``hosts``.
        units: one row per row: ``unit``, ``trial``, ``pair`` (a hash of its names), ``balanced_accuracy`` (mean of
            sensitivity and specificity), ``is_outside`` (of the domain of its score).
    """

    lazy: pl.LazyFrame
    trials: pl.DataFrame
    units: pl.DataFrame

    @classmethod
    def of(cls, rows: pl.DataFrame | pl.LazyFrame, settings: pl.DataFrame | None = None) -> RunRows:
        """Add up the rows.

        Args:
            rows: with ``RESULT_COLUMNS``; none is fine. Those of the settings may lack if these are given.
            settings: ``trial`` and the settings of each; those in the rows if not given.

        Raises:
            ValueError: if a column is missing, a unit has two rows for one trial, or a score is not counted in
                ``SCORE_BINS`` bins.
        """
        lazy = rows.lazy()
        columns = lazy.collect_schema().names()
        needed = RESULT_COLUMNS if settings is None else [name for name in RESULT_COLUMNS if name not in SETTINGS]
        missing = [name for name in needed if name not in columns]
        if missing:
            raise ValueError(f"results must have the columns {', '.join(missing)}, got {', '.join(columns)}")
        if settings is None:
            settings = lazy.select("trial", *SETTINGS).unique().collect()
        lazy = lazy.drop(SETTINGS, strict=False)
        units = lazy.select(
            *_UNIT_COLUMNS,
            pair_key().alias("pair"),
            BALANCED.alias("balanced_accuracy"),
            (pl.col("domain") != "").fill_null(value=False).alias("is_outside"),
        ).collect()
        _check_unique(units)
        pairs = units.group_by("trial").agg(pl.col("pair").n_unique().alias("num_pairs"))
        sums = lazy.group_by("trial").agg(_sums()).collect(engine="streaming")
        trials = settings.join(sums, on="trial").join(pairs, on="trial").join(_scores(lazy, sums), on="trial")
        return cls(lazy, trials.sort("trial"), units)

    def __len__(self) -> int:
        return len(self.units)

    def find(self, keys: pl.DataFrame) -> pl.DataFrame:
        """Whole rows without the counts of scores, by ``unit`` and ``trial``, in the order of ``keys``.

        Further columns of ``keys`` are kept.
        """
        found = self.lazy.select(pl.exclude(COUNTS)).join(keys.lazy(), on=_UNIT_COLUMNS, how="semi")
        rows = found.collect(engine="streaming")
        settings = self.trials.select("trial", *SETTINGS)
        return keys.join(rows, on=_UNIT_COLUMNS, maintain_order="left").join(
            settings, on="trial", maintain_order="left"
        )

    def head(self, num: int) -> pl.DataFrame:
        """The first rows, by unit and trial, as of :meth:`find`."""
        return self.find(self.units.select(_UNIT_COLUMNS).bottom_k(num, by=_UNIT_COLUMNS).sort(_UNIT_COLUMNS))


def pair_key() -> pl.Expr:
    """A number of 64 bits for the name of a pair."""
    return pl.struct("dataset", "scene").hash()


def total_seconds() -> pl.Expr:
    """Wall time of all stages of each row."""
    return pl.sum_horizontal(pl.col("seconds").struct.field(name) for name in STAGES)


def _check_unique(units: pl.DataFrame) -> None:
    keys = units.select(_UNIT_COLUMNS)
    if keys.n_unique() < len(keys):
        unit, trial = keys.filter(keys.is_duplicated()).row(0)
        raise ValueError(f"results must have one row per unit and trial, got unit {unit}, trial {trial} twice")


def _sums() -> Iterable[pl.Expr]:
    """All that is added up but the counts of scores."""
    yield pl.len().alias("num_rows")
    yield pl.col("host").drop_nulls().unique().implode().alias("hosts")
    for name in TOTALS:
        yield pl.col(name).sum()
    rates = [(name, pl.col(name).fill_nan(None), RATE_UNIT) for name in VERDICT_RATES + SCORE_RATES]
    stages = [pl.col("seconds").struct.field(name) for name in STAGES] + [total_seconds()]
    times = [(name, pl.when(s > 0).then(s), SECONDS_UNIT) for name, s in zip(TIMES, stages, strict=True)]
    for name, value, unit in (*rates, *times):
        yield (value / unit).round().cast(pl.Int64).sum().alias(f"sum_{name}")
        yield value.count().alias(f"num_{name}")


def _scores(lazy: pl.LazyFrame, totals: pl.DataFrame) -> pl.DataFrame:
    """The sums of ``COUNTS`` per trial of ``totals``, null where a row has none."""
    trials: list[int] = totals["trial"].sort().to_list()
    num_rows = int(totals["num_rows"].sum())
    sums = torch.zeros(2, len(trials), SCORE_BINS, dtype=torch.int64)
    unscored = np.zeros(len(trials), bool)
    num_seen = 0
    for batch in lazy.select("trial", *COUNTS).collect_batches(chunk_size=_BATCH):
        num_seen += len(batch)
        scored = batch.drop_nulls(COUNTS)
        place = np.searchsorted(trials, scored["trial"].to_numpy())
        for k, name in enumerate(COUNTS):
            sums[k].index_add_(0, torch.from_numpy(place), _bins(name, scored[name]))
        without = batch.filter(pl.any_horizontal(pl.col(COUNTS).is_null()))["trial"].unique()
        unscored[np.searchsorted(trials, without.to_numpy())] = True
    if num_seen < num_rows:
        raise OSError(f"only {num_seen} of {num_rows} rows can be decoded")
    lists = {
        name: [None if skip else row for skip, row in zip(unscored, part, strict=True)]
        for name, part in zip(COUNTS, sums.tolist(), strict=True)
    }
    schema = {name: ROW_SCHEMA[name] for name in ("trial", *COUNTS)}
    return pl.DataFrame({"trial": trials} | lists, schema=schema)


def _bins(name: str, lists: pl.Series) -> Tensor:
    """(N, SCORE_BINS) of N lists."""
    wrong = [length for length in lists.list.len().unique() if length != SCORE_BINS]
    if wrong:
        raise ValueError(f"results must have {SCORE_BINS} bins in {name}, got {min(wrong)}")
    return torch.from_numpy(lists.explode().to_numpy().reshape(-1, SCORE_BINS).copy())
