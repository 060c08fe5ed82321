"""Fit the calibration of the consensus score on the records that ``train_learned.py`` leaves in its folder WORK.

    python benchmarks/training/calibrate_consensus.py WORK

Prints slope and bias for rectified and other pairs, with and without costs, and the expected calibration error of each
kind of matches. ``tensor_stereo/scores/calibration.py`` holds slope and bias rounded, the same with and without costs.
Only real scenes are used, because rendered ones have another share of correct matches.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from tensor_stereo.classification import classify_graphs
from tensor_stereo.configs import UNRECTIFIED, FilterConfig
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.scores import calibrate_consensus, consensus_belief

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.calibration_error import calibration_error
from training.platt_scaling import fit_calibration
from training.work_folder import FOLDS, load_records

EPS = 1e-4  # beliefs are cut to EPS..1 - EPS before their log-odds are taken


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
