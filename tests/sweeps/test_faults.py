"""What sweeps survive. After each fault: every good unit once, the bad ones with their reason, nothing lost."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from multiprocessing import active_children
from pathlib import Path

import cv2
import numpy as np
import polars as pl
import pytest

from tensor_stereo.configs import SweepConfig
from tensor_stereo.datasets import read_image, read_manifest, write_pfm
from tensor_stereo.datasets.pair_table import PairTable
from tensor_stereo.sweeps import SweepProgress, build_plan, expand_grid, read_errors, read_results, run_sweep
from tensor_stereo.sweeps.batches import BatchResult
from tensor_stereo.sweeps.driver import MAX_DEATHS, drive
from tensor_stereo.sweeps.engines import local_engine
from tensor_stereo.sweeps.plan import Task
from tensor_stereo.sweeps.store import FORMAT, RunStore
from tensor_stereo.sweeps.units import run_tasks
from tensor_stereo.workers import Outcome
from tests.sweeps.conftest import Inputs, assert_same, make_manifest, stored, write_pairs

FAST = SweepConfig(expand_grid([{"detector": "fast", "verdict": "cardinality"}]))
PATIENCE_S = 300.0  # a worker imports torch first, beside whatever else the machine does
SCRIPT = """
import os, signal, sys
from tensor_stereo.sweeps import read_grid, run_sweep
from multiprocessing import active_children

def fault(state):
    {fault}

if __name__ == "__main__":
    settings, manifest, out = sys.argv[1:]
    summary = run_sweep(read_grid(settings), manifest, out, num_workers=2, units_per_part=1, on_progress=fault)
    sys.exit(130 if summary.interrupted else 0)
