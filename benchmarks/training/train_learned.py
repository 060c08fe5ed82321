"""Train a network of the learned score, cross-validate it over scenes and drives, calibrate it, write its weights.

    python benchmarks/training/train_learned.py rectified DATA TRAINING_DATA WORK weights_rectified.safetensors
    python benchmarks/training/repaired_matches.py DATA TRAINING_DATA WORK
    python benchmarks/training/train_learned.py rectified DATA TRAINING_DATA WORK weights_rectified.safetensors
    python benchmarks/training/learned_matches.py DATA TRAINING_DATA WORK
    python benchmarks/training/train_learned.py views DATA TRAINING_DATA WORK weights_views.safetensors

DATA and TRAINING_DATA hold the scenes of ``scenes.py``; the eight of the paper (2003, 2005) are never read.
WORK/rectified and WORK/views receive the putatives of every scene and what the network sees of them (3 GB each), and
the weights and the figures of the cross-validation. Both networks also learn from the matches that
``repaired_matches.py`` leaves in WORK/repaired, once they are there: the networks of a first training say what is to be
repaired for the second. The network of any two views also learns from rectified pairs, seen as if nobody had said so,
and from the matches that ``learned_matches.py`` leaves in WORK/aliked; the real pairs of any two views are left for
``accuracy/any_views.py``. Everything follows from the seeds below; each training runs on one thread.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional

from tensor_stereo.evaluation.metrics import PAPER_SENSITIVITY, roc_update
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.scores import LearnedScore, measure_images
from tensor_stereo.scores.alignment import estimate_alignment
from tensor_stereo.scores.learned_inputs import Quantities, find_receivers, measure_quantities
from tensor_stereo.scores.tolerance import TOLERANCES_PX

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.calibration_error import calibration_error
from training.learned_matches import KIND as ALIKED
from training.platt_scaling import fit_calibration
from training.putatives import Putatives, find_putatives
from training.repaired_matches import KIND as REPAIRED
from training.scenes import NUM_FOLDS, Scene, list_scenes
from training.two_views import find_two_views
from training.work_folder import fold_weights, items_path, putatives_path

SEED, EPOCHS, PAIRS_AT_ONCE = 0, 30, 8
LEARNING_RATE, WEIGHT_DECAY = 8e-3, 5e-2
DROP_IMAGE, DROP_COST = 0.15, 0.30  # share of the pairs that are shown without
BELIEF_WEIGHT = 0.2  # of the loss on the beliefs between rounds
NUM_ALTERED = 4  # altered rectified putatives of a scene that the network of any two views sees
RECTIFIED, VIEWS = "rectified", "views"  # the two networks, and the folders of their putatives
_FINDERS = {RECTIFIED: find_putatives, VIEWS: find_two_views}
_TOLERANCES = torch.tensor(TOLERANCES_PX)
_ONE, _TWO = TOLERANCES_PX.index(1), TOLERANCES_PX.index(2)


class Item(NamedTuple):
    """Putatives as the network sees them."""

    domain: str
    kind: str
    fixed: bool
    quantities: Quantities
    known: Tensor  # (M, 5) bool, whether the truth can judge each tolerance
    correct: Tensor  # (M, 5) bool
    repaired: Tensor | None = None  # (M,) bool, None: none is


def record_scene(kind: str, work: Path, scene: Scene, number: int) -> None:
    """Write the putatives of a scene, unless they are there."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    path = putatives_path(work / kind, scene.name)
    if not path.exists():
        torch.save(_FINDERS[kind](scene, number), path)


def measure_scene(kind: str, work: Path, scene: Scene) -> None:
    """Write what the network sees of the putatives of a scene."""
    torch.set_num_threads(1)
    found, repaired = _load_putatives(work / kind, scene), _load_putatives(work / REPAIRED, scene)
    if kind == RECTIFIED:
        found += repaired
    else:
        others = _load_putatives(work / RECTIFIED, scene)
        altered = [one for one in others if not one.fixed]
        others = [one for one in others if one.fixed] + altered[:NUM_ALTERED] + _load_putatives(work / ALIKED, scene)
        others += [one for one in repaired if one.fixed]
        found += [replace(one, domain=RECTIFIED) for one in others]
    items = [to_item(one, rectified=kind == RECTIFIED) for one in found]
    torch.save(items, items_path(work / kind, scene.name))


def _load_putatives(folder: Path, scene: Scene) -> list[Putatives]:
    path = putatives_path(folder, scene.name)
    found: list[Putatives] = torch.load(path, weights_only=False) if path.exists() else []
    return found


