"""From a run folder to what its report is made from."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from tensor_stereo.datasets import read_pair
from tensor_stereo.datasets.pair_table import PairTable
from tensor_stereo.evaluation.trials import TrialRunner
from tensor_stereo.reports.sweep.overlays import draw_overlay
from tensor_stereo.reports.sweep.pooling import worst_pairs
from tensor_stereo.reports.sweep.results import Overlay, RunResults
from tensor_stereo.reports.sweep.rows import RunRows
from tensor_stereo.sweeps import read_config, read_errors
from tensor_stereo.sweeps.results import read_settings, scan_results

LOG = logging.getLogger(__name__)


def load_run(run: Path | str, *, num_overlays: int = 2) -> RunResults:
    """Read a run folder, and draw the worst pairs of each detector anew.

    Args:
        run: folder of :func:`tensor_stereo.sweeps.run_sweep`, finished or not.
        num_overlays: pictures per detector, of its :func:`~tensor_stereo.reports.sweep.pooling.worst_pairs`; a pair
            whose images cannot be read has none, which is logged.

    Raises:
        FileNotFoundError: if ``run`` is no run folder.
    """
    run = Path(run)
    rows = RunRows.of(scan_results(run), read_settings(run))
    environment = run / "environment.json"
    return RunResults(
        name=run.resolve().name,
        rows=rows,
        errors=read_errors(run),
        config=json.loads((run / "config.json").read_text(encoding="utf-8")),
        environment=json.loads(environment.read_text(encoding="utf-8")) if environment.exists() else [],
        overlays=tuple(_overlays(run, rows, num_overlays)),
    )


def _overlays(run: Path, rows: RunRows, num_pairs: int) -> list[Overlay]:
    if num_pairs == 0:
        return []
    table = PairTable(run / "manifest.parquet", check_files=False)
    trials = read_config(run).trials
    drawn = []
    for row in worst_pairs(rows, num_pairs).iter_rows(named=True):
        pair = table.find(row["dataset"], row["scene"])
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
