"""How well the soft score ranks matches, and how far it jumps where a graph changes."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

import tensor_stereo as ts
from tensor_stereo.configs import MatchingConfig, PipelineConfig
from tensor_stereo.evaluation import matches_against_gt, roc_auc
from tensor_stereo.evaluation.metrics import specificity_at_sensitivity
from tensor_stereo.pipeline import Stopwatch, match_pairs, to_gray_pairs

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite
from shared.points import matched_points
from shared.scenes import EIGHT, GATES, read_pairs

TEMPERATURES = (1.0,)  # the default; none is chosen on these scenes


def hard_jaccard(matches: ts.Matches) -> torch.Tensor:
    """Shared neighbours over all neighbours, 0 for untested matches."""
    verdict = ts.classify_matches(matches)
    union = verdict.degree0 + verdict.degree1 - verdict.overlap
    return torch.where(verdict.relation == 0, 0, verdict.overlap / union.clamp(min=1))


def measure_ranking(suite: Suite) -> None:
    """How well the soft score ranks matches beside the hard one: means over the paper's scenes."""
    pairs = read_pairs(suite.options.data / "middlebury", EIGHT)
    gray = to_gray_pairs([(pair.image0, pair.image1) for pair in pairs])
    for detector in ("sift", "fast", "gftt"):
        for gated, matching in ((False, MatchingConfig()), (True, GATES)):
            matches = match_pairs(gray, PipelineConfig(detector=detector, matching=matching), Stopwatch())
            correct, valid = matches_against_gt(matches, [pair.disparity_gt for pair in pairs], max_error_px=1.0)
            scores = {"hard": hard_jaccard(matches)}
            for temperature in TEMPERATURES:
                judge = ts.DelaunayFilter(verdict="cardinality", score="topology", temperature=temperature)
                scores[f"soft {temperature:g}"] = judge(matches).score
            for name, score in scores.items():
                figures = []
                for start, stop in zip(matches.ptr[:-1].tolist(), matches.ptr[1:].tolist(), strict=True):
                    part = slice(start, stop)
                    known = valid[part]
                    arguments = score[part].double(), correct[part]
                    figures.append(
                        (roc_auc(*arguments, valid=known), specificity_at_sensitivity(*arguments, 0.96, valid=known))
                    )
                auc, specificity = np.mean(figures, 0)
                title = f"{detector}{', gated' if gated else ''}, {name}"
                suite.note(title, auc=float(auc), specificity_at_96=float(specificity))


def measure_jumps(suite: Suite, num_flips: int = 200) -> None:
    """How far scores jump where the graph of view 0 changes while one of 64 points moves on a straight way."""
    found = []
    judge = ts.DelaunayFilter(verdict="cardinality", score="topology", tie_tolerance=0)
    for seed in range(num_flips):
        left, right = (torch.from_numpy(view) for view in matched_points("float", 64, seed))
        ptr, row = torch.tensor([0, 64]), seed % 64
        way = torch.tensor([np.cos(seed), np.sin(seed)]) * 40

        def at(share: float, left=left, right=right, ptr=ptr, row=row, way=way) -> tuple[list[int], torch.Tensor]:
            moved = left.clone()
            moved[row] += share * way
            edges = ts.build_graphs(moved, ptr, tie_tolerance=0).col_indices.tolist()
            return edges, judge(ts.Matches(moved, right, ptr)).score

        low, high = 0.0, 1.0
        if at(low)[0] == at(high)[0]:
            continue
        start = at(low)[0]
        while high - low > 1e-13:
            middle = (low + high) / 2
            low, high = (middle, high) if at(middle)[0] == start else (low, middle)
        found.append(float((at(high)[1] - at(low)[1]).abs().max()))
    median, most = np.percentile(found, [50, 95])
    title = "largest jump of a score where an edge of the graph changes, 64 points"
    suite.note(title, flips=len(found), median=float(median), percentile_95=float(most), largest=max(found))


def main() -> None:
    suite = Suite("soft_ranking")
    measure_jumps(suite)
    if suite.options.data is not None:
        measure_ranking(suite)
    suite.write()


if __name__ == "__main__":
    main()
