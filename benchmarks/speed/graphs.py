"""delaunay_graph against shull and scipy: points -> sorted CSR, one call per point set.

Each timing runs over several sets, so that neither caches nor branch predictors are tuned to one of them.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import shull
import torch
from scipy.sparse import csr_array
from scipy.spatial import Delaunay

from tensor_stereo.ops import delaunay_graph

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite
from shared.points import random_points


def scipy_csr(values: np.ndarray) -> csr_array:
    offsets, neighbors = Delaunay(values).vertex_neighbor_vertices
    graph = csr_array((np.ones(len(neighbors), dtype=bool), neighbors, offsets), shape=(len(values),) * 2)
    graph.sort_indices()
    return graph


def main() -> None:
    suite = Suite("graphs")
    for kind in ("float", "integer"):
        for count in (300, 1000, 3000, 10_000):
            sets = [random_points(kind, count, seed) for seed in range(max(2, 30_000 // count))]
            tensors, ptr = [torch.from_numpy(values) for values in sets], torch.tensor([0, count])

            def ours(tie_tolerance: float, backend: str, tensors: list = tensors, ptr: torch.Tensor = ptr) -> None:
                for tensor in tensors:
                    delaunay_graph(tensor, ptr, None, tie_tolerance, backend)

            cases = {
                "tensor_stereo native": lambda f=ours: f(1e-3, "native"),
                "tensor_stereo native, exact": lambda f=ours: f(0.0, "native"),
                "shull": lambda s=sets: [shull.Delaunay(values).vertex_neighbor_vertices for values in s],
                "scipy with CSR": lambda s=sets: [scipy_csr(values) for values in s],
                "tensor_stereo scipy": lambda f=ours: f(1e-3, "scipy"),
            }
            suite.compare(f"delaunay_graph, {kind}, N = {count}", cases, units=count * len(sets))
    suite.write()


if __name__ == "__main__":
    main()
