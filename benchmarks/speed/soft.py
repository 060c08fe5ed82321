"""The time of the soft score, forward and backward, beside the hard verdict."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

import tensor_stereo as ts
from tensor_stereo.batching import from_padded

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite
from shared.points import matched_points


def main() -> None:
    suite = Suite("soft")
    for num_pairs, num_rows in ((32, 512), (8, 2048), (2, 8192)):
        views = zip(*(matched_points("float", num_rows, seed) for seed in range(num_pairs)), strict=True)
        left, right = (torch.from_numpy(np.stack(view)) for view in views)
        rows0, ptr = from_padded(left)
        matches = ts.Matches(rows0, from_padded(right)[0], ptr)
        module = ts.DelaunayFilter(verdict="cardinality", score="topology")
        leaf = right.clone().requires_grad_()

        def backward(module=module, left=left, leaf=leaf) -> None:
            leaf.grad = None
            module(left, leaf).score.sum().backward()

        cases = {
            "classify_matches": lambda matches=matches: ts.classify_matches(matches),
            "DelaunayFilter forward": lambda module=module, left=left, right=right: module(left, right),
            "DelaunayFilter forward + backward": backward,
        }
        title = f"soft score, ({num_pairs}, {num_rows}, 2), 30 % wrong"
        suite.compare(title, cases, threads=2, units=num_pairs * num_rows)
    suite.write()


if __name__ == "__main__":
    main()