def to_item(given: Putatives, *, rectified: bool = True) -> Item:
    matches, graphs = given.matches, build_match_graphs(given.matches)
    alignment = estimate_alignment(matches, graphs, rectified=rectified)
    evidence = measure_images(*([image] for image in given.images), matches, graphs, alignment)
    quantities = measure_quantities(matches, graphs, evidence, alignment=alignment)
    error = given.error_px[:, None]
    known = error.isfinite() & (given.least_error_px <= _TOLERANCES)
    return Item(given.domain, given.kind, given.fixed, quantities, known, error <= _TOLERANCES, given.repaired)


def collate(items: Sequence[Item], shown: Sequence[tuple[bool, bool]]) -> tuple[Quantities, Tensor, Tensor]:
    """One batch, with cost and images of each pair shown or not."""
    parts = [item.quantities for item in items]
    lengths = torch.tensor([len(part.nodes) for part in parts])
    starts = (lengths.cumsum(0) - lengths).tolist()
    joined = {name: torch.cat([getattr(part, name) for part in parts]) for name in _ROWS}
    for name in ("i", "j"):
        joined[name] = torch.cat([getattr(part, name) + start for part, start in zip(parts, starts, strict=True)])
    flags = torch.tensor(shown).float().repeat_interleave(lengths, 0)  # (M, 2)
    cost, image = flags.split(1, 1)
    joined["has_cost"], joined["has_image"] = joined["has_cost"] * cost, joined["has_image"] * image
    batch = torch.repeat_interleave(lengths)
    receivers = find_receivers(joined["i"], joined["j"], len(batch))
    any_image = bool(joined["has_image"].any())
    whole = Quantities(batch=batch, receivers=receivers, num_pairs=len(items), shown=any_image, **joined)
    return whole, torch.cat([item.known for item in items]), torch.cat([item.correct for item in items])


_ROWS = [n for n in Quantities._fields if n not in ("i", "j", "batch", "receivers", "num_pairs", "shown")]


def fit_scales(network: LearnedScore, items: Sequence[Item]) -> None:
    """Mean and one over the standard deviation of every quantity."""
    q, _, _ = collate(items, [(True, True)] * len(items))
    seen = {
        "nodes": q.nodes,
        "cost": q.cost[q.has_cost[:, 0] > 0],
        "image": q.image,
        "edges": q.edges,
        "edge_image": torch.cat([q.image_i, q.image_j]),
    }
    for name, values in seen.items():
        getattr(network, f"{name}_mean").copy_(values.mean(0))
        getattr(network, f"{name}_scale").copy_(1 / values.std(0).clamp(min=0.05))


def train(items: Sequence[Item]) -> LearnedScore:
    torch.manual_seed(SEED)
    rng = np.random.default_rng(SEED)
    network = LearnedScore()
    fit_scales(network, [items[k] for k in rng.permutation(len(items))[:120]])
    optimizer = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    num_steps = EPOCHS * math.ceil(len(items) / PAIRS_AT_ONCE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, num_steps, pct_start=0.15)
    for _ in range(EPOCHS):
        order = rng.permutation(len(items))
        for start in range(0, len(items), PAIRS_AT_ONCE):
            chosen = [items[k] for k in order[start : start + PAIRS_AT_ONCE]]
            shown = [(rng.random() > DROP_COST, rng.random() > DROP_IMAGE) for _ in chosen]
            loss = loss_of(network, *collate(chosen, shown))
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            schedule.step()
    return network.eval()


def loss_of(network: LearnedScore, q: Quantities, known: Tensor, correct: Tensor) -> Tensor:
    """Cross-entropy over all tolerances that the truth can judge; a pair weighs as the root of its matches' number."""
    judged = known.any(1)
    count = q.share.new_zeros(q.num_pairs).index_add(0, q.batch, judged.float())
    weight = count.clamp(min=1).rsqrt()[q.batch]
    logit, beliefs = network.infer(q)
    loss = _cross_entropy(logit, correct, weight[:, None] * known)
    target = torch.where(known[:, _ONE], correct[:, _ONE], correct[:, _TWO])
    for belief in beliefs[1:]:
        loss = loss + BELIEF_WEIGHT * _cross_entropy(belief, target, weight * known[:, _TWO])
    return loss


