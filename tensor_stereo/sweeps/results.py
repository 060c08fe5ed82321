"""What a run folder holds, as tables and tensors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
import torch
from torch import Tensor

from tensor_stereo.configs import SweepConfig
from tensor_stereo.evaluation.rows import setting_columns
from tensor_stereo.sweeps.grid import expand_grid
from tensor_stereo.sweeps.journal import read_journals
from tensor_stereo.sweeps.store import MATCHES_SCHEMA, METRICS_SCHEMA, errors_table, read_config_file
from tensor_stereo.table_files import scan_parquet
from tensor_stereo.types import Matches


@dataclass(frozen=True, eq=False)
class StoredMatches:
    """The matches of one pair under one setting, as a training loop wants them.

    Attributes:
        matches: the putative matches, without groups.
        inlier: (M,) bool, the verdict.
        relation: (M,) int8 values of :class:`tensor_stereo.Relation`.
        score: (M,) float32, or None.
        correct: (M,) bool, False where ground truth is unknown.
        valid: (M,) bool, ground truth is known.
    """

    matches: Matches
    inlier: Tensor
    relation: Tensor
    score: Tensor | None
    correct: Tensor
    valid: Tensor


def read_results(run: Path | str) -> pl.DataFrame:
    """One row per finished unit and trial, in this order, with the columns of ``METRICS_SCHEMA``.

    The columns of the settings come from the configuration of the run, so that they are the same for parts that an
    earlier release wrote without some of them.

    Raises:
        FileNotFoundError: if ``run`` is no run folder.
        ValueError: if it has a format that this release does not read.
    """
    table = _read_parts(run, "metrics", METRICS_SCHEMA).collect().sort("unit", "trial")
    settings = [setting_columns(trial) for trial in read_config(run).trials]
    names = settings[0].keys()
    known = pl.DataFrame(settings, schema={name: METRICS_SCHEMA[name] for name in names})
    known = known.with_row_index("trial").cast({"trial": METRICS_SCHEMA["trial"]})
    return table.drop(names).join(known, on="trial", how="left", maintain_order="left").select(list(METRICS_SCHEMA))


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


def read_matches(run: Path | str, dataset: str, scene: str, *, trial: int = 0) -> StoredMatches:
    """The matches of one pair under one point of the grid, of a sweep that keeps them.

    Args:
        run: run folder of a sweep with ``export_matches``.
        dataset: as in the manifest.
        scene: as in the manifest.
        trial: number of the point in ``config.json``.

    Raises:
        FileNotFoundError: if ``run`` is no run folder.
        ValueError: if it has a format that this release does not read, or holds no such unit, or no matches.
    """
    rows = _read_parts(run, "metrics", METRICS_SCHEMA).filter(dataset=dataset, scene=scene, trial=trial)
    units = rows.select("unit", "score").collect()
    if not len(units):
        raise ValueError(f"{run} has no finished unit of {dataset}/{scene} with trial {trial}")
    stored = _read_parts(run, "matches", MATCHES_SCHEMA).filter(unit=units["unit"][0], trial=trial)
    table = stored.collect()
    if not any(Path(run, "matches").glob("part-*.parquet")):
        raise ValueError(f"{run} keeps no matches; set export_matches = true above the grid")
    columns = {name: torch.from_numpy(table[name].to_numpy(writable=True)) for name in ("x0", "y0", "x1", "y1")}
    has_score = units["score"][0] != "none"
    cost, score = (
        torch.from_numpy(table[name].to_numpy(writable=True)) if there else None
        for name, there in (("cost", not table["cost"].null_count()), ("score", has_score))
    )
    return StoredMatches(
        matches=Matches(
            torch.stack([columns["x0"], columns["y0"]], 1),
            torch.stack([columns["x1"], columns["y1"]], 1),
            torch.tensor([0, len(table)]),
            cost,
        ),
        inlier=torch.tensor(table["inlier"].to_list(), dtype=torch.bool),
        relation=torch.tensor(table["relation"].to_list(), dtype=torch.int8),
        score=score,
        correct=torch.tensor(table["correct"].fill_null(value=False).to_list(), dtype=torch.bool),
        valid=torch.tensor(table["correct"].is_not_null().to_list(), dtype=torch.bool),
    )


def _read_parts(run: Path | str, folder: str, schema: dict[str, Any]) -> pl.LazyFrame:
    """The finished parts of one kind as one table."""
    run = _check_run(run)
    names = sorted(name for name in read_journals(run).files if name.startswith(f"{folder}/"))
    return scan_parquet([run / name for name in names], schema)  # parts of an earlier release may lack columns


def _check_run(run: Path | str) -> Path:
    run = Path(run)
    if not (run / "config.json").is_file():
        raise FileNotFoundError(f"{run} is no run of a sweep: it has no config.json")
    read_config_file(run / "config.json")
    return run
