"""From a run folder to what its report is made from."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import polars as pl

from tensor_stereo.datasets import PairFiles, read_manifest, read_pair
from tensor_stereo.reports.sweep.overlays import draw_overlay
from tensor_stereo.reports.sweep.results import Overlay, RunResults
from tensor_stereo.sweeps import read_config, read_errors, read_results
from tensor_stereo.trials import TrialRunner

LOG = logging.getLogger(__name__)


def load_run(run: Path | str, *, num_overlays: int = 2) -> RunResults:
    """Read a run folder, and draw the worst pairs of each detector anew.

    Of each detector the point of the grid counts that has the best mean of sensitivity and specificity over pairs,
    without exchanged matches and noise if there is such a point; its worst pairs are those where that mean is lowest.

    Args:
        run: folder of :func:`tensor_stereo.sweeps.run_sweep`, finished or not.
        num_overlays: pictures per detector; a pair whose images cannot be read has none, which is logged.

    Raises:
        FileNotFoundError: if ``run`` is no run folder.
    """
    run = Path(run)
    results = read_results(run)
    environment = run / "environment.json"
    return RunResults(
        name=run.resolve().name,
        results=results,
        errors=read_errors(run),
        config=json.loads((run / "config.json").read_text(encoding="utf-8")),
        environment=json.loads(environment.read_text(encoding="utf-8")) if environment.exists() else [],
        overlays=tuple(_overlays(run, results, num_overlays)),
    )


def worst_pairs(results: pl.DataFrame, num_pairs: int) -> pl.DataFrame:
    """The rows of ``results`` that :func:`load_run` draws, detector by detector, the worst first.

    >>> from tensor_stereo.evaluation import ROW_SCHEMA
    >>> len(worst_pairs(pl.DataFrame(schema={"unit": pl.Int32} | ROW_SCHEMA), 2))
    0
    """
    rows = results.with_columns(merit=pl.mean_horizontal("sensitivity", "specificity"), harm=_HARM)
    rows = rows.filter(pl.col("merit").is_finite())
    rows = rows.filter(pl.col("harm") == pl.col("harm").min().over("detector"))
    means = rows.group_by("detector", "trial").agg(mean=pl.col("merit").mean())
    best = means.sort("detector", "mean", "trial", descending=[False, True, False]).unique(
        "detector", keep="first", maintain_order=True
    )
    return (
        rows.join(best, on=["detector", "trial"])
        .sort("detector", "merit", "dataset", "scene")
        .group_by("detector", maintain_order=True)
        .head(num_pairs)
    )


_HARM = pl.col("outlier_rate") + pl.col("noise_px")  # smallest where the putative matches are as they were found


def _overlays(run: Path, results: pl.DataFrame, num_pairs: int) -> list[Overlay]:
    files = {(pair.dataset, pair.scene): pair for pair in read_manifest(run / "manifest.parquet", check_files=False)}
    trials = read_config(run).trials
    drawn = []
    for row in worst_pairs(results, num_pairs).iter_rows(named=True):
        pair: PairFiles = files[row["dataset"], row["scene"]]
        try:
            trial = TrialRunner(read_pair(pair)).run(trials[row["trial"]])
        except (OSError, ValueError) as error:
            LOG.warning("no picture of %s/%s: %s", pair.dataset, pair.scene, error)
            continue
        caption = (
            f"{pair.dataset}/{pair.scene}, {row['detector'].upper()}, trial {row['trial']}: "
            f"sensitivity {row['sensitivity']:.2f}, specificity {row['specificity']:.2f}"
        )
        verdict = trial.classification.inlier
        drawn.append(draw_overlay(trial.pair, trial.matches, verdict, trial.correct, trial.valid, caption=caption))
    return drawn
