"""Growth with the size and the number of segments, with threads, and the memory of a large batch."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch

import tensor_stereo as ts
from tensor_stereo.ops import delaunay_graph

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite
from shared.points import matched_batch, random_points

MEMORY = """
import re, numpy as np, torch
import tensor_stereo as ts
tiny = ts.Matches(torch.rand(8, 2).double(), torch.rand(8, 2).double(), torch.tensor([0, 8]))
ts.classify_matches(tiny)
rng = np.random.default_rng(0)
left = rng.random((1024 * 2000, 2)) * [640, 480]
right = left - [25.0, 0.0]
matches = ts.Matches(torch.from_numpy(left), torch.from_numpy(right), torch.arange(1025) * 2000)
peak = lambda: 1024 * int(re.search(r"VmHWM:\\s*(\\d+)", open("/proc/self/status").read())[1])  # not of its parent
before = peak()
ts.classify_matches(matches)
print((peak() - before) / (left.nbytes + right.nbytes))
"""


def main() -> None:
    suite = Suite("scaling")
    for kind in ("float", "integer"):
        sizes = {n: (torch.from_numpy(random_points(kind, n)), torch.tensor([0, n])) for n in (1000, 10_000, 100_000)}
        many = torch.from_numpy(np.concatenate([random_points(kind, 1000, s) for s in range(100)]))
        cases = {
            "100 segments of 1000": lambda m=many: delaunay_graph(m, torch.arange(101) * 1000, None, 1e-3, "native"),
            "1 segment of 100000": lambda s=sizes[100_000]: delaunay_graph(*s, None, 1e-3, "native"),
        }
        suite.compare(f"growth with N, {kind}", cases, units=100_000, repeats=9)
        few, lots = matched_batch(kind, 16, 300), matched_batch(kind, 1024, 300)
        cases = {
            "16 segments x 64": lambda m=few: [ts.classify_matches(m) for _ in range(64)],
            "1024 segments": lambda m=lots: ts.classify_matches(m),
        }
        suite.compare(f"growth with segments of 300, {kind}", cases, units=1024, repeats=9)
        half = matched_batch(kind, 128, 1000)

        def on(threads: int, matches: ts.Matches = half) -> None:
            torch.set_num_threads(threads)
            ts.classify_matches(matches)

        suite.compare(f"threads, {kind}", {"2": lambda f=on: f(2), "1": lambda f=on: f(1)}, threads=2, units=128)
    ratio = subprocess.run([sys.executable, "-P", "-c", MEMORY], capture_output=True, text=True, check=True).stdout
    suite.note("memory, 1024 pairs x 2000 matches, peak / bytes of coordinates", ratio=float(ratio))
    suite.note("peak of this process", gigabytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
    suite.write()


if __name__ == "__main__":
    main()
