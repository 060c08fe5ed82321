"""Timing of alternatives in turns within one run, and its report."""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from shared.results import write_records

_SETTLE_S = 0.15  # threads of the case before, OpenBLAS's above all, spin for as long before they rest


class Suite:
    """One suite of comparisons; prints each and writes all as JSON.

    Args:
        name: name of the suite and of its file of results.
        folders: further command-line options that name a folder, each with its help text; all are required.
    """

    def __init__(self, name: str, **folders: str) -> None:
        parser = argparse.ArgumentParser(description=f"benchmark suite {name}")
        parser.add_argument("--repeats", type=int, default=15, help="rounds of each comparison")
        data = os.environ.get("TENSOR_STEREO_DATA")
        parser.add_argument("--data", type=Path, default=data, help="folder of the data sets")
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
            title: name of the comparison.
            cases: calls by name; ratios are to the first, which is ours.
            threads: number of torch's threads while they run.
            units: number of pairs, points or matches that one call handles, for the time per unit.
            repeats: number of rounds; None: the number given on the command line.

        Returns:
            For each case, the median over the rounds of its wall time divided by that of the first case.
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
                    time.sleep(_SETTLE_S)
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
        """Print and keep figures that do not compare calls."""
        self.records.append({"title": title, **values})
        print(f"{title}: " + ", ".join(f"{key} {value:.4g}" for key, value in values.items()), flush=True)

    def write(self) -> None:
        """Write results/NAME.json with the metadata of the run."""
        write_records(self.name, self.records, repeats=self.options.repeats)
