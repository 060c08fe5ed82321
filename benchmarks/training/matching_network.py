"""A small matching network, whose disparity maps are among those that train and judge the confidence network.

    python benchmarks/training/matching_network.py DATA TRAINING_DATA WORK

Features of 3 x 3 convolutions whose product is the similarity, by cross-entropy over the disparities of a row: Zbontar
& LeCun, "Stereo matching by training a convolutional neural network to compare image patches", JMLR 17, 2016, the fast
architecture; Luo, Schwing & Urtasun, "Efficient deep learning for stereo matching", CVPR 2016, section 3. Two are
trained, each on every second scene, so that there is one for every scene that has not seen it. WORK/dense receives
them; each takes some minutes on one thread.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn import functional

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from training.scenes import Gray, Views, list_scenes, read_views

SEED, STEPS, CROPS_AT_ONCE, CROP = 0, 1200, 3, (48, 256)
LEARNING_RATE = 2e-3
NUM_SYNTHETIC = 16  # renderings that it is trained on
_LAYERS, _WIDTH = 5, 32
_MOST_DISPARITIES = 192  # of a crop
_CONTRAST_PX, _LEAST_CONTRAST = 11, 2.0  # box and least deviation, in grey levels, of the contrast that is taken out
_ROWS_AT_ONCE = 32
_SKIPPED_ROWS = 6
_NEAR_PX = 1.5  # disparities so near to the truth share its label


class MatchingNetwork(nn.Module):
    """(B, 1, H, W) grey levels -> (B, 32, H, W) unit vectors."""

    def __init__(self) -> None:
        super().__init__()
        widths = (1, *(_WIDTH,) * _LAYERS)
        layers: list[nn.Module] = []
        for k in range(_LAYERS):
            layers += [nn.Conv2d(widths[k], widths[k + 1], 3, padding=1), nn.ReLU()]
        self.layers = nn.Sequential(*layers[:-1])
        self.sharpness = nn.Parameter(torch.tensor(2.5))  # logarithm

    def forward(self, image: Tensor) -> Tensor:
        mean, square = (_box(values) for values in (image, image * image))
        level = (image - mean) / (square - mean * mean).clamp(min=_LEAST_CONTRAST**2).sqrt()
        return functional.normalize(self.layers(level), dim=1)


def _box(values: Tensor) -> Tensor:
    padded = functional.pad(values, (_CONTRAST_PX // 2,) * 4, mode="replicate")
    return functional.avg_pool2d(padded, _CONTRAST_PX, 1)


def similarity(features0: Tensor, features1: Tensor, count: int) -> Tensor:
    """(B, K, H, W) products of every pixel and those 0, 1, ... px to its left in view 1; -1 outside."""
    rows0, rows1 = features0.permute(0, 2, 3, 1), features1.permute(0, 2, 1, 3)
    partner = torch.arange(features0.shape[3])[:, None] - torch.arange(count)  # (W, K)
    found = (rows0 @ rows1).gather(3, partner.clamp(min=0).expand(*rows0.shape[:3], -1))
    return found.masked_fill(partner < 0, -1).permute(0, 3, 1, 2)


@torch.no_grad()
def matching_costs(network: MatchingNetwork, left: Gray, right: Gray, count: int) -> NDArray[np.float32]:
    """(K, H, W) in [0, 2], less is better."""
    features = [network(torch.from_numpy(view)[None, None].float()) for view in (left, right)]
    bands = zip(*(part.split(_ROWS_AT_ONCE, 2) for part in features), strict=True)
    return np.asarray(1 - torch.cat([similarity(*band, count) for band in bands], 2)[0].numpy())


def load_matching(folder: Path, number: int) -> MatchingNetwork:
    """The network that has not seen the scene of a number; either one for a scene outside of the list."""
    network = MatchingNetwork()
    network.load_state_dict(load_file(folder / f"matching-{1 - number % 2}.safetensors"))
    return network.eval()


def draw_crop(views: Views, rng: np.random.Generator) -> tuple[Tensor, ...] | None:
    """Left, right and truth of a part of a scene, shifted so that its disparities begin near 0; None: none is known."""
    height, width = views.image0.shape
    top = int(rng.integers(0, max(height - CROP[0], 0) + 1))
    rows = slice(top, top + CROP[0])
    first = int(rng.integers(0, max(width - CROP[1], 0) + 1))
    truth = views.disparity0[rows, first : first + CROP[1]]
    known = np.isfinite(truth) & (truth > 0)
    if known.sum() < truth.size / 20:
        return None
    shift = max(int(np.quantile(truth[known], 0.02)) - int(rng.integers(8, 40)), 0)
    columns = np.arange(first, first + truth.shape[1]) - shift
    moved = views.image1[rows][:, np.clip(columns, 0, width - 1)]
    gain, offset = rng.uniform(0.8, 1.2), rng.uniform(-15, 15)
    arrays = (
        views.image0[rows, first : first + CROP[1]],
        moved * gain + offset,
        np.where(known, truth - shift, np.nan),
    )
    pad = ((0, CROP[0] - truth.shape[0]), (0, CROP[1] - truth.shape[1]))
    modes = ("edge", "edge", "constant")
    padded = [np.pad(a.astype(np.float32), pad, mode=m) for a, m in zip(arrays[:2], modes, strict=False)]
    padded.append(np.pad(arrays[2].astype(np.float32), pad, constant_values=np.nan))
    return tuple(torch.from_numpy(array) for array in padded)


def loss_of(network: MatchingNetwork, image0: Tensor, image1: Tensor, truth: Tensor) -> Tensor:
    """Cross-entropy of the softmax over disparities against the truth and its neighbours."""
    with torch.autocast("cpu", torch.bfloat16):
        features = network(torch.cat([image0, image1]).contiguous(memory_format=torch.channels_last))
    rows = slice(_SKIPPED_ROWS // 2, None, _SKIPPED_ROWS)  # neighbours of these say little more
    truth = truth[:, rows]
    products = similarity(*features[:, :, rows].float().chunk(2), _MOST_DISPARITIES)
    likely = (products * network.sharpness.exp()).log_softmax(1)
    steps = torch.arange(_MOST_DISPARITIES)[:, None, None]
    columns = torch.arange(truth.shape[-1])
    known = truth.isfinite() & (truth >= 0) & (truth <= columns - 1) & (truth < _MOST_DISPARITIES - 1)
    weight = (1 - (steps - truth.nan_to_num(0)[:, None]).abs() / _NEAR_PX).clamp(min=0)
    weight = weight / weight.sum(1, keepdim=True).clamp(min=1e-6)
    return -(weight * likely).sum(1)[known].mean()


def train(scenes: Sequence[Views], path: Path) -> None:
    torch.set_num_threads(1)
    torch.manual_seed(SEED)
    rng, start = np.random.default_rng(SEED), time.perf_counter()
    network = MatchingNetwork().to(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(network.parameters(), LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, STEPS, pct_start=0.1)
    for step in range(STEPS):
        crops = []
        while len(crops) < CROPS_AT_ONCE:
            found = draw_crop(scenes[int(rng.integers(0, len(scenes)))], rng)
            crops += [] if found is None else [found]
        image0, image1, truth = (torch.stack(part) for part in zip(*crops, strict=True))
        loss = loss_of(network, image0[:, None], image1[:, None], truth)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        if step % 100 == 0:
            print(f"{path.stem}, step {step}: {loss.item():.3f}, {time.perf_counter() - start:.0f} s", flush=True)
    save_file({name: values.contiguous() for name, values in network.state_dict().items()}, path)


def _train_half(data: Path, more: Path, folder: Path, half: int) -> None:
    cv2.setNumThreads(1)
    scenes = [one for one in list_scenes(data, more) if not isinstance(one.source, int) or one.source < NUM_SYNTHETIC]
    train([read_views(scene) for scene in scenes[half::2]], folder / f"matching-{half}.safetensors")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("data", "training_data", "work"):
        parser.add_argument(name, type=Path)
    options = parser.parse_args()
    folder = options.work / "dense"
    folder.mkdir(parents=True, exist_ok=True)
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        pool.map(partial(_train_half, options.data, options.training_data, folder), range(2), chunksize=1)


if __name__ == "__main__":
    main()
