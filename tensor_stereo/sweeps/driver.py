"""The driver of a sweep: feeds an engine, stores what comes back, stops when it is asked to. Imports no torch."""

from __future__ import annotations

import logging
import math
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tensor_stereo.sweeps.batches import BatchResult, make_batch
from tensor_stereo.sweeps.engines import Engine
from tensor_stereo.sweeps.plan import Plan, Task, failed_unit
from tensor_stereo.sweeps.store import RunStore
from tensor_stereo.workers import Outcome

MAX_DEATHS = 2  # workers that certainly died at a unit before it counts as failed
BATCH_SECONDS = 1.0  # about: long against the way to a worker and back, short against a user's patience
MAX_BATCH = 256
_RECENT = 16  # batches that tell how long a unit takes
BATCHES_AHEAD = 1  # that wait for each worker, so that none waits for the driver
LOG = logging.getLogger(__name__)
Units = NDArray[np.int64]


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


def drive(
    engine: Engine | None,
    plan: Plan,
    store: RunStore,
    units: Units,
    todo: Units,
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


class _Driver:
    """Feeds an engine and stores what it gives back."""

    def __init__(
        self,
        plan: Plan,
        store: RunStore,
        units: Units,
        todo: Units,
        num_found: int,
        on_progress: Callable[[SweepProgress], None] | None,
    ) -> None:
        self.stopping = False
        self._plan, self._store, self._on_progress = plan, store, on_progress
        self._num_units, self._num_todo, self._num_found = len(units), len(todo), num_found
        self._num_new = 0
        self._num_failed = int(store.state.failed(np.setdiff1d(units, todo, assume_unique=True)).sum())
        self._todo, self._next = todo, 0
        self._suspects: deque[Task] = deque()  # a worker may have died at each
        self._returned: deque[Task] = deque()  # that a batch had no time for
        self._deaths: Counter[int] = Counter()
        self._begun = time.monotonic()
        self._recent: deque[tuple[int, float]] = deque(maxlen=_RECENT)  # units and seconds of the last batches

    def progress(self) -> SweepProgress:
        done = self._num_found + self._num_new
        seconds = time.monotonic() - self._begun
        return SweepProgress(self._num_units, done, self._num_failed, self._num_new, self._num_todo, seconds)

    def run(self, engine: Engine) -> None:
        """Run what waits; units at which a worker died run again one by one, so that the guilty one is known."""
        under_way = 0
        most = engine.num_workers * (1 + BATCHES_AHEAD)
        with self._stop_on_signals():
            while under_way or (not self.stopping and self._is_waiting()):
                while not self.stopping and under_way < most and self._is_waiting():
                    engine.submit(self._next_batch(engine.num_workers))
                    under_way += 1
                for outcome in engine.collect(timeout_seconds=0.5):
                    under_way -= 1
                    self._take(outcome)
                self._store.flush_if_due()
        self._store.flush()

    def _is_waiting(self) -> bool:
        return self._next < len(self._todo) or bool(self._suspects or self._returned)

    def _take(self, outcome: Outcome[Task, BatchResult]) -> None:
        """Store the results of a batch, or try its units again one by one."""
        result = outcome.result
        if result is None:
            LOG.warning("a worker died", extra={"units": [task.unit for task in outcome.tasks]})
            failed = []
            for task in outcome.tasks:
                self._deaths[task.unit] += len(outcome.tasks) == 1
                if self._deaths[task.unit] >= MAX_DEATHS:
                    reason = WorkerDiedError(f"{MAX_DEATHS} workers died at this unit; killed, or out of memory?")
                    failed.append(failed_unit(self._plan.config, task, "worker", reason))
                else:
                    self._suspects.append(task._replace(attempt=task.attempt + 1))
            result = make_batch([], failed, [] if self._plan.config.export_matches else None)
        else:
            told = {*result.done, *(error["unit"] for error in result.errors)}
            self._returned.extend(task for task in outcome.tasks if task.unit not in told)
            self._recent.append((result.num_units, result.seconds))
        self._num_new += result.num_units
        self._num_failed += len(result.errors)
        for error in result.errors:
            LOG.error("unit failed", extra={"unit": error["unit"], "reason": error})
        marked = result.metrics.filter(pl.col("domain") != "")
        for (unit, dataset, scene), rows in marked.group_by("unit", "dataset", "scene", maintain_order=True):
            domains = sorted(rows["domain"].unique())
            names = {"unit": unit, "dataset": dataset, "scene": scene}
            LOG.warning("outside of the domain", extra={**names, "domain": domains})
        if result.num_units:
            self._store.add(result)
        if self._on_progress is not None:
            self._on_progress(self.progress())

    def _next_batch(self, num_workers: int) -> list[Task]:
        """A unit at which a worker may have died, alone; or units worth about a second, fewer when little is left."""
        if self._suspects:
            return [self._suspects.popleft()]
        left = len(self._returned) + len(self._todo) - self._next
        size = max(1, min(self._units_of(BATCH_SECONDS), math.ceil(left / (2 * num_workers)), MAX_BATCH))
        tasks = [self._returned.popleft() for _ in range(min(size, len(self._returned)))]
        units = self._todo[self._next : self._next + size - len(tasks)].tolist()
        self._next += len(units)
        failed = self._store.state.errors
        return tasks + [self._plan.task(unit, 1 + failed.get(unit, {}).get("attempts", 0)) for unit in units]

    def _units_of(self, seconds: float) -> int:
        """How many units a worker does in some seconds, by its last batches; 1 before anything is known."""
        units, spent = (sum(values) for values in zip(*self._recent, strict=True)) if self._recent else (0, 1.0)
        return int(seconds * units / max(spent, 1e-6))

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
