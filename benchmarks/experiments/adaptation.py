"""Unsupervised adaptation: which pixels of a semi-global map should a network be tuned on?

    python benchmarks/experiments/adaptation.py --training-data TRAINING_DATA --confidence WORK --work WORK

After Tonioni, Poggi, Mattoccia & Di Stefano, ICCV 2017: the network of ``train_guided.py`` is tuned, without hints, on
the pair or the drive at hand, with the labels of semi-global matching and what each measure says of them. The paper's
eight scenes each for itself, and the KITTI frames of the validation together; confidence networks that have not seen
them, which ``training/train_confidence.py`` and ``ccnn.py`` leave in WORK/dense. What is compared are means over the
scenes; the spread is that over five networks.
"""

from __future__ import annotations

import copy
import multiprocessing
import os
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from accuracy.confidence import load_ccnn, load_network, score_maps
from accuracy.putatives import load_pairs
from experiments.guided_network import GuidedStereoNet
from experiments.guided_stereo import BAD_PX, TOLERANCE_PX, note_gap
from experiments.train_guided import SEEDS, VALIDATION_FOLD, load_guided
from shared.harness import Suite
from training.dense_maps import CLASSIC, both_maps
from training.scenes import Views, list_scenes, read_views

CONDITIONS = (
    "all pixels",
    "left-right check",
    "CCNN",
    "confidence as weight",
    "confidence, kept",
    "confidence, .95",
    "oracle",
)
BEFORE = "no adaptation"
STEPS, CROPS_AT_ONCE, CROP, LEARNING_RATE = 40, 2, (192, 384), 3e-4
AIM = 0.95  # min_precision


class Frame(NamedTuple):
    """One pair, its semi-global map, and the weight of each of its pixels by condition."""

    views: Views
    labels: NDArray[np.float32]  # (H, W) px, NaN where unknown
    weights: dict[str, NDArray[np.float32]]  # (H, W)


class Domain(NamedTuple):
    """What is adapted to at once."""

    group: str
    name: str
    frames: list[Frame]


def find_domains(data: Path, more: Path, dense: Path) -> Iterator[Domain]:
    for pair in load_pairs(data)["eight"]:
        views = Views(pair.left, pair.right, pair.disparity_gt.astype(np.float32), None)
        yield Domain("eight", pair.scene, [label(views, "eight", None, dense / "ccnn.safetensors")])
    fold, ccnn = (dense / f"{name}-{VALIDATION_FOLD}.safetensors" for name in ("fold", "ccnn"))
    scenes = [s for s in list_scenes(data, more) if s.domain == "kitti" and s.fold == VALIDATION_FOLD]
    yield Domain("kitti", "drive 0015", [label(read_views(scene), "kitti", fold, ccnn) for scene in scenes])


def label(views: Views, group: str, fold: Path | None, ccnn: Path) -> Frame:
    """The semi-global map of a pair and what is said of it."""
    both = both_maps(CLASSIC["sgbm"], views.image0, views.image1, 192 if group == "kitti" else 128)
    network = load_ccnn(ccnn)
    assert network is not None
    maps, _ = score_maps(views, both, load_network(fold), network, TOLERANCE_PX[group])
    labels = both[0]
    known = np.isfinite(labels)
    ours, logit = maps["ours"], maps["CCNN"]
    kept = known & (ours >= 0.5)
    by_ccnn = np.where(known, logit, -np.inf)
    least = np.sort(by_ccnn[known])[::-1][max(int(kept.sum()) - 1, 0)]  # as many as ours keeps
    order = np.sort(ours[known])[::-1]
    sure = np.flatnonzero(np.cumsum(order) / np.arange(1, len(order) + 1) >= AIM)
    error = np.abs(labels - views.disparity0)
    weights = {
        "all pixels": known,
        "left-right check": known & (maps["left-right"] >= -1),
        "CCNN": known & (by_ccnn >= least),
        "confidence as weight": np.where(known, ours, 0),
        "confidence, kept": kept,
        "confidence, .95": known & (ours >= (order[sure[-1]] if len(sure) else np.inf)),
        "oracle": known & (error <= TOLERANCE_PX[group]),
    }
    return Frame(views, labels, {name: weights[name].astype(np.float32) for name in CONDITIONS})


