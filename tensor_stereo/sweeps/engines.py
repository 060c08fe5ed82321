"""Where tasks run: one interface, and the pool of processes on this machine."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import NamedTuple, Protocol

from tensor_stereo.configs import SweepConfig
from tensor_stereo.sweeps.plan import Task
from tensor_stereo.sweeps.units import UnitResult, run_tasks


class Outcome(NamedTuple):
    """What an engine says of a batch; ``results`` is None if its worker died."""

    tasks: tuple[Task, ...]
    results: list[UnitResult] | None


class Engine(Protocol):
    """Runs batches of tasks on workers, in any order.

    Attributes:
        num_workers: batches that run at a time.
        blames_exactly: whether a batch that is said to have lost its worker is the one that ran there; otherwise every
            batch under way is suspect.
    """

    num_workers: int
    blames_exactly: bool

    def submit(self, tasks: Sequence[Task]) -> None:
        """Queue a batch."""

    def collect(self, timeout_seconds: float) -> list[Outcome]:
        """Batches that ended since the last call; waits for one at most that long."""

    def close(self) -> None:
        """Stop the workers after what they are at."""


class LocalEngine:
    """A pool of processes on this machine, one thread each.

    Workers are forked from a server that has imported the library and nothing else, so that they start at once and no
    thread is lost in a fork; where there is no such server they are started anew. A worker ends with its parent.

    Args:
        config: the points of the sweep.
        num_workers: processes; None: one per core.
    """

    blames_exactly = False

    def __init__(self, config: SweepConfig, num_workers: int | None = None) -> None:
        self.num_workers = num_workers or _num_cores()
        self._config = config
        self._pool: ProcessPoolExecutor | None = None
        self._running: dict[Future[list[UnitResult]], tuple[Task, ...]] = {}
        server = "forkserver" in multiprocessing.get_all_start_methods()
        self._context = multiprocessing.get_context("forkserver" if server else "spawn")
        if server:
            self._context.set_forkserver_preload(["tensor_stereo.sweeps.units"])

    def submit(self, tasks: Sequence[Task]) -> None:
        try:
            future = self._workers().submit(_run, tuple(tasks))
        except BrokenProcessPool:  # a worker died while it had nothing to do
            self._pool = None
            future = self._workers().submit(_run, tuple(tasks))
        self._running[future] = tuple(tasks)

    def collect(self, timeout_seconds: float) -> list[Outcome]:
        done, _ = wait(self._running, timeout_seconds, FIRST_COMPLETED)
        outcomes = []
        for future in done:
            tasks = self._running.pop(future)
            try:
                outcomes.append(Outcome(tasks, future.result()))
            except BrokenProcessPool:  # takes every batch with it
                self._pool = None
                outcomes.append(Outcome(tasks, None))
        return outcomes

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None

    def _workers(self) -> ProcessPoolExecutor:
        if self._pool is None:
            self._pool = ProcessPoolExecutor(self.num_workers, self._context, _start_worker, (self._config,))
        return self._pool


def _num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_config: SweepConfig  # of this worker


def _start_worker(config: SweepConfig) -> None:
    global _config
    _config = config
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)


def _run(tasks: tuple[Task, ...]) -> list[UnitResult]:
    return run_tasks(_config, tasks)
