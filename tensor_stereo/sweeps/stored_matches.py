"""The matches that a run folder keeps, as tensors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from tensor_stereo.sweeps.batches import MATCHES_SCHEMA, METRICS_SCHEMA
from tensor_stereo.sweeps.results import scan_parts
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
    stored = scan_parts(run, "matches", MATCHES_SCHEMA).filter(unit=units["unit"][0], trial=trial)
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
