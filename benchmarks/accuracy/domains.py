"""Where our probabilities hold: by domain, tolerance and kind of putatives, and where rows do not agree.

Beside them stand peers that look at the coordinates alone.

    python benchmarks/accuracy/domains.py --training-data TRAINING_DATA --folds WORK

The eight scenes of the paper are scored by the shipped weights, which never saw them; scenes of the training set by the
network of the cross-validation that was trained without them, and without frames of KITTI that look alike.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from tensor_stereo.configs import FilterConfig
from tensor_stereo.evaluation.metrics import PAPER_SENSITIVITY, roc_update
from tensor_stereo.scores import LearnedScore, load_learned, score_matches
from tensor_stereo.scores.tolerance import TOLERANCES_PX

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from accuracy.peers import score_disparity, score_lpm
from accuracy.putatives import GrayPair, Putatives, find_putatives, load_pairs, to_images, to_matches
from accuracy.ranking import interval
from shared.calibration_error import calibration_error
from shared.harness import Suite
from training.scenes import KITTI_LEAST_PX, fold_of
from training.work_folder import load_fold_networks

PEERS = ("LPM", "libviso2 support", "disparity median, Delaunay")
KINDS = tuple((detector, gated) for detector in ("sift", "fast", "gftt") for gated in (False, True))
SCORES = ("consensus", "learned, no images", "learned")
MOVES = ((8.0, 0.02), (-8.0, -0.02), (3.0, 0.0))  # rows of view 1 at y1 + a + b x1


class Case(NamedTuple):
    """One pair's putatives and what scores say of them."""

    found: Putatives
    cumulative: dict[str, torch.Tensor]  # by score, (M, 5); those of peers are the same for all tolerances


def score(found: Putatives, network: LearnedScore, *, images: bool = True) -> dict[str, torch.Tensor]:
    """The probabilities (M, 5) of every score, with costs."""
    matches = to_matches([found], with_cost=True)
    consensus = score_matches(matches, FilterConfig(score="consensus"))
    learned = partial(score_matches, matches, graphs=consensus.graphs, alignment=consensus.alignment, network=network)
    scores = {"consensus": consensus.cumulative, "learned, no images": learned().cumulative}
    if images:
        scores["learned"] = learned(images=tuple(to_images([found]))).cumulative
    return scores


def score_coordinates(found: Putatives) -> dict[str, torch.Tensor]:
    """The peers' scores (M, 5)."""
    scores = {"LPM": score_lpm(found)} | score_disparity(found)
    return {name: torch.from_numpy(scores[name])[:, None].expand(-1, len(TOLERANCES_PX)) for name in PEERS}


def move_rows(given: Putatives, a: float, b: float) -> Putatives:
    """The same matches, view 1 as a rig would give it that is not quite calibrated."""
    points1 = given.points1.copy()
    points1[:, 1] += a + b * given.points1[:, 0]
    return replace(given, points1=points1)


def rank(cases: Iterable[Case], name: str, k: int, *, rows_count: bool = True) -> np.ndarray:
    """(S, 2) AUC and specificity of each pair at tolerance k."""
    figures = []
    for found, cumulative in cases:
        error = torch.from_numpy(found.error_px if rows_count else found.disparity_error_px)
        correct, valid = error <= TOLERANCES_PX[k], ~error.isnan()
        if 0 < correct.sum() < valid.sum():
            counts = roc_update(cumulative[name][:, k], correct, valid=valid)
            figures.append((counts.auc(), counts.specificity_at(PAPER_SENSITIVITY)))
    return np.array(figures).reshape(-1, 2)


def _held_out(scene: str) -> int:
    fold = fold_of(scene)
    if fold is None:
        raise ValueError(f"no network was trained without {scene}")
    return fold


def report(suite: Suite, group: str, kind: str, cases: list[Case], least_px: float) -> None:
    """Ranking and calibration of every score at every tolerance that the truth can judge."""
    error = torch.from_numpy(np.concatenate([case.found.error_px for case in cases]))
    known = ~error.isnan()
    for name in (*PEERS, *SCORES):
        probability = torch.cat([case.cumulative[name] for case in cases])
        for k, tolerance in enumerate(TOLERANCES_PX):
            if tolerance < least_px:
                continue
            figures = rank(cases, name, k)
            auc, specificity = figures.mean(0)
            low, high = interval(figures[:, 0])
            values = {"auc": auc, "auc_low": low, "auc_high": high, "specificity_at_96": specificity}
            if name in SCORES:
                values["calibration_error"] = calibration_error(probability[known, k], error[known] <= tolerance)
            suite.note(f"{group}, {kind}, {name}, {tolerance:g} px", **values)
        if group == "eight":
            auc, specificity = rank(cases, name, TOLERANCES_PX.index(1), rows_count=False).mean(0)
            suite.note(f"{group}, {kind}, {name}, 1 px, rows do not count", auc=auc, specificity_at_96=specificity)


def report_moved(suite: Suite, kind: str, cases: list[Case], network: LearnedScore) -> None:
    """By how much scores change where the rows of view 1 move; images stay, so that no score looks at them."""
    one = TOLERANCES_PX.index(1)
    for a, b in MOVES:
        moved = [Case(c.found, score(move_rows(c.found, a, b), network, images=False)) for c in cases]
        for name in SCORES[:2]:
            change = torch.cat(
                [(m.cumulative[name] - c.cumulative[name])[:, one] for m, c in zip(moved, cases, strict=True)]
            )
            before, after = (rank(x, name, one).mean(0)[0] for x in (cases, moved))
            title = f"eight moved by {a:g} + {b:g} x1, {kind}, {name}"
            suite.note(title, auc_change=after - before, median_change=float(change.abs().median()))


@torch.no_grad()
def main() -> None:
    suite = Suite("domains", **{"training-data": "folder of further pairs", "folds": "folder WORK of train_learned.py"})
    cv2.setNumThreads(1)
    folds, shipped = load_fold_networks(suite.options.folds), load_learned()
    groups = load_pairs(suite.options.data)
    groups["kitti"] += load_pairs(suite.options.training_data)["kitti"]
    named: dict[str, list[GrayPair]] = {
        "eight": groups["eight"],
        "Middlebury": groups["training"],
        "ETH3D": groups["eth3d"],
        "KITTI": groups["kitti"],
    }
    for group, pairs in named.items():
        least_px = KITTI_LEAST_PX if group == "KITTI" else 0
        totals = []
        for detector, gated in KINDS:
            kind = f"{detector}{' g' if gated else ''}"
            found = [find_putatives(pair, detector, gated=gated) for pair in pairs]
            networks = [shipped if group == "eight" else folds[_held_out(one.scene)] for one in found]
            cases = [
                Case(one, score(one, network) | score_coordinates(one))
                for one, network in zip(found, networks, strict=True)
            ]
            report(suite, group, kind, cases, least_px)
            if group == "eight":
                report_moved(suite, kind, cases, shipped)
            totals.append(cases)
        for name in (*PEERS, *SCORES):
            for k, tolerance in enumerate(TOLERANCES_PX):
                if tolerance >= least_px:
                    auc, specificity = np.mean([rank(cases, name, k).mean(0) for cases in totals], 0)
                    title = f"{group}, mean of the six kinds, {name}, {tolerance:g} px"
                    suite.note(title, auc=auc, specificity_at_96=specificity)
    suite.write()


if __name__ == "__main__":
    main()
