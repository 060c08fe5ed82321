"""Graphs, verdict and score of a batch, against the hard verdict alone."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

import tensor_stereo as ts
from tensor_stereo.configs import FilterConfig
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.scores import consensus_score

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite
from shared.points import matched_batch

PAIRS, COUNT = 64, 1000


def plain_consensus(matches: ts.Matches) -> torch.Tensor:
    """Native graphs, and the score in plain torch."""
    return consensus_score(matches, build_match_graphs(matches), FilterConfig(backend="scipy"))


@torch.inference_mode()
def main() -> None:
    suite = Suite("scores")
    for kind in ("float", "integer"):
        matches = matched_batch(kind, PAIRS, COUNT)
        names = ("topology", "consensus", "learned")
        filters = {name: ts.DelaunayFilter(verdict="cardinality", score=name) for name in names}
        cases = {"classify_matches": lambda m=matches: ts.classify_matches(m)}
        cases |= {name: lambda m=matches, f=f: f(m) for name, f in filters.items()}
        cases["consensus in plain torch"] = lambda m=matches: plain_consensus(m)
        for threads in (1, 2):
            title = f"score, {kind}, {PAIRS} pairs x {COUNT} matches"
            suite.compare(title, cases, threads=threads, units=PAIRS, repeats=min(9, suite.options.repeats))
    suite.write()


if __name__ == "__main__":
    main()
