"""Timing of alternatives in turns within one run, and its report."""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import torch

import tensor_stereo as ts

RESULTS = Path(__file__).parent / "results"
PACKAGES = ("tensor-stereo", "torch", "numpy", "scipy", "kornia", "opencv-contrib-python-headless", "shull")


class Suite:
    """One suite of comparisons; prints each and writes all as JSON.

    Args:
        name: of the suite.
        folders: further options that it needs, and what they hold.
    """

    def __init__(self, name: str, **folders: str) -> None:
        parser = argparse.ArgumentParser(description=f"benchmark suite {name}")
        parser.add_argument("--repeats", type=int, default=15)
        parser.add_argument("--data", type=Path, default=os.environ.get("TENSOR_STEREO_DATA"))
        for folder, text in folders.items():
            parser.add_argument(f"--{folder}", type=Path, required=True, help=text)
        self.options = parser.parse_args()
        self.name = name
        self.records: list[dict] = []
        print(f"== {name}")

    def compare(
        self,
        title: str,
        cases: dict[str, Callable[[], object]],
        *,
        threads: int = 1,
        units: int = 1,
        repeats: int | None = None,
    ) -> dict[str, float]:
        """Time the cases in turns: A B C A B C ..., after one warm-up each.

        Args:
            title: of the comparison.
            cases: name -> call; ratios are to the first, which is ours.
            threads: torch threads while they run.
            units: what one call handles, for the time per unit.
            repeats: rounds.

        Returns:
            Median over the rounds of each case's wall time / that of the first in the same round.
        """
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        wall: dict[str, list[float]] = {name: [] for name in cases}
        cpu: dict[str, list[float]] = {name: [] for name in cases}
        try:
            for call in cases.values():
                call()
            for _ in range(repeats or self.options.repeats):
                for name, call in cases.items():
                    cpu_start, start = time.process_time(), time.perf_counter()
                    call()
                    wall[name].append(time.perf_counter() - start)
                    cpu[name].append(time.process_time() - cpu_start)
        finally:
            torch.set_num_threads(before)
        first = next(iter(cases))
        print(f"{title}, {threads} thread{'s' * (threads > 1)}")
        ratios = {}
        for name in cases:
            low, median, high = np.percentile(wall[name], [25, 50, 75])
            per_round = [a / b for a, b in zip(wall[name], wall[first], strict=True)]
            ratio_low, ratio, ratio_high = np.percentile(per_round, [25, 50, 75])
            ratios[name] = float(ratio)
            record = {
                "title": title, "case": name, "threads": threads, "units": units,
                "wall_s": {"q25": low, "median": median, "q75": high},
                "cpu_s": {"median": statistics.median(cpu[name])},
                "ratio_to_first": {"q25": ratio_low, "median": ratio, "q75": ratio_high},
            }  # fmt: skip
            self.records.append(record)
            low, median, high, busy = (1e6 * t / units for t in (low, median, high, record["cpu_s"]["median"]))
            spread = f"x{ratio:.2f} [{ratio_low:.2f}, {ratio_high:.2f}]"
            print(f"  {name:34} {median:11.3f} us/unit [{low:.3f}, {high:.3f}]  cpu {busy:11.3f}  {spread}", flush=True)
        return ratios

    def note(self, title: str, **values: float) -> None:
        """Print and keep figures that are no comparison of calls."""
        self.records.append({"title": title, **values})
        print(f"{title}: " + ", ".join(f"{key} {value:.4g}" for key, value in values.items()), flush=True)

    def write(self) -> None:
        """Write results/NAME.json with the metadata of the run."""
        RESULTS.mkdir(exist_ok=True)
        versions = {}
        for package in PACKAGES:
            try:
                versions[package] = version(package)
            except PackageNotFoundError:
                versions[package] = None
        metadata = {
            "versions": versions, "python": platform.python_version(), "machine": platform.machine(),
            "cores": os.cpu_count(), "repeats": self.options.repeats,
        }  # fmt: skip
        records = ",\n".join(json.dumps(record) for record in self.records)
        head = json.dumps({"suite": self.name, "metadata": metadata})[:-1]
        (RESULTS / f"{self.name}.json").write_text(f'{head}, "records": [\n{records}\n]}}\n')


def points(kind: str, count: int, seed: int = 0) -> np.ndarray:
    """``count`` distinct points on a 640 x 480 image: uniform float64, or integer pixels."""
    rng = np.random.default_rng([seed, count])
    if kind == "float":
        return rng.random((count, 2)) * [640, 480]
    width = max(640, int(np.sqrt(8 * count)))
    cells = rng.choice(width * width * 3 // 4, size=count, replace=False)
    return np.stack([cells % width, cells // width], 1).astype(np.float64)


def matched_points(kind: str, count: int, seed: int = 0, wrong: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Points of both views, of which a share of ``wrong`` matches at random."""
    left = points(kind, count, seed)
    rng = np.random.default_rng([seed, count, 1])
    disparity = 20 + 30 * np.sin(left[:, 0] / 200) * np.cos(left[:, 1] / 150)
    right = left - np.stack([disparity, np.zeros(count)], 1)
    if kind == "integer":
        right = np.round(right)
    bad = rng.random(count) < wrong
    right[bad] = points(kind, count, seed + 1)[bad]
    return left, right


def matched_batch(kind: str, pairs: int, count: int) -> ts.Matches:
    """``pairs`` pairs of :func:`matched_points`, always the same ones."""
    views = zip(*(matched_points(kind, count, 10 * b) for b in range(pairs)), strict=True)
    left, right = (torch.from_numpy(np.concatenate(view)) for view in views)
    return ts.Matches(left, right, torch.arange(pairs + 1) * count)
