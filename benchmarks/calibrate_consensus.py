"""Fit the calibration of the consensus score on the records that ``train_learned.py`` leaves in its folder WORK.

    python calibrate_consensus.py WORK

Prints slope and bias for rectified pairs and others, with and without costs, as ``scores/calibration.py`` holds them
(rounded, costs or not), and the expected calibration error of each kind of matches under these. Real scenes only; the
share of correct matches among rendered ones is another.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import torch
from accuracy_calibration import calibration_error
from torch import Tensor
from train_learned import FOLDS, fit_calibration, load_records

from tensor_stereo.configs import UNRECTIFIED, FilterConfig
from tensor_stereo.filters import classify_graphs
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.scores.calibration import calibrate_consensus
from tensor_stereo.scores.consensus import consensus_belief

EPS = 1e-4  # probability at which the log-odds of a belief are cut


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    records = load_records(parser.parse_args().work, [scene for fold in FOLDS for scene in fold])
    for rectified, config in ((True, FilterConfig()), (False, FilterConfig(consensus=UNRECTIFIED))):
        for has_cost in (True, False):
            beliefs, truths, weights = [], [], []
            groups: defaultdict[str, list[tuple[Tensor, Tensor]]] = defaultdict(list)
            for record in records:
                matches = record.matches if has_cost else replace(record.matches, cost=None)
                graphs = build_match_graphs(matches)
                known = record.valid & (classify_graphs(graphs).relation != 0)
                if not known.any():
                    continue
                belief, correct = consensus_belief(matches, graphs, config)[known].double(), record.correct[known]
                beliefs.append(belief)
                truths.append(correct)
                weights.append(torch.full((len(belief),), len(belief) ** -0.5))
                if record.fixed:
                    groups[f"{record.detector}{', gated' if record.gated else ''}"].append((belief, correct))
            parts = torch.logit(torch.cat(beliefs), eps=EPS), torch.cat(truths), torch.cat(weights)
            slope, bias = fit_calibration(*parts).tolist()
            title = f"{'' if rectified else 'not '}rectified, {'with' if has_cost else 'no'} cost"
            print(f"{title}: slope {slope:.3f}, bias {bias:.3f}")
            for name, found in sorted(groups.items()):
                belief, correct = (torch.cat(part) for part in zip(*found, strict=True))
                raw = calibration_error(belief, correct)
                error = calibration_error(calibrate_consensus(belief, rectified=rectified), correct)
                print(f"  {name:12} calibration error {raw:.3f}, calibrated {error:.3f}")


if __name__ == "__main__":
    main()
