"""Train the confidence network of dense maps, cross-validate it over scenes and drives, calibrate it, write weights.

    python benchmarks/training/train_confidence.py DATA TRAINING_DATA WORK weights_confidence.safetensors

The scenes are those of ``scenes.py``, the maps those of ``dense_maps.py``; ``matching_network.py`` must have run.
WORK/dense receives what the network sees of every map (20 GB), and the networks of the cross-validation; with
``--leave-out FAMILY ...`` also one fold is trained without the maps of each of these families of methods. Everything
follows from the seeds below; each training runs on one thread.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional

from tensor_stereo.dense.confidence_network import TOLERANCES_PX, ConfidenceNetwork
from tensor_stereo.dense.map_evidence import NUM_OTHER, measure_map
from tensor_stereo.evaluation.sparsification import sparsification_area as area

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.calibration_error import calibration_error
from shared.sparsification import auc, keep_expected
from training.dense_maps import ALTERED, FAMILIES, METHODS, both_maps, family, make_methods
from training.matching_network import load_matching
from training.platt_scaling import fit_calibration
from training.scenes import NUM_FOLDS, Scene, list_scenes, read_views
from training.smooth_maps import altered

SEED, STEPS, CROPS_AT_ONCE, CROP = 0, 2200, 6, (128, 192)
LEARNING_RATE, WEIGHT_DECAY = 4e-3, 1e-2
DROP_OTHER = 0.5  # share of the crops that are shown without the map of view 1
STRIDES = (1, 2, 4)
MAPS = {"middlebury": 9, "eth3d": 9, "kitti": 4, "rendered": 4, "synthetic": 3}  # of a scene, of all methods
NUM_SYNTHETIC = 40
_MOST_DISPARITIES = 256
_CALIBRATION_PIXELS = 4000  # of a map
_TOLERANCES = torch.tensor(TOLERANCES_PX)


class Item(NamedTuple):
    """One map of one scene, on the grid of one stride."""

    scene: str
    domain: str
    fold: int | None
    method: str
    stride: int
    least_error_px: float
    path: Path  # planes (NUM_PLANES, H, W) float16
    error_path: Path  # (H, W) float32 px, NaN where the map or the truth is unknown
    disparity_path: Path  # (H, W) float32 px, NaN where unknown


def keep_scenes(scenes: Sequence[Scene]) -> list[Scene]:
    """All but most of the renderings."""
    return [one for one in scenes if not isinstance(one.source, int) or one.source < NUM_SYNTHETIC]


def record_scene(folder: Path, scene: Scene, number: int) -> list[Item]:
    """Write what the network sees of some maps of a scene, unless it is there."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    rng = np.random.default_rng([SEED, number])
    every = METHODS if scene.domain == "kitti" else (*METHODS, ALTERED)  # KITTI's truth is sparse
    methods = [str(m) for m in rng.permutation(every)[: MAPS[scene.domain]]]
    factor = rng.uniform(1.05, 1.6)
    items = [
        Item(
            scene.name, scene.domain, scene.fold, method, stride, scene.least_error_px,
            *(folder / f"{scene.name}-{method}-{stride}{part}.npy" for part in ("", "-error", "-disparity")),
        )
        for method in methods for stride in STRIDES
    ]  # fmt: skip
    if all(path.exists() for item in items for path in (item.path, item.error_path, item.disparity_path)):
        return items
    views = read_views(scene)
    truth = np.where(np.isfinite(views.disparity0), views.disparity0, np.nan)
    most = factor * float(np.nanquantile(truth, 0.999))
    count = int(np.clip(np.ceil(most / 16) * 16, 32, _MOST_DISPARITIES))
    known = make_methods(load_matching(folder, number))
    for method in methods:
        if method == ALTERED:
            disparity, other = altered(truth.astype(np.float32), views.image0, rng), None
        else:
            disparity, other = both_maps(known[method], views.image0, views.image1, count)
        for item in (item for item in items if item.method == method):
            s = item.stride
            planes = measure_map(disparity, views.image0, views.image1, other, s)
            np.save(item.path, planes.astype(np.float16))
            np.save(item.error_path, np.abs(disparity - truth)[::s, ::s].astype(np.float32))
            np.save(item.disparity_path, np.ascontiguousarray(disparity[::s, ::s]))
    return items


def load(item: Item, rows: slice = slice(None), columns: slice = slice(None)) -> tuple[Tensor, Tensor]:
    planes = np.load(item.path, mmap_mode="r")[:, rows, columns]
    error = np.load(item.error_path, mmap_mode="r")[rows, columns]
    return torch.from_numpy(np.array(planes, np.float32)), torch.from_numpy(np.array(error))


