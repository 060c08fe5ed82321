"""What calibrated scores promise and what they hold: calibration error, and the rates that targets reach."""

from __future__ import annotations

import numpy as np
import torch

import tensor_stereo as ts
from accuracy.putatives import Putatives, to_images, to_matches
from shared.calibration_error import calibration_error
from shared.harness import Suite
from tensor_stereo.classification import classify_graphs
from tensor_stereo.configs import FilterConfig
from tensor_stereo.evaluation import match_rates
from tensor_stereo.scores import consensus_belief, keep_by_target, score_matches

TARGETS = ({"target_sensitivity": 0.9}, {"target_sensitivity": 0.96}, {"min_precision": 0.9}, {"min_precision": 0.95})


def find_probabilities(found: list[Putatives]) -> tuple[ts.Matches, torch.Tensor, dict[str, torch.Tensor]]:
    """All pairs as one batch, which of their matches are tested, and by name the probabilities of being correct."""
    matches = to_matches(found, with_cost=True)
    consensus = score_matches(matches, FilterConfig(score="consensus"))
    probabilities = {
        "consensus + cost, raw": consensus_belief(matches, consensus.graphs, alignment=consensus.alignment),
        "consensus + cost": consensus.score,
        "learned, no images": score_matches(matches).score,
        "learned": score_matches(matches, images=tuple(to_images(found))).score,
    }
    return matches, classify_graphs(consensus.graphs).relation != 0, probabilities


@torch.no_grad()
def report_calibration(suite: Suite, title: dict[str, object], found: list[Putatives]) -> None:
    """Note the error over the matches of all pairs, and for each target the mean over the pairs of what it reaches."""
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
