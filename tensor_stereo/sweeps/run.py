"""A sweep from its settings to its run folder."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import platform
import signal
import threading
import time
import warnings
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import torch

from tensor_stereo.configs import SweepConfig
from tensor_stereo.datasets import read_manifest
from tensor_stereo.datasets.pair_table import OPTIONAL
from tensor_stereo.evaluation.trials import TrialRunner
from tensor_stereo.scores.domain import DomainWarning
from tensor_stereo.sweeps.engines import Engine, LocalEngine, Outcome
from tensor_stereo.sweeps.grid import simplify
from tensor_stereo.sweeps.log import log_to_file
from tensor_stereo.sweeps.plan import Plan, Task, build_plan
from tensor_stereo.sweeps.ray_engine import RayEngine
from tensor_stereo.sweeps.store import FORMAT, RunStore, append_environment
from tensor_stereo.sweeps.units import failed_unit
from tensor_stereo.table_files import read_parquet
from tensor_stereo.types import StereoPair
from tensor_stereo.versions import package_versions

EngineName = Literal["local", "ray"]
MAX_DEATHS = 2  # workers that certainly died at a unit before it counts as failed
BATCH_SECONDS = 1.0  # about: long against the way to a worker and back, short against a user's patience
MAX_BATCH = 32
LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class SweepProgress:
    """How far this process is.

    Attributes:
        num_units: units that this process has to do or found done.
        num_done: those that are done, found so or failed.
        num_failed: those of them that failed.
        num_new: those that this process did, of
        num_todo: those that it will do, unless it is stopped.
        seconds: since the first unit was submitted.
    """

    num_units: int
    num_done: int
    num_failed: int
    num_new: int
    num_todo: int
    seconds: float

    @property
    def units_per_second(self) -> float:
        return self.num_new / self.seconds if self.seconds > 0 else 0.0

    @property
    def seconds_left(self) -> float:
        """NaN before the first unit is done."""
        rate = self.units_per_second
        return (self.num_todo - self.num_new) / rate if rate else float("nan")


@dataclass(frozen=True)
class SweepSummary:
    """How a sweep ended: its progress, and whether it was asked to stop before it was done."""

    progress: SweepProgress
    interrupted: bool


def run_sweep(
    config: SweepConfig,
    manifest: Path | str,
    out: Path | str,
    *,
    engine: EngineName = "local",
    num_workers: int | None = None,
    ray_address: str | None = None,
    shard: tuple[int, int] = (1, 1),
    limit: int | None = None,
    retry_errors: bool = False,
    verify: bool = False,
    units_per_part: int = 500,
    seconds_per_part: float = 30.0,
    log_level: str = "INFO",
    on_progress: Callable[[SweepProgress], None] | None = None,
) -> SweepSummary:
    """Run every pair of a manifest through every point of a grid, and store what comes out.

    A run that ended early, for whatever reason, goes on where it was: call it again with the same arguments. A release
    that only adds settings continues the run of an earlier one, with the defaults of those settings. SIGINT and
    SIGTERM finish the units under way first; a second one ends at once. Results do not depend on engine, number of
    workers, shards or interruptions, in all columns but ``seconds``, ``host`` and ``attempt``.

    Args:
        config: the points of the grid.
        manifest: Parquet file as :func:`tensor_stereo.datasets.write_manifest` writes it.
        out: run folder; see :mod:`tensor_stereo.sweeps.store` for what it holds.
        engine: ``local``, processes on this machine, or ``ray``.
        num_workers: None: one per core of this machine or cluster.
        ray_address: of a running Ray cluster; None: the one that this process is connected to, or a new one.
        shard: (i, n): do the i-th of n parts of the sweep, counted from 1. Shards may run at the same time.
        limit: do no more than so many units now.
        retry_errors: do failed units again.
        verify: hash the finished parts instead of trusting their size.
        units_per_part: units after which a part is written, and
        seconds_per_part: the time after which one is written in any case; what a crash costs, besides the units under
            way.
        log_level: of ``log.jsonl``.
        on_progress: called after every batch.

    Returns:
        What is done, and whether the sweep was interrupted.

    Raises:
        ValueError: for bad settings, a wrong manifest, or a run folder of another configuration.
        SweepError: if another process works on the same shard, or no worker starts.
        OSError: if the run folder cannot be written; what its journal lists is safe.
    """
    out = Path(out)
    if limit is not None and limit < 0:
        raise ValueError(f"limit must not be negative, got {limit}")
    if num_workers is not None and num_workers < 1:
        raise ValueError(f"num_workers must be at least 1, got {num_workers}")
    if engine not in ("local", "ray"):
        raise ValueError(f"engine must be 'local' or 'ray', got {engine!r}")
    config = replace(config, trials=tuple(simplify(trial) for trial in config.trials))
    plan = build_plan(config, read_manifest(manifest, check_files=False))
    units = plan.shard(*shard)
    if not (out / "config.json").exists():
        check_trials(config)
    table = read_parquet(Path(manifest))
    record = {
        "format": FORMAT,
        "sweep": asdict(config),
        "manifest": {"num_pairs": len(plan.pairs), "sha256": _fingerprint(plan)},
    }
    store = RunStore(
        out,
        record,
        table,
        shard=shard,
        units_per_part=units_per_part,
        seconds_per_part=seconds_per_part,
        verify=verify,
    )
    with store, log_to_file(out / "log.jsonl", log_level):
        known = store.state.good if retry_errors else store.state.done
        todo = [unit for unit in units if unit not in known]
        num_found = len(units) - len(todo)
        todo = todo if limit is None else todo[:limit]
        LOG.info("start", extra={"units": len(units), "todo": len(todo), "engine": engine, "shard": list(shard)})
        append_environment(out, _environment(engine, num_workers, shard))
        workers: Engine | None = None
        if todo:
            local = engine == "local"
            workers = LocalEngine(config, num_workers) if local else RayEngine(config, num_workers, ray_address)
        summary = drive(workers, plan, store, units, todo, num_found, on_progress)
        LOG.info("end", extra={"interrupted": summary.interrupted, **asdict(summary.progress)})
        return summary


def drive(
    engine: Engine | None,
    plan: Plan,
    store: RunStore,
    units: Collection[int],
    todo: Collection[int],
    num_found: int = 0,
    on_progress: Callable[[SweepProgress], None] | None = None,
) -> SweepSummary:
    """Run the units ``todo`` among ``units`` on an engine, which is closed at the end; None: there is nothing to do."""
    driver = _Driver(plan, store, units, todo, num_found, on_progress)
    if engine is not None:
        try:
            driver.run(engine)
        finally:
            engine.close()
    end = driver.progress()
    return SweepSummary(end, interrupted=driver.stopping and end.num_new < end.num_todo)


def check_trials(config: SweepConfig) -> None:
    """Run every point once on a small noise image, and report a bad setting before the sweep begins.

    Raises:
        ValueError: naming the point.
    """
    noise = torch.randint(0, 256, (1, 64, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    runner = TrialRunner(StereoPair("noise", noise, noise, torch.zeros(64, 64)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DomainWarning)  # noise may be outside of it
        for number, trial in enumerate(config.trials):
            try:
                runner.run(trial)
            except (ValueError, TypeError, RuntimeError, MemoryError) as error:
                raise ValueError(f"point {number} of the grid ({trial.detector}): {error}") from error


class _Driver:
    """Feeds an engine and stores what it gives back."""

    def __init__(
        self,
        plan: Plan,
        store: RunStore,
        units: Collection[int],
        todo: Collection[int],
        num_found: int,
        on_progress: Callable[[SweepProgress], None] | None,
    ) -> None:
        self.stopping = False
        self._plan, self._store, self._on_progress = plan, store, on_progress
        self._num_units, self._num_todo, self._num_found = len(units), len(todo), num_found
        self._num_new = 0
        self._num_failed = len(store.state.errors.keys() & set(units) - set(todo))
        self._waiting = deque(todo)
        self._suspects: deque[Task] = deque()  # a worker may have died at each
        self._deaths: Counter[int] = Counter()
        self._begun = time.monotonic()

    def progress(self) -> SweepProgress:
        done = self._num_found + self._num_new
        seconds = time.monotonic() - self._begun
        return SweepProgress(self._num_units, done, self._num_failed, self._num_new, self._num_todo, seconds)

    def run(self, engine: Engine) -> None:
        """Run what waits; units at which a worker died run again one by one, so that the guilty one is known."""
        under_way = 0
        with self._stop_on_signals():
            while under_way or (not self.stopping and (self._waiting or self._suspects)):
                while not self.stopping and under_way < engine.num_workers and (self._waiting or self._suspects):
                    engine.submit(
                        [self._suspects.popleft()] if self._suspects else self._next_batch(engine.num_workers)
                    )
                    under_way += 1
                for outcome in engine.collect(timeout_seconds=0.5):
                    under_way -= 1
                    self._take(outcome)
        self._store.flush()

    def _take(self, outcome: Outcome) -> None:
        """Store the results of a batch, or try its units again one by one."""
        results = outcome.results
        if results is None:
            LOG.warning("a worker died", extra={"units": [task.unit for task in outcome.tasks]})
            results = []
            for task in outcome.tasks:
                self._deaths[task.unit] += len(outcome.tasks) == 1
                if self._deaths[task.unit] >= MAX_DEATHS:
                    reason = WorkerDiedError(f"{MAX_DEATHS} workers died at this unit; killed, or out of memory?")
                    results.append(failed_unit(self._plan.config, task, "worker", reason))
                else:
                    self._suspects.append(task._replace(attempt=task.attempt + 1))
        for result in results:
            self._num_new += 1
            if result.error is not None:
                self._num_failed += 1
                LOG.error("unit failed", extra={"unit": result.unit, "reason": result.error})
            domains = sorted({row["domain"] for row in result.rows if row["domain"]})
            if domains:
                names = {name: result.rows[0][name] for name in ("dataset", "scene")}
                LOG.warning("outside of the domain", extra={"unit": result.unit, **names, "domain": domains})
            self._store.add(result)
        if self._on_progress is not None:
            self._on_progress(self.progress())

    def _next_batch(self, num_workers: int) -> list[Task]:
        """Units worth about a second, those of one pair together, fewer when little is left."""
        seconds_each = (
            (time.monotonic() - self._begun) * num_workers / self._num_new if self._num_new else BATCH_SECONDS
        )
        fair = math.ceil(len(self._waiting) / (2 * num_workers))
        size = max(1, min(int(BATCH_SECONDS / seconds_each), fair, MAX_BATCH))
        units = [self._waiting.popleft()]
        num_groups = len(self._plan.groups)
        while self._waiting:
            same_pair = self._waiting[0] // num_groups == units[-1] // num_groups
            if len(units) >= size and not (same_pair and len(units) < min(fair, MAX_BATCH)):
                break
            units.append(self._waiting.popleft())
        failed = self._store.state.errors
        return [self._plan.task(unit, 1 + failed.get(unit, {}).get("attempts", 0)) for unit in units]

    @contextmanager
    def _stop_on_signals(self) -> Iterator[None]:
        """Let the first SIGINT or SIGTERM ask for an end, and the second one force it."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def stop(number: int, _: Any) -> None:
            if self.stopping:
                raise KeyboardInterrupt
            self.stopping = True
            LOG.warning("stopping", extra={"signal": signal.Signals(number).name})

        previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, signal.SIG_DFL if handler is None else handler)


class WorkerDiedError(RuntimeError):
    """A worker process ended in the middle of a unit."""


def _fingerprint(plan: Plan) -> str:
    """Hash of all that the manifest says of the pairs."""
    # a setting that is not there adds nothing, so that runs of earlier releases go on; astuple copies: a second more
    rows = [[str(v) for name, v in vars(pair).items() if name not in OPTIONAL or v is not None] for pair in plan.pairs]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()


def _environment(engine: str, num_workers: int | None, shard: tuple[int, int]) -> dict[str, Any]:
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(),
        "python": platform.python_version(),
        "engine": engine,
        "num_workers": num_workers,
        "shard": list(shard),
        "versions": package_versions(),
    }
