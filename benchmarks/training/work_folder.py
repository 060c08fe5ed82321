"""The folder WORK of ``train_learned.py``: the putatives of every scene, and the networks of the cross-validation."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import load_file

from tensor_stereo.scores import LearnedScore
from training.putatives import Putatives
from training.scenes import NUM_FOLDS, fold_of


def putatives_path(work: Path, scene: str) -> Path:
    return work / f"{scene}.putatives.pt"


def items_path(work: Path, scene: str) -> Path:
    return work / f"{scene}.items.pt"


def load_putatives(work: Path) -> list[Putatives]:
    """Those of every scene that some fold leaves out: of the real ones."""
    found: list[Putatives] = []
    for path in sorted(work.glob("*.putatives.pt")):
        if fold_of(path.name.partition(".")[0]) is not None:
            found += torch.load(path, weights_only=False)
    return found


def fold_weights(work: Path) -> list[Path]:
    """For each fold, the file of the weights that were trained without its scenes."""
    return [work / f"fold-{k}.safetensors" for k in range(NUM_FOLDS)]


def load_fold_networks(work: Path) -> list[LearnedScore]:
    """For each fold, the network that was trained without its scenes."""
    networks = []
    for path in fold_weights(work):
        network = LearnedScore()
        network.load_state_dict(load_file(path))
        networks.append(network.eval())
    return networks
