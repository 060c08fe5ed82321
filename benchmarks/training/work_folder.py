"""The folder WORK of ``train_learned.py``: the records of every scene, and the networks of the cross-validation."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import load_file

from tensor_stereo.scores import LearnedScore
from training.records import Record

FOLDS = (
    ("Aloe", "Midd1", "venus", "Vintage"),
    ("Baby1", "Monopoly", "Plastic", "poster"),
    ("Cloth1", "Lampshade1", "sawtooth", "Recycle"),
    ("Flowerpots", "Rocks1", "Wood1", "barn1"),
)  # real scenes; each network of the cross-validation is trained without those of one fold


def records_path(work: Path, scene: str) -> Path:
    return work / f"{scene}.pt"


def load_records(work: Path, scenes: list[str]) -> list[Record]:
    return [record for scene in scenes for record in torch.load(records_path(work, scene), weights_only=False)]


def fold_weights(work: Path) -> list[Path]:
    """For each fold, the file of the weights that were trained without its scenes."""
    return [work / f"fold-{k}.safetensors" for k in range(len(FOLDS))]


def load_fold_networks(work: Path) -> dict[str, LearnedScore]:
    """For each real scene, the network that was trained without it."""
    networks = {}
    for scenes, path in zip(FOLDS, fold_weights(work), strict=True):
        network = LearnedScore()
        network.load_state_dict(load_file(path))
        networks |= dict.fromkeys(scenes, network.eval())
    return networks
