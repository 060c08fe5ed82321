"""What a worker does: units of work in, their rows or the reason why there are none out."""

from __future__ import annotations

import platform
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tensor_stereo.configs import SweepConfig
from tensor_stereo.datasets import PairFiles, read_pair
from tensor_stereo.evaluation.trials import Trial, TrialRunner
from tensor_stereo.scores.domain import DomainWarning
from tensor_stereo.sweeps.plan import Task


@dataclass(frozen=True, eq=False)
class UnitResult:
    """What became of one unit.

    Attributes:
        unit: its number in the plan.
        rows: one record per trial; empty if the unit failed.
        error: dataset, scene, detector, stage, error (name of the type) and message of a failure, or None.
        matches: columns of every match of every trial, if the sweep keeps them.
        attempt: how many workers have tried, with this one.
    """

    unit: int
    rows: list[dict[str, Any]]
    error: dict[str, str] | None = None
    matches: dict[str, NDArray[Any]] | None = None
    attempt: int = 1


def run_tasks(config: SweepConfig, tasks: Sequence[Task]) -> list[UnitResult]:
    """Run units one after another, on one thread; the images of a pair are read once for its consecutive units.

    No exception leaves: a unit that raises becomes a result with an error, and the next one runs.
    """
    limit_threads()
    results = []
    runner: TrialRunner | None = None
    files: PairFiles | None = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DomainWarning)  # the rows say it, and with them the log
        for task in tasks:
            try:
                if runner is None or files != task.files:
                    runner = None  # the last pair's images go before the next ones come
                    runner, files = TrialRunner(read_pair(task.files)), task.files
                results.append(_run_unit(config, task, runner))
            except Exception as error:
                results.append(failed_unit(config, task, runner.stage if runner else "read", error))
    return results


def failed_unit(config: SweepConfig, task: Task, stage: str, error: Exception) -> UnitResult:
    """The result of a unit that raised."""
    record = {
        "dataset": task.files.dataset,
        "scene": task.files.scene,
        "detector": config.trials[task.trials[0]].detector,
        "stage": stage,
        "error": type(error).__name__,
        "message": " ".join(str(error).split()),
    }
    return UnitResult(task.unit, [], record, attempt=task.attempt)


def limit_threads() -> None:
    """One thread for each worker: as many workers as cores, and none waits for another."""
    if torch.get_num_threads() != 1:
        torch.set_num_threads(1)
    cv2.setNumThreads(1)


def _run_unit(config: SweepConfig, task: Task, runner: TrialRunner) -> UnitResult:
    rows, tables = [], []
    names = {"dataset": task.files.dataset, "scene": task.files.scene}  # as the manifest has them
    origin = names | {"host": platform.node(), "attempt": task.attempt}
    for number in task.trials:
        trial = runner.run(config.trials[number])
        rows.append({"unit": task.unit, "trial": number} | trial.row() | origin)
        if config.export_matches:
            tables.append(_match_columns(number, trial))
    matches = None
    if tables:
        matches = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    return UnitResult(task.unit, rows, matches=matches, attempt=task.attempt)


def _match_columns(number: int, trial: Trial) -> dict[str, NDArray[Any]]:
    matches, verdict = trial.matches, trial.classification
    nothing = torch.full((matches.num_matches,), torch.nan, dtype=torch.float32)
    return {
        "trial": np.full(matches.num_matches, number, np.int32),
        "x0": matches.keypoints0[:, 0].numpy(),
        "y0": matches.keypoints0[:, 1].numpy(),
        "x1": matches.keypoints1[:, 0].numpy(),
        "y1": matches.keypoints1[:, 1].numpy(),
        "cost": (nothing if matches.cost is None else matches.cost).numpy(),
        "inlier": verdict.inlier.numpy(),
        "relation": verdict.relation.numpy(),
        "score": (nothing if trial.score is None else trial.score).float().numpy(),
        "correct": trial.correct.numpy(),
        "valid": trial.valid.numpy(),
    }
