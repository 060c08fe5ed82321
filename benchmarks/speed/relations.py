"""What the set tests add to the two graphs."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from tensor_stereo.classification import classify_graphs
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.ops import row_overlap

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite
from shared.points import matched_batch


def main() -> None:
    suite = Suite("relations")
    for kind in ("float", "integer"):
        matches = matched_batch(kind, 64, 1000)
        graphs = build_match_graphs(matches)
        a0, a1 = (graph.to_sparse_csr(torch.int8) for graph in (graphs.adjacency0, graphs.adjacency1))
        rows = [(a.crow_indices, a.col_indices) for a in (graphs.adjacency0, graphs.adjacency1)]
        cases = {
            "two graphs": lambda m=matches: build_match_graphs(m),
            "relations and verdicts": lambda g=graphs: classify_graphs(g),
            "row_overlap native": lambda r=rows: row_overlap(*r[0], *r[1], "native"),
            "row_overlap torch": lambda r=rows: row_overlap(*r[0], *r[1], "scipy"),
            "torch (A0 * A1).sum(1) on CSR": lambda p=a0, q=a1: (p * q).sum(1, keepdim=True),
        }
        suite.compare(f"relations, {kind}, 64 pairs x 1000 matches", cases, threads=2, units=64_000)
    suite.write()


if __name__ == "__main__":
    main()
