"""The paper's eight scenes, the search range for their matches, and the reading of pairs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import tensor_stereo as ts
from tensor_stereo.configs import MatchingConfig
from tensor_stereo.datasets import PairDataset, SyntheticDataset, find_pairs

EIGHT = ("Art", "Books", "Cones", "Dolls", "Laundry", "Moebius", "Reindeer", "Teddy")
GATES = MatchingConfig(max_row_offset_px=1, min_disparity_px=0, max_disparity_px=128)  # what "gated" means


def read_pairs(root: Path, scenes: Sequence[str] | None = None) -> list[ts.StereoPair]:
    """All pairs below ``root``, or those of the named scenes."""
    dataset = PairDataset(find_pairs(root, scenes=scenes))
    return [dataset[k] for k in range(len(dataset))]


def read_eight(data: Path | None) -> tuple[str, list[ts.StereoPair]]:
    """What the pairs of a speed suite are called, and the pairs: the eight scenes, or rendered ones without data."""
    if data is None:
        return "8 synthetic pairs", list(SyntheticDataset(8))
    return "eight scenes", read_pairs(data / "middlebury", EIGHT)
