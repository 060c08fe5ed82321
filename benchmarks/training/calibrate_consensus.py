"""Fit the calibration of the consensus score on the putatives that ``train_learned.py`` leaves in its folder WORK.

    python benchmarks/training/calibrate_consensus.py WORK

Prints slope and bias of each tolerance for rectified pairs, for any two views with epipolar lines, and without, fitted
with and without costs together, and the expected calibration error of each domain and kind of matches.
``tensor_stereo/scores/calibration.py`` holds them rounded. Only real scenes are used, because rendered ones have
another share of correct matches; what all matches share is taken out as the score takes it out.
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
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.scores import consensus_belief
from tensor_stereo.scores.alignment import estimate_alignment
from tensor_stereo.scores.tolerance import TOLERANCES_PX

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.calibration_error import calibration_error
from training.platt_scaling import fit_calibration
from training.putatives import Putatives
from training.work_folder import load_putatives

EPS = 1e-4  # beliefs are cut to EPS..1 - EPS before their log-odds are taken


def believe(given: Putatives, title: str, *, has_cost: bool) -> tuple[Tensor, Tensor]:
    """(K,) log-odds of the tested matches whose truth is known, and their errors in px."""
    matches = given.matches if has_cost else replace(given.matches, cost=None)
    graphs = build_match_graphs(matches)
    known = given.error_px.isfinite() & (classify_graphs(graphs).relation != 0)
    alignment = estimate_alignment(matches, graphs, rectified=title == "rectified")
    if title == "without lines":
        alignment = alignment._replace(lines=torch.zeros_like(alignment.lines))
    elif not alignment.has_rows.all():
        known = torch.zeros_like(known)
    belief = consensus_belief(matches, graphs, alignment=alignment)
    return torch.logit(belief[known].double(), eps=EPS), given.error_px[known]


def main() -> None:
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    work = parser.parse_args().work
    rectified, of_views = (load_putatives(work / kind) for kind in ("rectified", "views"))
    of_views += [replace(one, domain="rectified") for one in rectified if one.fixed]
    for title, putatives in (("rectified", rectified), ("with lines", of_views), ("without lines", of_views)):
        found = [
            (one, *believe(one, title, has_cost=has_cost))
            for one in putatives
            for has_cost in ((True, False) if one.matches.cost is not None else (False,))
        ]
        for tolerance in TOLERANCES_PX:
            judged = [item for item in found if item[0].least_error_px <= tolerance and len(item[1])]
            logit = torch.cat([logit for _, logit, _ in judged])
            correct = torch.cat([error for *_, error in judged]) <= tolerance
            weight = torch.cat([torch.full((len(logit),), len(logit) ** -0.5) for _, logit, _ in judged])
            slope, bias = fit_calibration(logit, correct, weight).tolist()
            print(f"{title}, {tolerance:g} px: slope {slope:.2f}, bias {bias:.2f}")
            groups: defaultdict[str, list[tuple[Tensor, Tensor]]] = defaultdict(list)
            for one, logit, error in judged:
                if one.fixed:
                    groups[f"{one.domain}, {one.kind}"].append((logit, error <= tolerance))
            for name, parts in sorted(groups.items()):
                logit, correct = (torch.cat(part) for part in zip(*parts, strict=True))
                error = calibration_error(torch.sigmoid(round(slope, 2) * logit + round(bias, 2)), correct)
                print(f"  {name:20} calibration error {error:.3f}")


if __name__ == "__main__":
    main()
