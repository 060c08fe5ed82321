"""The matches that a run folder keeps, as tensors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from tensor_stereo.result_folders import check_shard
from tensor_stereo.sweeps.batches import MATCHES_SCHEMA, METRICS_SCHEMA
from tensor_stereo.sweeps.results import finished_parts, read_config, scan_parts
from tensor_stereo.table_files import scan_parquet
from tensor_stereo.types import Matches


@dataclass(frozen=True, eq=False)
class StoredMatches:
    """The matches of one pair under one setting, as a training loop wants them.

    Attributes:
        dataset: of the pair.
        scene: of the pair.
        matches: the M putative matches, without groups.
        inlier: (M,) bool, the verdict.
        relation: (M,) int8 values of :class:`tensor_stereo.Relation`.
        score: (M,) float32, or None.
        correct: (M,) bool, False where ground truth is unknown.
        valid: (M,) bool, ground truth is known.
    """

    dataset: str
    scene: str
    matches: Matches
    inlier: Tensor
    relation: Tensor
    score: Tensor | None
    correct: Tensor
    valid: Tensor


class MatchDataset(IterableDataset[StoredMatches]):
    """The matches of every pair of a sweep with ``export_matches``, for a ``DataLoader``.

    Workers of the loader, and shards, share the parts of the run, each of which is read once; where there are fewer
    parts than shares they share the pairs of every part. Without ``shuffle`` the order is that of the parts. Pass
    ``batch_size=None``, or a ``collate_fn`` that does not stack, and ``multiprocessing_context="spawn"`` with workers:
    the threads of Polars, which reads the parts, survive no fork.

    Args:
        run: run folder, finished or not.
        trial: number of the point in ``config.json``.
        shuffle: whether the parts of a share, and the pairs within a part, come in a random order, another one in
            every epoch; with workers it follows from the generator of the loader.
        seed: of that order.
        shard: (i, n): the i-th of n parts of the data, counted from 1, as for the processes of distributed training.

    Raises:
        FileNotFoundError: if ``run`` is no run folder.
        ValueError: if it keeps no matches, has no such trial or another format, or ``shard`` is not 1 <= i <= n.
    """

    def __init__(
        self,
        run: Path | str,
        *,
        trial: int = 0,
        shuffle: bool = False,
        seed: int = 0,
        shard: tuple[int, int] = (1, 1),
    ) -> None:
        check_shard(shard)
        self.run, self.trial, self.shuffle, self.seed, self.shard = Path(run), trial, shuffle, seed, shard
        self.epoch = 0
        self.parts = finished_parts(run, "matches")
        _check_kept(self.run, self.parts)
        num_trials = len(read_config(run).trials)
        if not 0 <= trial < num_trials:
            raise ValueError(f"trial must be one of the {num_trials} points of {run}, from 0 on, got {trial}")

    def __iter__(self) -> Iterator[StoredMatches]:
        loader = get_worker_info()
        worker, workers = (0, 1) if loader is None else (loader.id, loader.num_workers)
        rng = np.random.default_rng([self.seed, self.epoch if loader is None else loader.seed])
        self.epoch += 1
        share = slice((self.shard[0] - 1) * workers + worker, None, self.shard[1] * workers)
        by_part = len(self.parts) >= share.step
        parts = self.parts[share] if by_part else self.parts
        for k in rng.permutation(len(parts)) if self.shuffle else range(len(parts)):
            yield from self._of_part(parts[k], slice(None) if by_part else share, rng)

    def _of_part(self, part: Path, share: slice, rng: np.random.Generator) -> Iterator[StoredMatches]:
        rows = scan_parquet([self.run / "metrics" / part.name], METRICS_SCHEMA).filter(trial=self.trial)
        names = rows.select("unit", "dataset", "scene", "score").collect().rows()[share]
        table = scan_parquet([part], MATCHES_SCHEMA).filter(trial=self.trial).collect()
        of_unit = table.partition_by("unit", as_dict=True, maintain_order=True)
        for k in rng.permutation(len(names)) if self.shuffle else range(len(names)):
            unit, dataset, scene, score = names[k]
            yield _to_tensors(dataset, scene, score, of_unit.get((unit,), table.head(0)))


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
    rows = scan_parts(run, "metrics", METRICS_SCHEMA).filter(dataset=dataset, scene=scene, trial=trial)
    units = rows.select("unit", "score").collect()
    if not len(units):
        raise ValueError(f"{run} has no finished unit of {dataset}/{scene} with trial {trial}")
    _check_kept(Path(run), finished_parts(run, "matches"))
    stored = scan_parts(run, "matches", MATCHES_SCHEMA).filter(unit=units["unit"][0], trial=trial)
    return _to_tensors(dataset, scene, units["score"][0], stored.collect())


def _check_kept(run: Path, parts: Sequence[Path]) -> None:
    if not parts:
        raise ValueError(f"{run} keeps no matches; set export_matches = true above the grid")


def _to_tensors(dataset: str, scene: str, score_name: str, table: pl.DataFrame) -> StoredMatches:
    """The rows of one pair under one setting."""

    def tensor(name: str) -> Tensor:
        return torch.from_numpy(table[name].to_numpy(writable=True))

    def mask(values: pl.Series) -> Tensor:
        return torch.tensor(values.to_list(), dtype=torch.bool)

    return StoredMatches(
        dataset,
        scene,
        matches=Matches(
            torch.stack([tensor("x0"), tensor("y0")], 1),
            torch.stack([tensor("x1"), tensor("y1")], 1),
            torch.tensor([0, len(table)]),
            None if table["cost"].null_count() else tensor("cost"),
        ),
        inlier=mask(table["inlier"]),
        relation=torch.tensor(table["relation"].to_list(), dtype=torch.int8),
        score=tensor("score") if score_name != "none" else None,
        correct=mask(table["correct"].fill_null(value=False)),
        valid=mask(table["correct"].is_not_null()),
    )
