"""delaunay_graph against shull and scipy: points -> sorted CSR."""

from __future__ import annotations

import numpy as np
import shull
import torch
from harness import Suite, points
from scipy.sparse import csr_array
from scipy.spatial import Delaunay

from tensor_stereo.ops import delaunay_graph


def scipy_csr(values: np.ndarray) -> csr_array:
    offsets, neighbors = Delaunay(values).vertex_neighbor_vertices
    graph = csr_array((np.ones(len(neighbors), dtype=bool), neighbors, offsets), shape=(len(values),) * 2)
    graph.sort_indices()
    return graph


def main() -> None:
    suite = Suite("graphs")
    for kind in ("float", "integer"):
        for count in (300, 1000, 3000, 10_000):
            values = points(kind, count)
            tensor, ptr = torch.from_numpy(values), torch.tensor([0, count])
            cases = {
                "tensor_stereo native": lambda t=tensor, p=ptr: delaunay_graph(t, p, None, 1e-3, "native"),
                "tensor_stereo native, exact": lambda t=tensor, p=ptr: delaunay_graph(t, p, None, 0.0, "native"),
                "shull": lambda v=values: shull.Delaunay(v).vertex_neighbor_vertices,
                "scipy with CSR": lambda v=values: scipy_csr(v),
                "tensor_stereo scipy": lambda t=tensor, p=ptr: delaunay_graph(t, p, None, 1e-3, "scipy"),
            }
            suite.compare(f"delaunay_graph, {kind}, N = {count}", cases, units=count)
    suite.write()


if __name__ == "__main__":
    main()
