"""Sweeps: engines and workers against plain calls in one process, memory over time, resuming, units without work."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from multiprocessing import active_children
from pathlib import Path

import numpy as np
import polars as pl

from tensor_stereo.configs import SweepConfig, TrialConfig
from tensor_stereo.datasets import build_manifest, read_manifest, write_manifest, write_synthetic
from tensor_stereo.datasets.pair_table import PairTable
from tensor_stereo.evaluation.rows import STAGES
from tensor_stereo.sweeps import SweepProgress, build_plan, run_sweep
from tensor_stereo.sweeps.batches import METRICS_SCHEMA, BatchResult, make_batch
from tensor_stereo.sweeps.driver import drive
from tensor_stereo.sweeps.plan import Task
from tensor_stereo.sweeps.ray_engine import RayEngine
from tensor_stereo.sweeps.store import FORMAT, RunStore
from tensor_stereo.sweeps.units import run_tasks

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite

SETTINGS = {"detector": "fast", "verdict": "cardinality", "score": "consensus"}
CONFIG = SweepConfig((TrialConfig(**SETTINGS),))
NUM_UNITS = 3000  # more than a minute on one worker
ROUNDS = 2
NUM_TRIVIAL = 100_000


def repeat(manifest: pl.DataFrame, count: int, path: Path) -> Path:
    """The same pairs under ``count`` names."""
    rows = manifest[np.arange(count) % len(manifest)]
    write_manifest(rows.with_columns(scene=pl.Series([f"{k:06d}" for k in range(count)])), path)
    return path


def resident_mb(pid: int | None) -> float:
    """Resident memory of a process; 0 of one that has just ended."""
    with contextlib.suppress(OSError):
        status = Path(f"/proc/{pid}/status").read_text()
        return next((int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmRSS")), 0.0)
    return 0.0


def timed_sweep(
    manifest: Path, folder: Path, watch: Callable[[SweepProgress], None] = lambda _: None, **options: object
) -> float:
    """Seconds per unit of a new run, from the first report of progress on: workers are warm then."""
    seen: list[tuple[float, int]] = []

    def report(state: SweepProgress) -> None:
        seen.append((time.perf_counter(), state.num_new))
        watch(state)

    out = folder / "run"
    shutil.rmtree(out, ignore_errors=True)
    summary = run_sweep(CONFIG, manifest, out, on_progress=report, **options)  # type: ignore[arg-type]
    end = time.perf_counter()
    assert summary.progress.num_failed == 0
    return (end - seen[0][0]) / (summary.progress.num_new - seen[0][1])


def plain_calls(manifest: Path) -> float:
    """Seconds per unit of calls in this process: no queue, no store."""
    plan = build_plan(CONFIG, read_manifest(manifest))
    run_tasks(CONFIG, [plan.task(0)])
    start = time.perf_counter()
    for unit in range(plan.num_units):
        run_tasks(CONFIG, [plan.task(unit)])
    return (time.perf_counter() - start) / plan.num_units


def trivial(_: SweepConfig, tasks: Sequence[Task]) -> BatchResult:
    """A row without any work for every unit."""
    row = dict.fromkeys(METRICS_SCHEMA) | {"trial": 0, "seconds": dict.fromkeys(STAGES, 0.0)}
    return make_batch([row | {"unit": task.unit, "scene": task.files.scene} for task in tasks])


def driver_rate(manifest: Path, folder: Path) -> float:
    """Units per second that do nothing, through Ray, the driver and the run folder, with the start of Ray."""
    pairs = PairTable(manifest, check_files=False)
    plan = build_plan(CONFIG, pairs)
    units = plan.shard(1, 1)
    record = {"format": FORMAT, "sweep": asdict(CONFIG), "manifest": {"num_pairs": len(pairs)}}
    engine = RayEngine(CONFIG, 2, run=trivial)
    start = time.perf_counter()
    with RunStore(folder / "trivial", record, pairs) as store:
        drive(engine, plan, store, units, units)
    return len(units) / (time.perf_counter() - start)


def main() -> None:
    suite = Suite("sweep")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rendered = build_manifest([write_synthetic(folder, 24)])
        manifest = repeat(rendered, NUM_UNITS, folder / "m.parquet")
        cases: dict[str, Callable[[], float]] = {
            "plain calls": lambda: plain_calls(manifest),
            "local, 1 worker": lambda: timed_sweep(manifest, folder, num_workers=1),
            "local, 2 workers": lambda: timed_sweep(manifest, folder, num_workers=2),
            "ray, 2 workers": lambda: timed_sweep(manifest, folder, num_workers=2, engine="ray"),
        }
        seconds: dict[str, list[float]] = {case: [] for case in cases}
        for _ in range(ROUNDS):
            for case, call in cases.items():
                seconds[case].append(call())
                suite.note(f"FAST, {NUM_UNITS} units, {case}", ms_per_unit=1e3 * seconds[case][-1])
        for title, above, below in (
            ("2 workers / 1 worker", "local, 1 worker", "local, 2 workers"),
            ("sweep of 1 worker / plain calls", "local, 1 worker", "plain calls"),
            ("ray / local, 2 workers", "ray, 2 workers", "local, 2 workers"),
        ):
            ratios = [a / b for a, b in zip(seconds[above], seconds[below], strict=True)]
            suite.note(title, ratio=statistics.median(ratios), lowest=min(ratios), highest=max(ratios))
        seen: list[tuple[float, float, float]] = []

        def watch(state: SweepProgress) -> None:
            workers = [resident_mb(child.pid) for child in active_children()]
            seen.append((state.num_new / NUM_UNITS, resident_mb(os.getpid()), max(workers, default=0.0)))

        timed_sweep(manifest, folder, watch, num_workers=2)
        for share in (0.1, 0.5, 0.9):
            _, driver, worker = min(seen, key=lambda entry: abs(entry[0] - share))
            suite.note(f"resident memory at {share:.0%} of the units, MB", driver=driver, worker=worker)
        trivial_units = repeat(rendered, NUM_TRIVIAL, folder / "trivial.parquet")
        suite.note("units without work through Ray and the run folder", per_second=driver_rate(trivial_units, folder))
        many = repeat(rendered, 10_000, folder / "many.parquet")
        shutil.rmtree(folder / "run")
        run_sweep(CONFIG, many, folder / "run", limit=0)
        known = json.loads((folder / "run" / "config.json").read_text())
        row = dict.fromkeys(METRICS_SCHEMA) | {"trial": 0, "num_valid": 1}
        with RunStore(folder / "run", known, PairTable(many, check_files=False)) as store:
            for first in range(0, 10_000, 100):
                store.add(make_batch([row | {"unit": unit} for unit in range(first, first + 100)]))
        (folder / "sweep.toml").write_text("[grid]\n" + "".join(f'{k} = "{v}"\n' for k, v in SETTINGS.items()))
        command = [sys.executable, "-P", "-m", "tensor_stereo", "sweep", str(folder / "sweep.toml")]
        command += ["--manifest", str(many), "--out", str(folder / "run")]
        resumed = []
        for _ in range(5):
            start = time.perf_counter()
            subprocess.run(command, check=True, capture_output=True)
            resumed.append(time.perf_counter() - start)
        suite.note(
            "resuming 10 000 finished units, whole process, s", median=statistics.median(resumed), highest=max(resumed)
        )
    suite.write()


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
