"""What a sweep has to do: units of work and what they cost. Imports no torch."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tensor_stereo.configs import SweepConfig
from tensor_stereo.datasets.files import PairFiles
from tensor_stereo.datasets.pair_table import PairTable
from tensor_stereo.evaluation.rows import STAGES, stage_keys
from tensor_stereo.result_folders import check_shard


class Task(NamedTuple):
    """One unit of work on its way to a worker."""

    unit: int
    files: PairFiles
    trials: tuple[int, ...]  # numbers of the settings that the unit goes through
    attempt: int = 1


def failed_unit(config: SweepConfig, task: Task, stage: str, error: Exception) -> dict[str, Any]:
    """The record of a unit that raised."""
    return {
        "unit": task.unit,
        "dataset": task.files.dataset,
        "scene": task.files.scene,
        "detector": config.trials[task.trials[0]].detector,
        "stage": stage,
        "error": type(error).__name__,
        "message": " ".join(str(error).split()),
        "attempts": task.attempt,
    }


@dataclass(frozen=True)
class Plan:
    """The units of a sweep: every pair under every setting of a detector.

    Unit ``p * num_groups + g`` is pair ``p`` with the trials of group ``g``, which detect the same features. So
    features are computed once per image and detector setting, and units of one pair follow one another.

    Attributes:
        config: the points of the grid.
        pairs: the rows of the manifest, by number.
        groups: numbers of the trials that detect the same features, ordered such that those that share further stages
            follow one another.
    """

    config: SweepConfig
    pairs: Sequence[PairFiles] | PairTable
    groups: tuple[tuple[int, ...], ...]

    @property
    def num_units(self) -> int:
        return len(self.pairs) * len(self.groups)

    def task(self, unit: int, attempt: int = 1) -> Task:
        """What a worker needs to know of a unit."""
        pair, group = divmod(unit, len(self.groups))
        return Task(unit, self.pairs[pair], self.groups[group], attempt)

    def shard(self, index: int, count: int) -> NDArray[np.int64]:
        """The units of shard ``index`` of ``count``, from 1, in order; all units of a pair lie in one shard.

        Raises:
            ValueError: unless 1 <= index <= count.
        """
        check_shard((index, count))
        size = len(self.groups)
        pairs = np.arange(index - 1, len(self.pairs), count, dtype=np.int64)
        return (pairs[:, None] * size + np.arange(size)).ravel()

    def costs(self) -> pl.DataFrame:
        """How often each stage runs in the units of each group, and in how many trials its result is used.

        Returns:
            One row per group: ``features`` (its number), ``detector``, ``units``, ``trials``, and one column per stage
            with the runs of that stage in one unit.
        """
        rows = []
        for number, group in enumerate(self.groups):
            trials = [self.config.trials[k] for k in group]
            keys = [stage_keys(trial) for trial in trials]
            runs = {stage: len({key[stage] for key in keys}) for stage in STAGES}
            runs["improve"] = len({key["improve"] for key in keys if key["improve"] is not None})
            runs["group"] = len({key["group"] for key in keys if "label" in key})
            runs["score"] = len(
                {key["score"] for key, t in zip(keys, trials, strict=True) if t.resolved_score != "none"}
            )
            row = {"features": number, "detector": trials[0].detector, "units": len(self.pairs), "trials": len(group)}
            rows.append(row | runs)
        return pl.DataFrame(rows)


def build_plan(config: SweepConfig, pairs: Sequence[PairFiles] | PairTable) -> Plan:
    """Split the points of a sweep into groups that detect the same features.

    >>> from tensor_stereo.configs import TrialConfig
    >>> config = SweepConfig((TrialConfig(), TrialConfig(constrained=True), TrialConfig(detector="sift")))
    >>> build_plan(config, []).groups
    ((0, 1), (2,))
    """
    keys = [stage_keys(trial) for trial in config.trials]
    ranks: dict[str, dict[Hashable, int]] = {stage: {} for stage in STAGES}
    for key in keys:
        for stage in STAGES:
            ranks[stage].setdefault(key[stage], len(ranks[stage]))
    order = sorted(range(len(keys)), key=lambda k: [ranks[stage][keys[k][stage]] for stage in STAGES])
    groups: dict[Hashable, list[int]] = {}
    for k in order:
        groups.setdefault(keys[k]["detect"], []).append(k)
    return Plan(config, pairs, tuple(map(tuple, groups.values())))