def draw_part(shape: tuple[int, ...], size: tuple[int, int], rng: np.random.Generator) -> tuple[slice, slice]:
    """Rows and columns of a random crop of a size."""
    top, left = (int(rng.integers(0, max(length - part, 0) + 1)) for length, part in zip(shape, size, strict=True))
    return slice(top, top + size[0]), slice(left, left + size[1])


def crop(item: Item, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """A random part of a map, padded with what is unknown; upside down in half the cases."""
    planes, error = load(item, *draw_part(np.load(item.error_path, mmap_mode="r").shape, CROP, rng))
    if rng.random() < DROP_OTHER:
        planes[-1 - NUM_OTHER : -1] = 0
    if rng.random() < 0.5:
        planes, error = planes.flip(1), error.flip(0)
    pad = (0, CROP[1] - error.shape[1], 0, CROP[0] - error.shape[0])
    return functional.pad(planes, pad), functional.pad(error, pad, value=torch.nan)


def labels(error: Tensor, least_error_px: float) -> tuple[Tensor, Tensor]:
    """(T, H, W) bool: which tolerances the truth can judge, and which are kept."""
    known = error.isfinite() & (least_error_px <= _TOLERANCES)[:, None, None]
    return known, error <= _TOLERANCES[:, None, None]


def train(items: Sequence[Item]) -> ConfidenceNetwork:
    torch.manual_seed(SEED)
    rng = np.random.default_rng(SEED)
    network = ConfidenceNetwork()
    fit_scales(network, [crop(items[k], rng)[0] for k in rng.permutation(len(items))[:150]])
    network = network.to(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, STEPS, pct_start=0.15)
    by_stride = [[item for item in items if item.stride == stride] for stride in STRIDES]
    for step in range(STEPS):
        stride = rng.choice(len(STRIDES), p=(0.5, 0.25, 0.25))
        chosen = [by_stride[stride][k] for k in rng.integers(0, len(by_stride[stride]), CROPS_AT_ONCE)]
        planes, errors = zip(*(crop(item, rng) for item in chosen), strict=True)
        known, correct = zip(*(labels(e, i.least_error_px) for e, i in zip(errors, chosen, strict=True)), strict=True)
        with torch.autocast("cpu", torch.bfloat16):  # twice as fast where the processor has it
            logit = network(torch.stack(planes).to(memory_format=torch.channels_last))
        loss = loss_of(logit.float(), torch.stack(known), torch.stack(correct))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        if step % 250 == 0:
            print(f"step {step}: {loss.item():.4f}", flush=True)
    return network.eval()


def fit_scales(network: ConfidenceNetwork, crops: Sequence[Tensor]) -> None:
    """Mean and one over the standard deviation of every plane, over known pixels."""
    pixels = torch.cat([planes[:, planes[0] > 0] for planes in crops], 1)
    network.mean.copy_(pixels.mean(1))
    network.scale.copy_(1 / pixels.std(1).clamp(min=0.05))
    network.mean[0], network.scale[0] = 0, 1


def loss_of(logit: Tensor, known: Tensor, correct: Tensor) -> Tensor:
    """Cross-entropy over all that the truth can judge; a crop weighs as the root of its known pixels."""
    count = known.flatten(1).sum(1)[:, None, None, None].clamp(min=1)
    weight = known / count.sqrt()
    return functional.binary_cross_entropy_with_logits(
        logit, correct.float(), weight, reduction="sum"
    ) / weight.sum().clamp(min=1e-6)


class LeftOut(NamedTuple):
    """What the network says of a map that it was trained without."""

    item: Item
    logit: Tensor  # (T, N) of known pixels, drawn at random
    error: Tensor  # (N,)
    areas: dict[str, list[float]]  # by tolerance: area above the optimum of ours, without view 1, of left-right; AUC


@torch.no_grad()
def cross_validate(
    items: Sequence[Item], fold: int | None, left_out: str | None = None
) -> tuple[dict[str, Tensor], list[LeftOut]]:
    """Weights of a training without the scenes of a fold and one family; what they say of the others."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    start = time.perf_counter()
    seen = [i for i in items if (fold is None or i.fold != fold) and family(i.method) != left_out]
    with torch.enable_grad():
        network = train(seen)
    rng = np.random.default_rng(SEED)
    found = []
    for item in items:
        judged = item.fold == fold and left_out in (None, family(item.method)) and item.method != ALTERED
        if fold is None or item.stride != 1 or not judged:
            continue
        planes, error = load(item)
        bare = planes.clone()
        bare[-1 - NUM_OTHER : -1] = 0
        logit, without = (network(p[None])[0] for p in (planes, bare))
        known = error.isfinite()
        areas = {}
        for k, tolerance in enumerate(TOLERANCES_PX):
            if tolerance < item.least_error_px or tolerance not in (1, 3):
                continue
            wrong = error[known] > tolerance
            scores = (logit[k][known], without[k][known], -planes[-2][known] - 2 * (1 - planes[-4][known]))
            optimum = area(-wrong.float(), wrong)
            areas[f"{tolerance:g}"] = [
                optimum, *(area(s, wrong) - optimum for s in scores), *(auc(s, ~wrong) for s in scores),
            ]  # fmt: skip
        drawn = torch.from_numpy(rng.integers(0, int(known.sum()), _CALIBRATION_PIXELS))
        found.append(LeftOut(item, logit[:, known][:, drawn], error[known][drawn], areas))
    print(f"fold {fold}, without {left_out}: {time.perf_counter() - start:.0f} s", flush=True)
    return network.state_dict(), found


def calibrate(found: Sequence[LeftOut]) -> Tensor:
    """(T, 2) slope and bias of each tolerance, over all maps alike."""
    fitted = []
    for k, tolerance in enumerate(TOLERANCES_PX):
        judged = [one for one in found if tolerance >= one.item.least_error_px]
        logit = torch.cat([one.logit[k] for one in judged])
        correct = torch.cat([one.error <= tolerance for one in judged])
        fitted.append(fit_calibration(logit, correct, torch.ones_like(logit)))
    return torch.stack(fitted)


def report(found: Sequence[LeftOut], calibration: Tensor) -> dict[str, dict[str, float]]:
    """By domain, family and tolerance: areas above the optimum, their share of the left-right check's, and more."""
    rows, pooled = defaultdict(list), defaultdict(list)
    for one in found:
        for tolerance, values in one.areas.items():
            domain = one.item.domain if one.item.domain == "kitti" else "others"
            key = f"{domain}, {family(one.item.method)}, {tolerance} px"
            rows[key].append(values)
            k = TOLERANCES_PX.index(float(tolerance))
            probability = torch.sigmoid(one.logit[k] * calibration[k, 0] + calibration[k, 1])
            pooled[key].append((probability, one.error <= float(tolerance)))
    names = ("optimum", "ours", "ours without view 1", "left-right", "auc", "auc without view 1", "auc left-right")
    figures = {}
    for key, values in sorted(rows.items()):
        mean = np.mean(values, 0)
        figures[key] = dict(zip(names, mean.round(4).tolist(), strict=True))
        figures[key] |= {"share": round(mean[1] / mean[3], 3), "share without view 1": round(mean[2] / mean[3], 3)}
        parts = (torch.cat(part) for part in zip(*pooled[key], strict=True))
        figures[key]["calibration error"] = round(calibration_error(*parts), 4)
        kept = [correct[keep_expected(likely, 0.95)] for likely, correct in pooled[key]]
        figures[key]["precision of .95"] = round(float(np.mean([k.double().mean() for k in kept if len(k)])), 4)
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("data", "training_data", "work", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--leave-out", nargs="*", default=[], choices=FAMILIES)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    folder = options.work / "dense"
    folder.mkdir(parents=True, exist_ok=True)
    scenes = keep_scenes(list_scenes(options.data, options.training_data))
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        start = time.perf_counter()
        recorded = pool.starmap(
            partial(record_scene, folder), zip(scenes, range(len(scenes)), strict=True), chunksize=1
        )
        items = [item for part in recorded for item in part]
        print(f"{len(items)} items: {time.perf_counter() - start:.0f} s", flush=True)
        tasks = [(None, None), *((fold, None) for fold in range(NUM_FOLDS)), *((0, name) for name in options.leave_out)]
        results = pool.starmap(partial(cross_validate, items), tasks, chunksize=1)
    folds = results[1 : 1 + NUM_FOLDS]
    judged = [one for _, found in folds for one in found]
    calibration = calibrate(judged)
    paths = [options.out, *(folder / f"fold-{k}.safetensors" for k in range(NUM_FOLDS))]
    for path, (weights, _) in zip(paths, results, strict=False):
        save(path, weights, calibration)
    figures = {"calibration": calibration.tolist(), **report(judged, calibration)}
    for name, (weights, found) in zip(options.leave_out, results[1 + NUM_FOLDS :], strict=True):
        never_seen = calibrate([one for one in judged if family(one.item.method) != name])
        save(folder / f"without-{name}.safetensors", weights, never_seen)
        figures[f"without {name}"] = report(found, never_seen)
    (folder / "figures.json").write_text(json.dumps(figures, indent=1))
    print(json.dumps(figures, indent=1), f"{time.perf_counter() - start:.0f} s", sep="\n")


def save(path: Path, weights: dict[str, Tensor], calibration: Tensor) -> None:
    save_file({name: values.contiguous() for name, values in (weights | {"calibration": calibration}).items()}, path)


if __name__ == "__main__":
    main()
