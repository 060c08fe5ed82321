"""Train the learned score, cross-validate it over scenes, calibrate it, write its weights.

    python benchmarks/training/train_learned.py DATA/middlebury WORK weights.safetensors

WORK receives the records of every scene (about 200 MB), and the weights and the figures of the cross-validation.
Everything follows from the seeds below; each training runs on one thread. The eight scenes of the paper (2003, 2005)
are never read.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import sys
import time
from collections import defaultdict
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
from tensor_stereo.scores import LearnedScore
from tensor_stereo.scores.learned_inputs import Quantities, find_receivers, measure_quantities

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from training.platt_scaling import fit_calibration
from training.records import NUM_SYNTHETIC, Record, make_records, read_scenes, render_views
from training.work_folder import FOLDS, fold_weights, load_records, records_path

SEED, EPOCHS, PAIRS_AT_ONCE = 0, 6, 8
LEARNING_RATE, WEIGHT_DECAY = 4e-3, 1e-3
DROP_IMAGE, DROP_COST = 0.15, 0.30  # share of the pairs that are shown without
BELIEF_WEIGHT = 0.2  # of the loss on the beliefs between rounds


class Item(NamedTuple):
    quantities: Quantities
    valid: Tensor
    correct: Tensor


def make_scene(work: Path, data: Path, job: tuple[str, int]) -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    scene, number = job
    real = not scene.startswith("synthetic")
    views = read_scenes(data)[scene] if real else render_views(number)
    torch.save(make_records(scene, number, views, real=real), records_path(work, scene))


def to_item(record: Record) -> Item:
    quantities = measure_quantities(record.matches, build_match_graphs(record.matches), record.evidence)
    return Item(quantities, record.valid, record.correct)


def collate(items: list[Item], shown: list[tuple[bool, bool]]) -> tuple[Quantities, Tensor, Tensor]:
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
    return whole, torch.cat([item.valid for item in items]), torch.cat([item.correct for item in items])


_ROWS = [n for n in Quantities._fields if n not in ("i", "j", "batch", "receivers", "num_pairs", "shown")]


def fit_scales(network: LearnedScore, items: list[Item]) -> None:
    """Mean and one over the standard deviation of every quantity."""
    q, _, _ = collate(items, [(True, True)] * len(items))
    seen = {
        "nodes": q.nodes,
        "cost": q.cost,
        "image": q.image,
        "edges": q.edges,
        "edge_image": torch.cat([q.image_i, q.image_j]),
    }
    for name, values in seen.items():
        getattr(network, f"{name}_mean").copy_(values.mean(0))
        getattr(network, f"{name}_scale").copy_(1 / values.std(0).clamp(min=0.05))


def train(items: list[Item]) -> LearnedScore:
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


def loss_of(network: LearnedScore, q: Quantities, valid: Tensor, correct: Tensor) -> Tensor:
    """Cross-entropy; a pair weighs as the root of the number of its matches."""
    count = q.share.new_zeros(q.num_pairs).index_add(0, q.batch, valid.float())
    weight = valid / count.clamp(min=1).sqrt()[q.batch]
    weight, target = weight / weight.sum().clamp(min=1e-6), correct.float()
    logit, beliefs = network.infer(q)
    loss = functional.binary_cross_entropy_with_logits(logit, target, weight, reduction="sum")
    for belief in beliefs[1:]:
        between = functional.binary_cross_entropy_with_logits(belief, target, weight, reduction="sum")
        loss = loss + BELIEF_WEIGHT * between
    return loss


@torch.no_grad()
def predict(network: LearnedScore, item: Item, shown: tuple[bool, bool]) -> tuple[Tensor, Tensor]:
    """Logits and truth of the matches whose truth is known."""
    q, valid, correct = collate([item], [shown])
    return network.infer(q)[0][valid], correct[valid]


def cross_validate(work: Path, fold: int | None) -> dict[str, object]:
    """Train without the scenes of a fold, or with all scenes if it is None; measure on the scenes left out."""
    torch.set_num_threads(1)
    start = time.perf_counter()
    held = FOLDS[fold] if fold is not None else ()
    scenes = [scene for other in FOLDS for scene in other if scene not in held]
    scenes += [f"synthetic-{k}" for k in range(NUM_SYNTHETIC)]
    network = train([to_item(record) for record in load_records(work, scenes)])
    figures, logits, truths, weights = defaultdict(list), [], [], []
    for record in load_records(work, list(held)):
        item = to_item(record)
        logit, correct = predict(network, item, (True, True))
        if not len(logit):
            continue
        logits.append(logit)
        truths.append(correct)
        weights.append(torch.full((len(logit),), len(logit) ** -0.5))
        if record.fixed and 0 < correct.sum() < len(correct):
            for name, shown in (("full", (True, True)), ("no image", (True, False)), ("bare", (False, False))):
                logit, correct = predict(network, item, shown)
                key = f"{name}: {record.detector}{', gated' if record.gated else ''}"
                counts = roc_update(logit, correct)
                figures[key].append((counts.auc(), counts.specificity_at(PAPER_SENSITIVITY)))
    print(f"fold {fold}: {time.perf_counter() - start:.0f} s", flush=True)
    left_out = [torch.cat(x) if x else torch.zeros(0) for x in (logits, truths, weights)]
    return {"figures": dict(figures), "left out": left_out, "weights": network.state_dict()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    real = sorted(read_scenes(options.data))
    jobs = [(scene, k) for k, scene in enumerate(real)] + [(f"synthetic-{k}", k) for k in range(NUM_SYNTHETIC)]
    missing = [job for job in jobs if not records_path(options.work, job[0]).exists()]
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        pool.map(partial(make_scene, options.work, options.data), missing, chunksize=1)
        print(f"{len(missing)} scenes: {time.perf_counter() - start:.0f} s", flush=True)
        whole, *folds = pool.map(partial(cross_validate, options.work), [None, *range(len(FOLDS))], chunksize=1)
    logit, correct, weight = (torch.cat([fold["left out"][k] for fold in folds]) for k in range(3))
    calibration = fit_calibration(logit, correct.bool(), weight)
    for result in (whole, *folds):
        result["weights"]["calibration"] = calibration
    for path, result in zip([options.out, *fold_weights(options.work)], [whole, *folds], strict=True):
        save_file({name: values.contiguous() for name, values in result["weights"].items()}, path)
    table = {
        key: np.mean([x for fold in folds for x in fold["figures"].get(key, [])], 0).round(3).tolist()
        for key in folds[0]["figures"]
    }
    report = {"cross-validation": table, "calibration": calibration.tolist()}
    (options.work / "figures.json").write_text(json.dumps(report, indent=1))
    print(json.dumps(report, indent=1), f"{time.perf_counter() - start:.0f} s", sep="\n")


if __name__ == "__main__":
    main()
