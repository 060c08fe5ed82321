"""Disparity maps and the confidence that a folder of results keeps, as tensors."""

from __future__ import annotations

import json
import operator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, SupportsIndex

import polars as pl
import torch
from torch import Tensor
from torch.utils.data import Dataset

from tensor_stereo.datasets.files import PATHS, READ, PairFiles, StrPath
from tensor_stereo.datasets.map_files import read_confidence, read_map
from tensor_stereo.datasets.pair_table import PairTable, pair_row
from tensor_stereo.datasets.pairs import read_pair
from tensor_stereo.datasets.remote import fetched, local_paths
from tensor_stereo.result_folders import Source, find_entry, read_entries
from tensor_stereo.types import StereoPair

KIND = "confidence"  # of the results: confidence.json, confidence.jsonl, confidence.parquet


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
        ValueError: if either is damaged; on access, if a result is gone, or of other files than there are now.
    """

    def __init__(self, manifest: StrPath, out: StrPath) -> None:
        self.manifest, self.out = manifest, Path(out)
        settings = self.out / f"{KIND}.json"
        if not settings.is_file():
            raise FileNotFoundError(f"out: {out} holds no results of tensor-stereo confidence")
        try:
            known: dict[str, Any] = json.loads(settings.read_text(encoding="utf-8"))
            self.stride, self._unknown, self._ending = int(known["stride"]), known["unknown"], str(known["ending"])
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{settings} is damaged: {error}") from error
        self._table: PairTable | None = PairTable(manifest, check_files=False)
        entries = read_entries(self.out, KIND)
        self._entries = {name: [found[-1] | {"summary": None}] for name, found in entries.items()}
        names = pl.DataFrame({"name": list(self._entries)}, schema={"name": pl.String})
        rows = self._table.rows().select(name=pl.concat_str("dataset", "scene", separator="/")).with_row_index("number")
        self._numbers = rows.join(names.lazy(), on="name", how="semi").collect()["number"].sort().to_numpy()

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, number: SupportsIndex) -> StoredConfidence:
        number = operator.index(number)
        if not 0 <= number < len(self):
            raise IndexError(f"there are {len(self)} maps, got number {number}")
        if self._table is None:
            self._table = PairTable(self.manifest, check_files=False)
        pair = self._table[int(self._numbers[number])]
        source = map_source(pair, self.out, self._ending)
        if find_entry(source, self._entries) is None:
            raise ValueError(f"{source.name}: its result is gone or of other files; run tensor-stereo confidence again")
        with fetched(pair, (*READ, "disparity_est")) as files:
            views = read_pair(files)
            disparity = read_map(
                Path(str(files.disparity_est)),
                scale=files.est_scale,
                unknown=self._unknown,
                name="disparity_est",
                scale_name="est_scale",
            )
        probability = read_confidence(source.results[0])
        return StoredConfidence(views, torch.from_numpy(disparity), torch.from_numpy(probability), self.stride)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_table": None}  # a worker opens its own


def map_source(pair: PairFiles, out: Path, ending: str) -> Source:
    """The map of a pair, and the file of its probabilities below ``out``."""
    name = f"{pair.dataset}/{pair.scene}"
    inputs = local_paths(*(getattr(pair, key) for key in PATHS))
    return Source(name, inputs, (out / f"{name}{ending}",), pair_row(pair))
