"""What a worker does: units of work in, their rows or the reason why there are none out."""

from __future__ import annotations

import hashlib
import platform
import time
import warnings
from collections import OrderedDict
from collections.abc import Hashable, Sequence
from typing import Any

import cv2
import numpy as np
import polars as pl
import torch
from torch import Tensor

from tensor_stereo.configs import SweepConfig, TrialConfig
from tensor_stereo.datasets import PairFiles, read_pair
from tensor_stereo.evaluation.rows import stage_keys
from tensor_stereo.evaluation.trials import Trial, TrialRunner
from tensor_stereo.pipeline import ImagePair, detect_images
from tensor_stereo.scores.domain import DomainWarning
from tensor_stereo.sweeps.batches import MATCHES_SCHEMA, BatchResult, make_batch
from tensor_stereo.sweeps.plan import Task, failed_unit
from tensor_stereo.types import Features, StereoPair

_MOST_SECONDS = 3.0  # of a batch, after which it begins no further unit
_IMAGES_HELD = 32  # whose features a worker keeps, for pairs that name them again


class FeatureCache:
    """Features of the images that were last seen, by their contents: each is detected once."""

    def __init__(self) -> None:
        self._held: OrderedDict[Hashable, tuple[Features, float]] = OrderedDict()

    def detect(self, gray: ImagePair, trial: TrialConfig) -> tuple[tuple[Features, Features], float]:
        """Features of both views, and the seconds that they took when they were detected."""
        setting = stage_keys(trial)["detect"]
        views = [(image.shape, hashlib.blake2b(image.numpy().data).digest(), setting) for image in gray]
        for view, image in zip(views, gray, strict=True):
            if view not in self._held:  # each alone, so that no bit depends on which others are held
                start = time.perf_counter()
                (features,) = detect_images([image], trial)
                self._held[view] = features, time.perf_counter() - start
        (features0, seconds0), (features1, seconds1) = (self._held[view] for view in views)
        for view in views:
            self._held.move_to_end(view)
        while len(self._held) > _IMAGES_HELD:
            self._held.popitem(last=False)
        return (features0, features1), seconds0 + seconds1


_FEATURES = FeatureCache()


def run_tasks(config: SweepConfig, tasks: Sequence[Task]) -> BatchResult:
    """Run units one after another, on one thread; the images of a pair are read once for its consecutive units.

    An image that several pairs name is detected once, if not too many others came between. No exception leaves: a unit
    that raises becomes a record, and the next one runs. When the time of a batch is over, the units that are left are
    not begun.
    """
    limit_threads()
    begun = time.monotonic()
    rows: list[dict[str, Any]] = []
    errors = []
    matches: list[pl.DataFrame] = []
    runner: TrialRunner | None = None
    files: PairFiles | None = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DomainWarning)  # the rows say it, and with them the log
        for number, task in enumerate(tasks):
            if number and time.monotonic() - begun > _MOST_SECONDS:
                break
            try:
                if runner is None or files != task.files:
                    runner = None  # the last pair's images go before the next ones come
                    runner, files = _make_runner(task.files), task.files
                of_unit, of_matches = _run_unit(config, task, runner)
            except Exception as error:
                errors.append(failed_unit(config, task, runner.stage if runner else "read", error))
            else:
                rows += of_unit
                matches += of_matches
    return make_batch(rows, errors, matches if config.export_matches else None, time.monotonic() - begun)


def _make_runner(files: PairFiles) -> TrialRunner:
    return TrialRunner(read_pair(files), detect=_FEATURES.detect)


def check_trials(config: SweepConfig) -> None:
    """Run every point once on a small noise image, so that a bad setting is known before a sweep begins.

    Raises:
        ValueError: naming the point.
    """
    noise = torch.randint(0, 256, (1, 64, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    runner = TrialRunner(StereoPair("noise", noise, noise, torch.zeros(64, 64)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DomainWarning)  # noise may be outside of it
        for number, trial in enumerate(config.trials):
            try:
                runner.run(trial)
            except (ValueError, TypeError, RuntimeError, MemoryError) as error:
                raise ValueError(f"point {number} of the grid ({trial.detector}): {error}") from error


def limit_threads() -> None:
    """One thread for each worker: as many workers as cores, and none waits for another."""
    if torch.get_num_threads() != 1:
        torch.set_num_threads(1)
    cv2.setNumThreads(1)


def _run_unit(config: SweepConfig, task: Task, runner: TrialRunner) -> tuple[list[dict[str, Any]], list[pl.DataFrame]]:
    rows, tables = [], []
    names = {"dataset": task.files.dataset, "scene": task.files.scene}  # as the manifest has them
    origin = names | {"host": platform.node(), "attempt": task.attempt}
    for number in task.trials:
        trial = runner.run(config.trials[number])
        rows.append({"unit": task.unit, "trial": number} | trial.row() | origin)
        if config.export_matches:
            tables.append(_match_table(task.unit, number, trial))
    return rows, tables


def _match_table(unit: int, number: int, trial: Trial) -> pl.DataFrame:
    matches, verdict = trial.matches, trial.classification
    count = matches.num_matches

    def or_null(values: Tensor | None) -> pl.Series:
        return pl.Series([None] * count, dtype=pl.Float32) if values is None else pl.Series(values.float().numpy())

    columns = {
        "unit": np.full(count, unit, np.int32),
        "trial": np.full(count, number, np.int32),
        "x0": matches.keypoints0[:, 0].numpy(),
        "y0": matches.keypoints0[:, 1].numpy(),
        "x1": matches.keypoints1[:, 0].numpy(),
        "y1": matches.keypoints1[:, 1].numpy(),
        "cost": or_null(matches.cost),
        "inlier": verdict.inlier.numpy(),
        "relation": verdict.relation.numpy(),
        "score": or_null(trial.score),
        "correct": trial.correct.numpy(),
    }
    known = pl.when(pl.Series(trial.valid.numpy())).then(pl.col("correct"))
    table = pl.DataFrame(columns).with_columns(pl.col("cost", "score").fill_nan(None), known.alias("correct"))
    return table.cast(MATCHES_SCHEMA)  # type: ignore[arg-type]
