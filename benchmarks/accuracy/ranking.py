"""How well scores tell correct putative matches from incorrect ones: ours and the peers on identical matches."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from tensor_stereo.evaluation.metrics import PAPER_SENSITIVITY, roc_curve, roc_update

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from accuracy.calibration import report_calibration
from accuracy.peers import score_peers
from accuracy.putatives import (
    DETECTORS,
    Putatives,
    draw_random_partners,
    find_putatives,
    jitter_keypoints,
    load_pairs,
)
from accuracy.ranking_figures import draw_degradation, draw_roc
from accuracy.scores import OURS, score_ours
from shared.harness import Suite

SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)  # share of the matches that get a random partner
SIGMAS_PX = (0.0, 0.25, 0.5, 1.0, 2.0)
UNSEEN = ("eight", "synthetic")  # by the training of the shipped weights; domains.py measures the rest out of fold
GRID = np.linspace(0, 1, 51)  # sensitivities of the stored ROC curves
NUM_RESAMPLES = 2000

Figures = dict[str, np.ndarray]  # score -> (S, 2) AUC and specificity of each scene


def measure(found: list[Putatives], *, has_cost: bool = True) -> tuple[Figures, Figures]:
    """Figures of merit of every score on every scene, and the ROC curves (S, 51)."""
    figures: dict[str, list] = {}
    curves: dict[str, list] = {}
    for one, ours in zip(found, score_ours(found, has_cost=has_cost), strict=True):
        correct, valid = torch.from_numpy(one.correct), torch.from_numpy(one.valid)
        peers = {name: torch.from_numpy(score) for name, score in score_peers(one).items()}
        for name, score in (peers | ours).items():
            if not bool(torch.isfinite(score).all()):  # else the scene would drop out unseen
                raise ValueError(f"score {name!r} of {one.scene} is not finite")
            counts = roc_update(score, correct, valid=valid)
            figures.setdefault(name, []).append((counts.auc(), counts.specificity_at(PAPER_SENSITIVITY)))
            curve = roc_curve(score, correct, valid=valid)
            curves.setdefault(name, []).append(np.interp(GRID, curve.sensitivity, curve.specificity))
    return {k: np.array(v) for k, v in figures.items()}, {k: np.array(v) for k, v in curves.items()}


def interval(values: np.ndarray) -> tuple[float, float]:
    """95 % interval of the mean over scenes: percentiles over scenes drawn with replacement, always the same ones."""
    rows = np.random.default_rng(0).integers(len(values), size=(NUM_RESAMPLES, len(values)))
    low, high = np.nanpercentile(np.nanmean(values[rows], 1), [2.5, 97.5])
    return round(float(low), 4), round(float(high), 4)


def report(suite: Suite, title: dict[str, object], figures: Figures, curves: Figures | None = None) -> None:
    """Print and keep the mean of each score with its interval, and ours against the best peer of the row."""
    print(", ".join(f"{key} {value}" for key, value in title.items()))
    for name, scenes in figures.items():
        auc, specificity = np.nanmean(scenes, 0).tolist()
        record = {
            **title, "score": name, "auc": round(auc, 5), "auc_interval": interval(scenes[:, 0]),
            "specificity_at_96": round(specificity, 5), "specificity_interval": interval(scenes[:, 1]),
            "scenes": len(scenes),
        }  # fmt: skip
        if curves is not None:
            record["roc_specificity"] = np.nanmean(curves[name], 0).round(4).tolist()
        suite.records.append(record)
        low, high = record["auc_interval"]
        print(f"  {name:28} AUC {auc:.3f} [{low:.3f}, {high:.3f}]  specificity {specificity:.3f}", flush=True)
    for k, merit in enumerate(("auc", "specificity_at_96")):
        peer = max((name for name in figures if name not in OURS), key=lambda name: np.nanmean(figures[name][:, k]))
        for name in (name for name in OURS if name in figures):
            gain = figures[name][:, k] - figures[peer][:, k]
            low, high = interval(gain)
            record = {
                **title,
                "score": name,
                "gain": merit,
                "over": peer,
                "mean": round(float(np.nanmean(gain)), 5),
                "interval": [low, high],
            }
            suite.records.append(record)
            print(f"  {name:28} {merit} {record['mean']:+.3f} [{low:+.3f}, {high:+.3f}] against {peer}")


def degrade(
    suite: Suite,
    title: str,
    found: list[Putatives],
    change: Callable[[Putatives, float, int], Putatives],
    values: tuple,
) -> None:
    """Report the figures of merit for each value of a disturbance of FAST's matches."""
    rows = {}
    for value in values:
        changed = [change(one, value, seed) for seed, one in enumerate(found)]
        rows[value], _ = measure(changed, has_cost=False)
        report(suite, {"disturbance": title, "value": value}, rows[value])
    draw_degradation(title, rows)


def main() -> None:
    suite = Suite("accuracy")
    cv2.setNumThreads(1)
    pairs = load_pairs(suite.options.data)
    for group in (group for group in UNSEEN if pairs[group]):
        panels = {}
        for detector in DETECTORS:
            for gated in (False, True):
                found = [find_putatives(pair, detector, gated=gated) for pair in pairs[group]]
                title = f"{detector}{', gated' if gated else ''}"
                figures, curves = measure(found)
                report(suite, {"group": group, "putatives": title}, figures, curves if group == "eight" else None)
                report_calibration(suite, {"group": group, "putatives": title}, found)
                panels[title] = {name: curve.mean(0) for name, curve in curves.items()}
        draw_roc(group, GRID, panels)
    source = "eight" if pairs["eight"] else "synthetic"
    found = [find_putatives(pair, "fast", gated=False) for pair in pairs[source]]
    degrade(suite, f"{source}, share of injected outliers", found, draw_random_partners, SHARES)
    half = [draw_random_partners(one, 0.5, seed) for seed, one in enumerate(found)]
    degrade(suite, f"{source}, 50 % outliers, noise in px", half, jitter_keypoints, SIGMAS_PX)
    suite.write()


if __name__ == "__main__":
    main()
