"""Train the guided networks of the experiments, one for each of five seeds.

    python benchmarks/experiments/train_guided.py DATA TRAINING_DATA WORK

Rendered scenes, Middlebury, ETH3D and KITTI without the drive of the validation; never the paper's eight. Hints are
drawn from ground truth, at most 2 % of the pixels and none in every third crop, off by up to half a pixel as whole
pixels are. WORK/guided-SEED.safetensors receive the weights; six minutes each on one thread, two at a time.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.nn import functional

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from experiments.guided_network import NUM_STEPS, SIZE, GuidedStereoNet
from training.scenes import NUM_FOLDS, Views, list_scenes, read_views

SEEDS = range(5)
VALIDATION_FOLD = NUM_FOLDS - 1  # of KITTI's drives
NUM_SYNTHETIC = 24
NO_HINTS = 1 / 3  # share of the crops
DENSITY = (1e-3, 2e-2)  # least and most share of the pixels that are hints, where there are any
HINT_NOISE_PX = 0.5


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of a training; lengths in px of the full images."""

    steps: int = 1000
    crops_at_once: int = 3
    crop: tuple[int, int] = (192, 384)
    learning_rate: float = 2e-3


def read_training(data: Path, more: Path) -> list[Views]:
    """All scenes but those of the validation."""
    found = []
    for scene in list_scenes(data, more):
        left_out = scene.domain == "kitti" and scene.fold == VALIDATION_FOLD
        if not left_out and not (isinstance(scene.source, int) and scene.source >= NUM_SYNTHETIC):
            found.append(read_views(scene))
    return found


def draw_crop(views: Views, size: tuple[int, int], rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Both images (1, h, w) uint8, truth (h, w), hints (h, w), upside down in half the cases; padded with nothing."""
    height, width = views.image0.shape
    top, left = (int(rng.integers(0, max(n - c, 0) + 1)) for n, c in zip((height, width), size, strict=True))
    part = slice(top, top + size[0]), slice(left, left + size[1])
    images = [views.image0[part], views.image1[part]]
    truth = np.where(np.isfinite(views.disparity0[part]), views.disparity0[part], np.nan).astype(np.float32)
    columns = np.arange(truth.shape[1])
    truth = np.where((truth < SIZE * (NUM_STEPS - 1)) & (columns >= truth), truth, np.nan)
    if rng.random() < 0.5:
        images, truth = [image[::-1] for image in images], truth[::-1]
    hints = draw_hints(truth, rng)
    pad = ((0, size[0] - truth.shape[0]), (0, size[1] - truth.shape[1]))
    truth, hints = (np.pad(values, pad, constant_values=np.nan) for values in (truth, hints))
    left_view, right_view = (torch.from_numpy(np.pad(image, pad, mode="edge")[None].copy()) for image in images)
    return left_view, right_view, torch.from_numpy(truth), torch.from_numpy(hints)


def draw_hints(truth: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Some pixels of the truth, a little off."""
    density = 0.0 if rng.random() < NO_HINTS else np.exp(rng.uniform(*np.log(DENSITY)))
    noise = rng.uniform(-HINT_NOISE_PX, HINT_NOISE_PX, truth.shape)
    return np.where(rng.random(truth.shape) < density, truth + noise, np.nan).astype(np.float32)


def loss_of(disparity: Tensor, truth: Tensor) -> Tensor:
    """Smooth L1 distance in px over the known pixels; a crop weighs as the root of their number."""
    known = truth.isfinite()
    distance = functional.smooth_l1_loss(disparity, truth.nan_to_num(0), reduction="none") * known
    count = known.flatten(1).sum(1).clamp(min=1).sqrt()
    return (distance.flatten(1).sum(1) / count).sum() / count.sum()


def train(scenes: Sequence[Views], seed: int, config: TrainingConfig) -> GuidedStereoNet:
    """Weights, scenes, crops and hints follow from the seed alone."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    net = GuidedStereoNet().to(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(net.parameters(), config.learning_rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, config.learning_rate, config.steps, pct_start=0.15)
    for step in range(config.steps):
        parts = [draw_crop(scenes[k], config.crop, rng) for k in rng.integers(0, len(scenes), config.crops_at_once)]
        left, right, truth, hints = (torch.stack(column) for column in zip(*parts, strict=True))
        with torch.autocast("cpu", torch.bfloat16):
            disparity = net(left.float(), right.float(), hints)
        loss = loss_of(disparity, truth)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        if step % 100 == 0:
            print(f"seed {seed}, step {step}: {loss.item():.3f}", flush=True)
    return net.eval()


def train_to(data: Path, more: Path, work: Path, seed: int) -> None:
    """Write the weights of one seed, unless they are there."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    path, start = weights_path(work, seed), time.perf_counter()
    if not path.exists():
        weights = train(read_training(data, more), seed, TrainingConfig()).state_dict()
        save_file({name: values.contiguous() for name, values in weights.items()}, path)
        print(f"{path}: {time.perf_counter() - start:.0f} s", flush=True)


def weights_path(work: Path, seed: int) -> Path:
    return work / f"guided-{seed}.safetensors"


def load_guided(work: Path, seed: int) -> GuidedStereoNet:
    net = GuidedStereoNet()
    net.load_state_dict(load_file(weights_path(work, seed)))
    return net.eval()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("data", "training_data", "work"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        pool.map(partial(train_to, options.data, options.training_data, options.work), SEEDS, chunksize=1)


if __name__ == "__main__":
    main()
