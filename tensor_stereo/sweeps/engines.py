"""Where tasks run: one interface, and worker processes on this machine. Imports no torch."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from typing import NamedTuple, Protocol

from tensor_stereo.configs import SweepConfig
from tensor_stereo.sweeps.batches import BatchResult
from tensor_stereo.sweeps.journal import SweepError
from tensor_stereo.sweeps.plan import Task
from tensor_stereo.waiting import passive_children


class Outcome(NamedTuple):
    """What an engine says of a batch; ``result`` is None if its worker died."""

    tasks: tuple[Task, ...]
    result: BatchResult | None


class Engine(Protocol):
    """Runs batches of tasks on workers, in any order.

    Attributes:
        num_workers: batches that run at a time.
    """

    num_workers: int

    def submit(self, tasks: Sequence[Task]) -> None:
        """Queue a batch."""

    def collect(self, timeout_seconds: float) -> list[Outcome]:
        """Batches that ended since the last call; waits for one at most that long."""

    def close(self) -> None:
        """End the workers at once; what they are at is lost."""


class WorkerStartError(SweepError):
    """No worker comes to life."""

    def __init__(self) -> None:
        super().__init__(
            "a worker process ended before it began; what it said stands above. A script that runs a sweep must be a "
            'file and do so below: if __name__ == "__main__"'
        )


def run_batch(config: SweepConfig, tasks: Sequence[Task]) -> BatchResult:
    """Run the units of a batch in this process, which loads torch."""
    from tensor_stereo.sweeps.units import run_tasks

    return run_tasks(config, tasks)


def check_points(config: SweepConfig) -> None:
    """Run every point of a grid once, in a process of its own.

    Raises:
        ValueError: for a bad setting, naming the point.
        WorkerStartError: if the process does not come to life.
    """
    with passive_children(), ProcessPoolExecutor(1, mp_context=_context()) as pool:
        try:
            pool.submit(_check_points, config).result()
        except BrokenExecutor:
            raise WorkerStartError from None


def _check_points(config: SweepConfig) -> None:
    from tensor_stereo.sweeps.units import check_trials

    check_trials(config)


@dataclass
class _Worker:
    """A process, and what it is at; it has begun once it has said so."""

    process: BaseProcess
    has_begun: bool = False
    tasks: tuple[Task, ...] = ()


class LocalEngine:
    """Processes on this machine, one thread and one pipe each.

    Not the standard library's pool: it cannot say which batch a lost process was at, and it waits for ever for the rest
    of a result that a process was sending when it died. Here the end of a pipe is the death of its worker.

    Workers are forked from a server that has imported the library and nothing else, so that they start at once and no
    thread is lost in a fork; where there is no such server they are started anew. They leave signals to their parent,
    and end with it. Their threads wait without spinning.

    Args:
        config: the points of the sweep.
        num_workers: processes; None: one per core.
    """

    def __init__(self, config: SweepConfig, num_workers: int | None = None) -> None:
        self.num_workers = num_workers or _num_cores()
        self._config = config
        self._waiting: deque[tuple[Task, ...]] = deque()
        self._workers: dict[Connection, _Worker] = {}
        self._context = _context()

    def submit(self, tasks: Sequence[Task]) -> None:
        self._waiting.append(tuple(tasks))
        while len(self._workers) < self.num_workers:
            self._start_worker()
        self._dispatch()

    def collect(self, timeout_seconds: float) -> list[Outcome]:
        outcomes = []
        ready = wait(list(self._workers), timeout_seconds)
        for connection in [connection for connection in self._workers if connection in ready]:
            worker = self._workers[connection]
            try:
                message = connection.recv()
            except (EOFError, OSError):  # also in the middle of a message
                self._bury(connection)
                if not worker.has_begun:
                    raise WorkerStartError from None
                if worker.tasks:
                    outcomes.append(Outcome(worker.tasks, None))
                self._start_worker()
                continue
            if worker.has_begun:
                outcomes.append(Outcome(worker.tasks, message))
            worker.has_begun, worker.tasks = True, ()
        self._dispatch()
        return outcomes

    def close(self) -> None:
        for connection in list(self._workers):
            self._bury(connection)

    def _start_worker(self) -> None:
        ours, theirs = self._context.Pipe()
        with passive_children():
            settings = theirs, self._config, dict(os.environ)
            process = self._context.Process(target=_work, args=settings, daemon=True)
            process.start()
        theirs.close()  # so that the end of the process is the end of the pipe
        self._workers[ours] = _Worker(process)

    def _bury(self, connection: Connection) -> None:
        worker = self._workers.pop(connection)
        worker.process.kill()
        worker.process.join()
        connection.close()

    def _dispatch(self) -> None:
        """Give what waits to workers that have begun and are idle."""
        for connection, worker in self._workers.items():
            if self._waiting and worker.has_begun and not worker.tasks:
                worker.tasks = self._waiting.popleft()
                with suppress(OSError):  # it has just died, which the next look at its pipe tells
                    connection.send(worker.tasks)


def _context() -> SpawnContext | ForkServerContext:
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tensor_stereo.sweeps.units"])
    return context


def _num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _work(connection: Connection, config: SweepConfig, environment: dict[str, str]) -> None:
    """What a worker process does until its pipe ends.

    Args:
        connection: its end of the pipe.
        config: the points of the sweep.
        environment: of the parent now; that of the server which forked this process may be older.
    """
    os.environ.update(environment)
    for number in (signal.SIGINT, signal.SIGTERM):  # sent to the whole group: the parent decides when to stop
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    importlib.import_module("tensor_stereo.sweeps.units")  # a worker without it has not begun
    connection.send(None)
    while True:
        try:
            tasks = connection.recv()
        except (EOFError, OSError):
            return
        connection.send(run_batch(config, tasks))


def _end_with_parent() -> None:
    """End a worker that computes while its parent is killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
