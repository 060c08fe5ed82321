"""CCNN, a peer of the confidence of dense maps, from its paper and on the same scenes.

    python benchmarks/training/ccnn.py DATA TRAINING_DATA WORK

Source: Poggi & Mattoccia, "Learning from scratch a confidence measure", BMVC 2016, section 3: four layers of 64 filters
of 3 x 3 over patches of 9 x 9 disparities, two of 100 and one of one neuron, here as convolutions. It is trained on the
maps that ``train_confidence.py`` has left in WORK/dense, by as many crops, by the same schedule, and for about the same
time: its layers work at full size, so that its crops are smaller. An error is one above 3 px in KITTI, above 1 px
elsewhere. WORK/dense receives ccnn-K.safetensors, trained without fold K, and ccnn.safetensors.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from training.scenes import NUM_FOLDS, list_scenes
from training.train_confidence import (
    CROPS_AT_ONCE,
    LEARNING_RATE,
    SEED,
    STEPS,
    WEIGHT_DECAY,
    Item,
    draw_part,
    keep_scenes,
    record_scene,
)

CROP = (48, 96)
_REACH = 4  # px of a patch around its centre
_UNIT_PX = 64.0  # of the disparities that it sees


class CCNN(nn.Module):
    """(B, 1, H, W) disparities in px, 0 where unknown -> (B, 1, H, W) logits of a small error."""

    def __init__(self) -> None:
        super().__init__()
        widths = (1, 64, 64, 64, 64)
        layers: list[nn.Module] = []
        for k in range(4):
            layers += [nn.Conv2d(widths[k], widths[k + 1], 3), nn.ReLU()]
        layers += [nn.Conv2d(64, 100, 1), nn.ReLU(), nn.Conv2d(100, 100, 1), nn.ReLU(), nn.Conv2d(100, 1, 1)]
        self.layers = nn.Sequential(*layers)

    def forward(self, disparity: Tensor) -> Tensor:
        padded = functional.pad(disparity / _UNIT_PX, (_REACH,) * 4, mode="replicate")
        logit: Tensor = self.layers(padded)
        return logit


def score_ccnn(network: CCNN, disparity: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) logits of a map."""
    with torch.no_grad():
        logit = network(torch.from_numpy(np.nan_to_num(disparity))[None, None])
    return np.asarray(logit[0, 0].numpy())


def crop(item: Item, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    disparity = np.load(item.disparity_path, mmap_mode="r")
    error = np.load(item.error_path, mmap_mode="r")
    part = draw_part(error.shape, CROP, rng)
    values, wrong = (torch.from_numpy(np.array(array[part])) for array in (disparity, error))
    if rng.random() < 0.5:
        values, wrong = values.flip(0), wrong.flip(0)
    pad = (0, CROP[1] - wrong.shape[1], 0, CROP[0] - wrong.shape[0])
    return functional.pad(values.nan_to_num(0)[None], pad), functional.pad(wrong[None], pad, value=torch.nan)


def train(items: Sequence[Item], folder: Path, fold: int | None) -> None:
    torch.set_num_threads(1)
    torch.manual_seed(SEED)
    rng, start = np.random.default_rng(SEED), time.perf_counter()
    seen = [item for item in items if (fold is None or item.fold != fold) and item.stride == 1]
    network = CCNN().to(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(network.parameters(), LEARNING_RATE / 4, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE / 4, STEPS, pct_start=0.15)
    for _ in range(STEPS):
        chosen = [seen[k] for k in rng.integers(0, len(seen), CROPS_AT_ONCE)]
        disparity, error = (torch.stack(part) for part in zip(*(crop(item, rng) for item in chosen), strict=True))
        tolerance = torch.tensor([3.0 if item.domain == "kitti" else 1.0 for item in chosen])[:, None, None, None]
        known = error.isfinite()
        with torch.autocast("cpu", torch.bfloat16):
            logit = network(disparity)
        loss = functional.binary_cross_entropy_with_logits(logit.float()[known], (error <= tolerance).float()[known])
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    name = "ccnn" if fold is None else f"ccnn-{fold}"
    save_file(
        {key: values.contiguous() for key, values in network.state_dict().items()}, folder / f"{name}.safetensors"
    )
    print(f"{name}: {time.perf_counter() - start:.0f} s, loss {loss.item():.4f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("data", "training_data", "work"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    folder = options.work / "dense"
    scenes = keep_scenes(list_scenes(options.data, options.training_data))
    items = [item for number, scene in enumerate(scenes) for item in record_scene(folder, scene, number)]
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        pool.map(partial(train, items, folder), [None, *range(NUM_FOLDS)], chunksize=1)


if __name__ == "__main__":
    main()
