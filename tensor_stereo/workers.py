"""Worker processes on this machine, for what is done once per pair. Imports no torch."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from typing import Any, Generic, NamedTuple, TypeVar

from tensor_stereo.waiting import passive_children

State = TypeVar("State")
Task = TypeVar("Task")
Result = TypeVar("Result")

_PRELOADED = "tensor_stereo.sweeps.units"  # which imports all that is slow to import


class WorkerStartError(RuntimeError):
    """No worker comes to life."""

    def __init__(self) -> None:
        super().__init__(
            "a worker process ended before it began; what it said stands above. A script that starts workers must be a "
            'file and do so below: if __name__ == "__main__"'
        )


class Outcome(NamedTuple, Generic[Task, Result]):
    """What becomes of a batch; ``result`` is None if its worker died."""

    tasks: tuple[Task, ...]
    result: Result | None


@dataclass
class _Worker(Generic[Task]):
    """A process, and what it is at; it has begun once it has said so."""

    process: BaseProcess
    has_begun: bool = False
    tasks: tuple[Task, ...] = ()


class WorkerPool(Generic[State, Task, Result]):
    """Processes on this machine, one thread and one pipe each.

    Not the standard library's pool: it cannot say which batch a lost process was at, and it waits for ever for the rest
    of a result that a process was sending when it died. Here the end of a pipe is the death of its worker.

    Workers are forked from a server that has imported the library and nothing else, so that they start at once and no
    thread is lost in a fork; where there is no such server they are started anew. They leave signals to their parent,
    and end with it. Their threads wait without spinning.

    Args:
        state: what every call of ``run`` gets.
        run: a function of a module; of the state and a batch, runs the batch in a worker.
        num_workers: processes; None: one per core.
        module: what a worker imports before it has begun.
    """

    def __init__(
        self,
        state: State,
        run: Callable[[State, Sequence[Task]], Result],
        num_workers: int | None = None,
        module: str = _PRELOADED,
    ) -> None:
        self.num_workers = num_workers or num_cores()
        self._state, self._run, self._module = state, run, module
        self._waiting: deque[tuple[Task, ...]] = deque()
        self._workers: dict[Connection, _Worker[Task]] = {}
        self._context = _context()

    def submit(self, tasks: Sequence[Task]) -> None:
        """Queue a batch."""
        self._waiting.append(tuple(tasks))
        if len(self._workers) < self.num_workers:
            self._start_worker()
        self._dispatch()

    def collect(self, timeout_seconds: float) -> list[Outcome[Task, Result]]:
        """Batches that ended since the last call; waits for one at most that long.

        Raises:
            WorkerStartError: if a worker ends before it has begun.
        """
        outcomes: list[Outcome[Task, Result]] = []
        ready = wait(list(self._workers), timeout_seconds)
        for connection in [connection for connection in self._workers if connection in ready]:
            worker = self._workers[connection]
            try:
                message = connection.recv()
            except Exception:
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
        """End the workers at once; what they are at is lost."""
        for connection in list(self._workers):
            self._bury(connection)

    def _start_worker(self) -> None:
        ours, theirs = self._context.Pipe()
        with passive_children():
            settings = theirs, self._state, self._run, self._module, dict(os.environ)
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


def call_in_process(function: Callable[[State], Result], state: State) -> Result:
    """Call a function of a module in a process of its own.

    Raises:
        WorkerStartError: if the process does not come to life.
        Exception: what the function raises.
    """
    with passive_children(), ProcessPoolExecutor(1, mp_context=_context()) as pool:
        try:
            return pool.submit(function, state).result()
        except BrokenExecutor:
            raise WorkerStartError from None


def _context() -> SpawnContext | ForkServerContext:
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([_PRELOADED])
    return context


def num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _work(
    connection: Connection,
    state: Any,
    run: Callable[[Any, Sequence[Any]], Any],
    module: str,
    environment: dict[str, str],
) -> None:
    """What a worker process does until its pipe ends.

    Args:
        connection: its end of the pipe.
        state: for every call of ``run``.
        run: of the state and a batch.
        module: what has to be imported before the worker has begun.
        environment: of the parent now; that of the server which forked this process may be older.
    """
    os.environ.update(environment)
    for number in (signal.SIGINT, signal.SIGTERM):  # sent to the whole group: the parent decides when to stop
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    importlib.import_module(module)
    connection.send(None)
    while True:
        try:
            tasks = connection.recv()
        except (EOFError, OSError):
            return
        connection.send(run(state, tasks))


def _end_with_parent() -> None:
    """End a worker that computes while its parent is killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
