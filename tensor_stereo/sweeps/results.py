"""What a run folder holds, as tables. Imports no torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import polars as pl

from tensor_stereo.configs import SweepConfig, TrialConfig
from tensor_stereo.evaluation.rows import setting_columns
from tensor_stereo.sweeps.batches import METRICS_SCHEMA
from tensor_stereo.sweeps.grid import expand_grid
from tensor_stereo.sweeps.journal import read_journals
from tensor_stereo.sweeps.store import errors_table, read_config_file
from tensor_stereo.table_files import scan_parquet


def read_results(run: Path | str) -> pl.DataFrame:
    """One row per finished unit and trial, in this order, with the columns of ``METRICS_SCHEMA``.

    The columns of the settings come from the configuration of the run, so that they are the same for parts that an
    earlier release wrote without some of them.

    Raises:
        FileNotFoundError: if ``run`` is no run folder.
        ValueError: if it has a format that this release does not read.
    """
    table = scan_results(run).collect().sort("unit", "trial")
    return table.join(read_settings(run), on="trial", how="left", maintain_order="left").select(list(METRICS_SCHEMA))


def scan_results(run: Path | str) -> pl.LazyFrame:
    """The rows of :func:`read_results` without their settings, lazily and in any order."""
    return scan_parts(run, "metrics", METRICS_SCHEMA).drop(setting_columns(TrialConfig()))


def read_settings(run: Path | str) -> pl.DataFrame:
    """One row per point of the grid: ``trial``, its number, and the columns of its settings."""
    settings = [{"trial": k} | setting_columns(trial) for k, trial in enumerate(read_config(run).trials)]
    return pl.DataFrame(settings, schema={name: METRICS_SCHEMA[name] for name in settings[0]})


def read_config(run: Path | str) -> SweepConfig:
    """The points of the grid, in the order of their numbers.

    Raises:
        FileNotFoundError: if ``run`` is no run folder.
        ValueError: if it has a format that this release does not read.
    """
    stored = read_config_file(_check_run(run) / "config.json")["sweep"]
    trials = tuple(trial for table in stored["trials"] for trial in expand_grid([table]))
    return SweepConfig(trials, stored["export_matches"])


def read_errors(run: Path | str) -> pl.DataFrame:
    """One row per failed unit, with the columns of ``ERRORS_SCHEMA``.

    Raises:
        FileNotFoundError: if ``run`` is no run folder.
        ValueError: if it has a format that this release does not read.
    """
    return errors_table(_check_run(run))


def has_ground_truth(run: Path | str) -> bool:
    """Whether any match of a run has known ground truth; True of a run without rows."""
    counts = scan_parts(run, "metrics", METRICS_SCHEMA).select(pl.len(), pl.col("num_valid").max()).collect()
    rows, most = counts.row(0)
    return not rows or bool(most)


def scan_parts(run: Path | str, folder: str, schema: dict[str, Any]) -> pl.LazyFrame:
    """The finished parts of one kind as one lazy table.

    Args:
        run: run folder.
        folder: ``metrics`` or ``matches``.
        schema: its columns; those that a part lacks are null.
    """
    return scan_parquet(finished_parts(run, folder), schema)  # parts of an earlier release may lack columns


def finished_parts(run: Path | str, folder: str) -> list[Path]:
    """The files of one kind that the journals list, ``metrics`` or ``matches``."""
    run = _check_run(run)
    return [run / name for name in sorted(read_journals(run).files) if name.startswith(f"{folder}/")]


def _check_run(run: Path | str) -> Path:
    run = Path(run)
    if not (run / "config.json").is_file():
        raise FileNotFoundError(f"{run} is no run of a sweep: it has no config.json")
    read_config_file(run / "config.json")
    return run
