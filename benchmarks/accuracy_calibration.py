"""How far calibrated scores hold: expected calibration error, and the rates that targets reach."""

from __future__ import annotations

import numpy as np
import torch
from accuracy_data import Putatives, to_images, to_matches
from harness import Suite

import tensor_stereo as ts
from tensor_stereo.filters import classify_graphs
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.metrics import match_rates
from tensor_stereo.scores.calibration import calibrate_consensus, keep_by_target
from tensor_stereo.scores.consensus import consensus_belief
from tensor_stereo.scores.evidence import measure_images
from tensor_stereo.scores.learned import load_learned

NUM_BINS = 15
TARGETS = ({"target_sensitivity": 0.9}, {"target_sensitivity": 0.96}, {"min_precision": 0.9}, {"min_precision": 0.95})


def calibration_error(probability: torch.Tensor, correct: torch.Tensor) -> float:
    """Expected calibration error over equal-width bins (Guo et al., ICML 2017)."""
    cell = (probability * NUM_BINS).long().clamp(0, NUM_BINS - 1)
    gap = torch.zeros(NUM_BINS, dtype=torch.float64).index_add(0, cell, probability.double() - correct.double())
    return float(gap.abs().sum() / len(cell))


def find_probabilities(found: list[Putatives]) -> tuple[ts.Matches, torch.Tensor, dict[str, torch.Tensor]]:
    """All pairs as one batch, which of their matches are tested, and probabilities of being correct by name."""
    matches, network = to_matches(found, with_cost=True), load_learned()
    graphs = build_match_graphs(matches)
    belief = consensus_belief(matches, graphs)
    evidence = measure_images(*to_images(found), matches, graphs)
    plain, shown = network(matches, graphs), network(matches, graphs, evidence)
    probabilities = {
        "consensus + cost, raw": belief,
        "consensus + cost": calibrate_consensus(belief),
        "learned, no images": plain[1],
        "learned, raw": torch.sigmoid(shown[0]),
        "learned": shown[1],
    }
    return matches, classify_graphs(graphs).relation != 0, probabilities


@torch.no_grad()
def report_calibration(suite: Suite, title: dict[str, object], found: list[Putatives]) -> None:
    """The error over all pairs together, and the mean rate over the pairs that each target reaches."""
    matches, tested, probabilities = find_probabilities(found)
    correct, valid = (torch.from_numpy(np.concatenate([getattr(p, n) for p in found])) for n in ("correct", "valid"))
    known = valid & tested
    name = ", ".join(map(str, title.values()))
    for kind, probability in probabilities.items():
        error = calibration_error(probability[known], correct[known])
        suite.note(f"{name}, {kind}", calibration_error=error)
        if kind.endswith("raw"):
            continue
        for target in TARGETS:
            kept = keep_by_target(probability, tested, matches.ptr, **target)
            rates = [
                match_rates(*(values[start:stop] for values in (kept, correct, valid)))
                for start, stop in zip(matches.ptr[:-1].tolist(), matches.ptr[1:].tolist(), strict=True)
            ]
            ((wanted, least),) = target.items()
            reached = [r.sensitivity if wanted == "target_sensitivity" else r.npv for r in rates]
            specificity = float(np.nanmean([r.specificity for r in rates]))
            suite.note(f"{name}, {kind}, {wanted} {least}", reached=float(np.nanmean(reached)), specificity=specificity)