def _cross_entropy(logit: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    weight = weight / weight.sum().clamp(min=1e-6)
    return functional.binary_cross_entropy_with_logits(logit, target.float(), weight, reduction="sum")


def load_items(work: Path, scenes: Sequence[Scene]) -> list[Item]:
    return [item for scene in scenes for item in torch.load(items_path(work, scene.name), weights_only=False)]


class LeftOut(NamedTuple):
    """What the network says of an item that it was trained without."""

    domain: str
    kind: str
    fixed: bool
    logit: Tensor  # (M, 5)
    bare: Tensor  # (M, 5) without images
    known: Tensor
    correct: Tensor
    repaired: Tensor | None


@torch.no_grad()
def cross_validate(work: Path, scenes: Sequence[Scene], fold: int | None) -> tuple[dict[str, Tensor], list[LeftOut]]:
    """Weights of a training without the scenes of a fold, or with all if it is None; what they say of the others."""
    torch.set_num_threads(1)
    start = time.perf_counter()
    with torch.enable_grad():
        network = train(load_items(work, [scene for scene in scenes if fold is None or scene.fold != fold]))
    found = []
    for item in load_items(work, [scene for scene in scenes if fold is not None and scene.fold == fold]):
        logits = []
        for shows_images in (True, False):
            q, known, correct = collate([item], [(True, shows_images)])
            logits.append(network.infer(q)[0])
        found.append(LeftOut(item.domain, item.kind, item.fixed, *logits, known, correct, item.repaired))
    print(f"fold {fold}: {time.perf_counter() - start:.0f} s", flush=True)
    return network.state_dict(), found


def calibrate(found: Sequence[LeftOut]) -> Tensor:
    """(5, 2) slope and bias of each tolerance, over all matches whose truth can judge it."""
    fitted = []
    for k in range(len(TOLERANCES_PX)):
        logit, correct, weight = [], [], []
        for one in found:
            rows = one.known[:, k]
            logit.append(one.logit[rows, k])
            correct.append(one.correct[rows, k])
            weight.append(torch.full((int(rows.sum()),), max(int(rows.sum()), 1) ** -0.5))
        fitted.append(fit_calibration(torch.cat(logit), torch.cat(correct), torch.cat(weight)))
    return torch.stack(fitted)


def report(found: Sequence[LeftOut], calibration: Tensor) -> dict[str, dict[str, list[float]]]:
    """By domain, tolerance and kind: AUC, specificity, the same without images, and the calibration error.

    Repaired matches also stand by themselves, with the calibration error alone.
    """
    network = LearnedScore()
    network.calibration.copy_(calibration)
    figures, pooled = defaultdict(list), defaultdict(list)
    for one in found:
        probability = network.calibrate(one.logit)
        for k, tolerance in enumerate(TOLERANCES_PX):
            rows, key = one.known[:, k], f"{one.domain}, {tolerance:g} px, {one.kind}"
            correct = one.correct[rows, k]
            if not one.fixed or not len(correct):
                continue
            pooled[key].append((probability[rows, k], correct))
            if one.repaired is not None:
                alone = rows & one.repaired
                pooled[f"{key}, alone"].append((probability[alone, k], one.correct[alone, k]))
            if 0 < correct.sum() < len(correct):
                counts = [roc_update(logit[rows, k], correct) for logit in (one.logit, one.bare)]
                figures[key].append([f for c in counts for f in (c.auc(), c.specificity_at(PAPER_SENSITIVITY))])
    errors = {
        key: calibration_error(*(torch.cat(x) for x in zip(*parts, strict=True))) for key, parts in pooled.items()
    }
    return {
        key: {"calibration error": round(error, 4)}
        | ({"auc, specificity": np.mean(figures[key], 0).round(4).tolist()} if key in figures else {})
        for key, error in errors.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=_FINDERS)
    for name in ("data", "training_data", "work", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    folder = options.work / options.kind
    folder.mkdir(parents=True, exist_ok=True)
    scenes = list_scenes(options.data, options.training_data)
    missing = [name for name in (RECTIFIED, ALIKED) if not (options.work / name).is_dir()]
    if options.kind == VIEWS and missing:
        parser.error(f"work must hold the putatives of {' and '.join(missing)}, got {options.work}")
    numbers = range(len(scenes))
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        start = time.perf_counter()
        pool.starmap(partial(record_scene, options.kind, options.work), zip(scenes, numbers, strict=True), chunksize=1)
        print(f"putatives of {len(scenes)} scenes: {time.perf_counter() - start:.0f} s", flush=True)
        start = time.perf_counter()
        pool.map(partial(measure_scene, options.kind, options.work), scenes, chunksize=1)
        print(f"evidence: {time.perf_counter() - start:.0f} s", flush=True)
        run = partial(cross_validate, folder, scenes)
        (whole, _), *folds = pool.map(run, [None, *range(NUM_FOLDS)], chunksize=1)
    left_out = [one for _, found in folds for one in found]
    calibration = calibrate(left_out)
    for path, weights in zip([options.out, *fold_weights(folder)], [whole, *(w for w, _ in folds)], strict=True):
        weights["calibration"] = calibration
        save_file({name: values.contiguous() for name, values in weights.items()}, path)
    figures = {"calibration": calibration.tolist(), **report(left_out, calibration)}
    (folder / "figures.json").write_text(json.dumps(figures, indent=1))
    print(json.dumps(figures, indent=1), f"{time.perf_counter() - start:.0f} s", sep="\n")


if __name__ == "__main__":
    main()
