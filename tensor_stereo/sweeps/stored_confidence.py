"""Disparity maps and the confidence that a folder of results keeps, as tensors."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from tensor_stereo.datasets.files import ESTIMATES, READ, StrPath
from tensor_stereo.datasets.map_files import read_confidence, read_map
from tensor_stereo.datasets.pair_table import PairTable
from tensor_stereo.datasets.pairs import read_pair
from tensor_stereo.datasets.remote import fetched
from tensor_stereo.table_files import read_parquet
from tensor_stereo.types import StereoPair


@dataclass(frozen=True, eq=False)
class StoredConfidence:
    """One disparity map with its images and its confidence, as a training on proxy labels wants them.

    Attributes:
        pair: images, names and, where there is one, ground truth.
        disparity: (H, W) float32, the map of view 0 in px, NaN where unknown.
        probability: (H', W') float32 of the pixels [::stride, ::stride], 0 where unknown.
        stride: distance of the pixels that were judged.
    """

    pair: StereoPair
    disparity: Tensor
    probability: Tensor
    stride: int


class ConfidenceDataset(Dataset[StoredConfidence]):
    """The maps of a manifest that ``tensor-stereo confidence`` has judged, for a ``DataLoader``.

    A data set by number, so that samplers, also those of distributed training, shuffle it and share it out. Sizes
    differ between pairs: pass ``batch_size=None`` or a ``collate_fn`` that does not stack, and
    ``multiprocessing_context="spawn"`` with workers: the threads of Polars, which reads the manifest, survive no fork.

    Args:
        manifest: that of the call.
        out: the folder of its results, finished or not; pairs without a result are left out.

    Raises:
        FileNotFoundError: if there is no such manifest, or no results.
        ValueError: if either is damaged.
    """

    def __init__(self, manifest: StrPath, out: StrPath) -> None:
        self.manifest, self.out = manifest, Path(out)
        settings = self.out / "confidence.json"
        if not settings.is_file():
            raise FileNotFoundError(f"out: {out} holds no results of tensor-stereo confidence")
        try:
            self._settings: dict[str, Any] = json.loads(settings.read_text(encoding="utf-8"))
            self.stride = int(self._settings["stride"])
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{settings} is damaged: {error}") from error
        self._table: PairTable | None = PairTable(manifest, check_files=False)
        done = read_parquet(self.out / "confidence.parquet").select("dataset", "scene")
        rows = self._table.rows().select("dataset", "scene").with_row_index("number")
        self._numbers = rows.join(done.lazy(), on=("dataset", "scene"), how="semi").collect()["number"].sort()

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, number: int) -> StoredConfidence:
        if not 0 <= number < len(self):
            raise IndexError(f"there are {len(self)} maps, got number {number}")
        if self._table is None:
            self._table = PairTable(self.manifest, check_files=False)
        with fetched(self._table[self._numbers[number]], (*READ, *ESTIMATES)) as files:
            pair = read_pair(files)
            disparity = read_map(
                Path(str(files.disparity_est)),
                scale=files.est_scale,
                unknown=self._settings["unknown"],
                name="disparity_est",
                scale_name="est_scale",
            )
            name = f"{files.dataset}/{files.scene}{self._settings['ending']}"
        probability = read_confidence(self.out / name)
        return StoredConfidence(pair, torch.from_numpy(disparity), torch.from_numpy(probability), self.stride)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_table": None}  # a worker opens its own