def tune(net: GuidedStereoNet, frames: list[Frame], condition: str, seed: int) -> GuidedStereoNet:
    """A copy of a network, tuned on crops of the frames, which follow from the seed alone."""
    net = copy.deepcopy(net).train()
    rng = np.random.default_rng(seed)
    optimizer = torch.optim.Adam(net.parameters(), LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    for _ in range(STEPS):
        parts = [crop(frames[k], condition, rng) for k in rng.integers(0, len(frames), CROPS_AT_ONCE)]
        image0, image1, labels, weight = (torch.stack(column) for column in zip(*parts, strict=True))
        hints = torch.full_like(image0[:, 0], torch.nan)
        with torch.autocast("cpu", torch.bfloat16):
            found = net(image0, image1, hints)
        distance = functional.smooth_l1_loss(found, labels.nan_to_num(0), reduction="none")
        loss = (weight * distance).sum() / weight.sum().clamp(min=1)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    return net.eval()


def crop(frame: Frame, condition: str, rng: np.random.Generator) -> tuple[Tensor, ...]:
    """Images, labels and weights of a random part."""
    height, width = (min(n, c) // 16 * 16 for n, c in zip(frame.labels.shape, CROP, strict=True))
    top, left = (int(rng.integers(0, n - c + 1)) for n, c in zip(frame.labels.shape, (height, width), strict=True))
    part = slice(top, top + height), slice(left, left + width)
    arrays = frame.views.image0, frame.views.image1, frame.labels, frame.weights[condition]
    image0, image1, labels, weight = (torch.from_numpy(array[part].copy()) for array in arrays)
    inside = torch.arange(width) >= labels.nan_to_num(0)
    return image0[None].float(), image1[None].float(), labels, weight * inside


def errors(net: GuidedStereoNet, domain: Domain) -> tuple[float, float]:
    """Share of bad pixels and mean error, over the frames."""
    rows = []
    for frame in domain.frames:
        truth = torch.from_numpy(frame.views.disparity0)
        (found,) = net.predict(*(torch.from_numpy(v)[None] for v in (frame.views.image0, frame.views.image1)))
        error = (found - truth).abs()[truth.isfinite() & (truth > 0)]
        rows.append((float((error > BAD_PX[domain.group]).float().mean()), float(error.mean())))
    bad, epe = np.mean(rows, 0)
    return float(bad), float(epe)


def adapt(work: Path, domains: list[Domain], seed: int) -> list[dict[str, tuple[float, float]]]:
    """What becomes of one network under every condition, for each domain."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    net = load_guided(work, seed)
    found = []
    for domain in domains:
        figures = {BEFORE: errors(net, domain)}
        for condition in CONDITIONS:
            figures[condition] = errors(tune(net, domain.frames, condition, seed), domain)
        found.append(figures)
        print(f"seed {seed}, {domain.name}", flush=True)
    return found


def report(suite: Suite, group: str, domains: list[Domain], judged: list[list[dict]]) -> None:
    """Means over the domains of a group, and spreads over the networks."""
    rows = [k for k, domain in enumerate(domains) if domain.group == group]
    frames = [frame for k in rows for frame in domains[k].frames]
    bad, epe = (
        {n: np.array([np.mean([of[k][n][which] for k in rows]) for of in judged]) for n in (BEFORE, *CONDITIONS)}
        for which in (0, 1)
    )
    print(f"\n{group}: bad-{BAD_PX[group]:g}px and mean error, over {len(judged)} networks")
    for name, values in bad.items():
        record = {
            "group": group, "condition": name, "bad": float(values.mean()), "bad_spread": float(values.std(ddof=1)),
            "epe_px": float(epe[name].mean()), "epe_spread_px": float(epe[name].std(ddof=1)),
            "networks_bad": values.round(4).tolist(),
        }  # fmt: skip
        if name != BEFORE:
            weights = [frame.weights[name] for frame in frames]
            known = [np.isfinite(frame.labels) & np.isfinite(frame.views.disparity0) for frame in frames]
            right = [np.abs(f.labels - f.views.disparity0) <= TOLERANCE_PX[group] for f in frames]
            record["share"] = float(np.mean([w.mean() for w in weights]))
            record["correct"] = float(
                np.mean([(w * k * r).sum() / (w * k).sum() for w, k, r in zip(weights, known, right, strict=True)])
            )
        suite.records.append(record)
        keys = ("bad", "bad_spread", "epe_px", "epe_spread_px", "share", "correct")
        print(f"  {name:24}" + "  ".join(f"{key} {record[key]:.4f}" for key in keys if key in record), flush=True)
    note_gap(suite, group, bad, "all pixels", CONDITIONS[2:6])


def main() -> None:
    folders = {
        "training-data": "folder of the training data",
        "confidence": "folder WORK of training/train_confidence.py",
        "work": "folder of train_guided.py",
    }
    suite = Suite("adaptation", **folders)
    options = suite.options
    torch.set_num_threads(1)
    domains = list(find_domains(options.data, options.training_data, options.confidence / "dense"))
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        judged = pool.map(partial(adapt, options.work, domains), SEEDS, chunksize=1)
    for group in BAD_PX:
        report(suite, group, domains, judged)
    suite.write()


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