"""


def _run_script(fault: str, inputs: Inputs, out: Path, **options: object) -> subprocess.Popen[str]:
    """A sweep in a process of its own, with a fault at every report of progress."""
    script = out.parent / "script.py"
    script.write_text(SCRIPT.format(fault=fault))
    command = [sys.executable, str(script), str(inputs.settings), str(inputs.manifest), str(out)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)  # type: ignore[call-overload, no-any-return]


def _ended(pid: int, timeout_ms: int = 60_000) -> bool:
    """Whether a process that is no child ends in time."""
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    try:
        return bool(poll.poll(timeout_ms))
    finally:
        os.close(descriptor)


def test_a_killed_worker_loses_no_unit(inputs: Inputs, expected: pl.DataFrame, tmp_path: Path) -> None:
    killed = []

    def kill_first(_: SweepProgress) -> None:
        if not killed:
            killed.append(active_children()[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    summary = run_sweep(inputs.config, inputs.manifest, tmp_path / "run", num_workers=2, on_progress=kill_first)
    assert killed
    assert summary.progress.num_failed == 0
    assert_same(stored(tmp_path / "run"), expected)
    assert "a worker died" in (tmp_path / "run" / "log.jsonl").read_text()


@pytest.mark.slow
def test_a_killed_driver_leaves_no_worker_and_a_run_that_goes_on(
    inputs: Inputs, expected: pl.DataFrame, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    fault = "print(*(child.pid for child in active_children()), flush=True); os.kill(os.getpid(), signal.SIGKILL)"
    process = _run_script(fault, inputs, out)
    printed, _ = process.communicate(timeout=120)
    assert process.returncode == -signal.SIGKILL
    workers = [int(word) for word in printed.split()]
    assert workers
    assert all(_ended(pid) for pid in workers)
    before = stored(out)
    assert 0 < len(before) < len(expected)
    summary = run_sweep(inputs.config, inputs.manifest, out, num_workers=1)
    assert summary.progress.num_new == 12 - before["unit"].n_unique()
    assert_same(stored(out), expected)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_finishes_what_is_under_way(
    inputs: Inputs, expected: pl.DataFrame, tmp_path: Path, number: signal.Signals
) -> None:
    out = tmp_path / "run"
    process = _run_script(f"os.kill(os.getpid(), {int(number)}) if state.num_new < 2 else None", inputs, out)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    before = stored(out)
    assert 0 < len(before) < len(expected)
    run_sweep(inputs.config, inputs.manifest, out, num_workers=1)
    assert_same(stored(out), expected)


@pytest.mark.slow
def test_two_processes_on_one_run(inputs: Inputs, expected: pl.DataFrame, tmp_path: Path) -> None:
    out = tmp_path / "run"
    command = [sys.executable, "-m", "tensor_stereo", "sweep", str(inputs.settings), "--out", str(out)]
    command += ["--manifest", str(inputs.manifest)]
    refused = []

    def start_second(_: SweepProgress) -> None:
        if not refused:
            refused.append(subprocess.run(command, capture_output=True, text=True, check=False))

    run_sweep(inputs.config, inputs.manifest, out, num_workers=1, on_progress=start_second)
    assert refused[0].returncode == 2
    assert "another process works on" in refused[0].stderr
    assert_same(stored(out), expected)


class _DeadlyEngine:
    """Runs tasks in this process; a batch with a deadly unit loses its worker."""

    num_workers = 2

    def __init__(self, config: SweepConfig, deadly: set[int]) -> None:
        self.config, self.deadly = config, deadly
        self.under_way: list[tuple] = []

    def submit(self, tasks) -> None:
        self.under_way.append(tuple(tasks))

    def collect(self, timeout_seconds: float) -> list[Outcome[Task, BatchResult]]:
        tasks = self.under_way.pop()
        dies = bool(self.deadly & {task.unit for task in tasks})
        return [Outcome(tasks, None if dies else run_tasks(self.config, tasks))]

    def close(self) -> None: ...


def test_only_the_unit_that_kills_its_worker_fails(inputs: Inputs, expected: pl.DataFrame, tmp_path: Path) -> None:
    pairs = PairTable(inputs.manifest)
    plan = build_plan(inputs.config, pairs)
    out = tmp_path / "run"
    units = plan.shard(1, 1)
    with RunStore(out, {"format": FORMAT, "sweep": asdict(inputs.config)}, pairs) as store:
        summary = drive(_DeadlyEngine(inputs.config, {3, 8}), plan, store, units, units)
    assert summary.progress.num_done == 12
    assert summary.progress.num_failed == 2
    errors = read_errors(out)
    assert errors["unit"].to_list() == [3, 8]
    assert errors["error"].unique().to_list() == ["WorkerDiedError"]
    assert (errors["attempts"] >= MAX_DEATHS).all()
    names = {(plan.task(unit).files.scene, k) for unit in (3, 8) for k in plan.task(unit).trials}
    of_others = [(row["scene"], row["trial"]) not in names for row in expected.iter_rows(named=True)]
    assert_same(stored(out), expected.filter(of_others))


def test_a_worker_that_dies_at_work_is_noticed_and_replaced(inputs: Inputs) -> None:
    """Killed between the first byte of a result, which is larger than a pipe holds, and its last."""
    grid = {"verdict": "cardinality", "score": "topology", "seed": list(range(240)), "outlier_rate": 0.5}
    config = SweepConfig(expand_grid([grid]), export_matches=True)
    plan = build_plan(config, read_manifest(inputs.manifest))
    engine = local_engine(config, 1)
    try:
        engine.submit([plan.task(0)])
        assert engine.collect(PATIENCE_S) == []  # it has begun
        (pid,) = [child.pid for child in active_children()]
        connection = next(iter(engine._workers))
        assert connection.poll(PATIENCE_S)  # it sends
        os.kill(pid or 0, signal.SIGKILL)
        assert engine.collect(PATIENCE_S) == [Outcome((plan.task(0),), None)]
        engine.submit([plan.task(0)])
        assert engine.collect(PATIENCE_S) == []
        (outcome,) = engine.collect(PATIENCE_S)
        assert outcome.result is not None
        assert len(outcome.result.metrics) == 240
    finally:
        engine.close()


@pytest.mark.slow
def test_a_second_signal_ends_a_sweep_with_a_stuck_worker(inputs: Inputs, tmp_path: Path) -> None:
    """At the first report the workers hang, as on a file system that does, and an end is asked for twice."""
    fault = "[os.kill(c.pid, signal.SIGSTOP) for c in active_children()]; [signal.raise_signal(2) for _ in range(2)]"
    process = _run_script(fault, inputs, tmp_path / "run")
    _, errors = process.communicate(timeout=120)
    assert "KeyboardInterrupt" in errors
    assert len(stored(tmp_path / "run")) > 0


@pytest.mark.slow
def test_a_script_without_a_guard_is_told_so(inputs: Inputs, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import sys\nfrom tensor_stereo.sweeps import read_grid, run_sweep\n"
        "run_sweep(read_grid(sys.argv[1]), sys.argv[2], sys.argv[3], num_workers=2)\n"
    )
    command = [sys.executable, str(script), str(inputs.settings), str(inputs.manifest), str(tmp_path / "run")]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert "WorkerStartError" in result.stderr
    assert '__name__ == "__main__"' in result.stderr
    assert not (tmp_path / "run").exists()


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _rewrite(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))


def _to_palette(path: Path) -> None:
    from PIL import Image

    Image.fromarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)).convert("P").save(path)


BAD: dict[str, Callable[[Path], object]] = {
    "synthetic-00-0.png": _truncate,
    "synthetic-01-1.png": lambda path: path.write_bytes(b""),
    "synthetic-02.pfm": lambda path: path.write_bytes(b"Px" + path.read_bytes()[2:]),
    "synthetic-03.pfm": _truncate,
    "synthetic-04-1.png": lambda path: path.unlink(),
    "synthetic-05-0.png": lambda path: _rewrite(path, lambda image: image[:, :-1]),
}


def test_damaged_files_are_errors_with_their_reason_and_odd_ones_are_read(tmp_path: Path) -> None:
    folder = tmp_path / "pairs"
    manifest = make_manifest(write_pairs(folder, 13))
    wide = read_image(folder / "synthetic-06-0.png")
    for name, change in BAD.items():
        change(folder / name)
    for view in (0, 1):
        _rewrite(folder / f"synthetic-06-{view}.png", lambda image: image.astype(np.uint16) * 257)
        _rewrite(folder / f"synthetic-07-{view}.png", lambda image: np.dstack([*[image] * 3, np.full_like(image, 9)]))
        _to_palette(folder / f"synthetic-08-{view}.png")
        _rewrite(folder / f"synthetic-12-{view}.png", lambda image: image[:1, :1])
    left, right = folder / "synthetic-09-0.png", folder / "synthetic-09-1.png"
    left.rename(folder / "other.png")
    right.rename(left)
    (folder / "other.png").rename(right)
    write_pfm(folder / "synthetic-10.pfm", np.full((120, 160), np.inf, np.float32))  # nothing is known
    write_pfm(folder / "synthetic-12.pfm", np.ones((1, 1), np.float32))
    assert (read_image(folder / "synthetic-06-0.png") == wide).all()
    out = tmp_path / "run"
    summary = run_sweep(FAST, manifest, out, num_workers=2)
    assert summary.progress.num_done == 13
    errors = {row["scene"]: row for row in read_errors(out).iter_rows(named=True)}
    assert errors.keys() == {name[:12] for name in BAD}
    for name in BAD:
        assert name in errors[name[:12]]["message"]
        assert errors[name[:12]]["stage"] == "read"
    rows = {row["scene"]: row for row in read_results(out).iter_rows(named=True)}
    assert rows.keys() == {f"synthetic-{k:02d}" for k in range(6, 13)}
    assert rows["synthetic-09"]["fraction_incorrect"] > 0.9  # the views are swapped
    assert rows["synthetic-10"]["num_valid"] == 0
    assert np.isnan(rows["synthetic-10"]["sensitivity"])
    assert rows["synthetic-12"]["num_matches"] == 0
    assert rows["synthetic-06"]["num_matches"] == rows["synthetic-06"]["num_valid"] > 0


@pytest.mark.slow
def test_an_image_of_a_hundred_megapixels(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (80, 120), dtype=np.uint8)
    image = np.zeros((8_000, 12_000), np.uint8)
    image[4_000:4_080, 6_000:6_120] = noise
    cv2.imwrite(str(tmp_path / "left.png"), image)
    cv2.imwrite(str(tmp_path / "right.png"), np.roll(image, -9, 1))
    cv2.imwrite(str(tmp_path / "gt.png"), np.full_like(image, 9))
    (tmp_path / "pairs.csv").write_text("image0,image1,disparity_gt,gt_scale\nleft.png,right.png,gt.png,1\n")
    manifest = make_manifest(tmp_path / "pairs.csv")
    run_sweep(FAST, manifest, tmp_path / "run", num_workers=1)
    (row,) = read_results(tmp_path / "run").iter_rows(named=True)
    assert row["num_matches"] > 100
    assert row["fraction_incorrect"] < 0.05
