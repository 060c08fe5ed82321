"""Inputs that make Delaunay builders quadratic or inexact, 1e5 points. scipy would need minutes and is left out."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

from tensor_stereo.ops import delaunay_graph

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite
from shared.points import random_points

COUNT = 100_000


def main() -> None:
    suite = Suite("adversarial")
    rng = np.random.default_rng(0)
    x = np.linspace(-1, 1, COUNT // 2)
    angle = rng.random(COUNT) * 2 * np.pi
    grid = np.stack(np.meshgrid(np.arange(400.0), np.arange(250.0)), -1).reshape(-1, 2)
    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    sets = {
        "uniform": random_points("float", COUNT),
        "parabola facing a line": np.concatenate([np.stack([x, x * x + 1], 1), np.stack([x, 0 * x], 1)]),
        "random points on a circle": np.stack([np.cos(angle), np.sin(angle)], 1),
        "grid of 8 px": grid * 8,
        "rotated grid": grid @ turn,
        "nearly collinear": np.stack([np.arange(1.0 * COUNT), 0.3 * np.arange(1.0 * COUNT) + 0.1], 1),
        "clusters": rng.integers(0, 30, (COUNT, 2)) + 1e-6 * rng.random((COUNT, 2)),
    }
    cases = {}
    for name, values in sets.items():
        tensor = torch.from_numpy(np.unique(values, axis=0))
        ptr = torch.tensor([0, len(tensor)])
        cases[name] = lambda t=tensor, p=ptr: delaunay_graph(t, p, None, 1e-3, "native")
    suite.compare("adversarial, 1e5 points", cases, units=COUNT, repeats=5)
    suite.write()


if __name__ == "__main__":
    main()
