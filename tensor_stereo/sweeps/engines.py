"""Where the tasks of a sweep run: one interface, and worker processes on this machine. Imports no torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from tensor_stereo.configs import SweepConfig
from tensor_stereo.sweeps.batches import BatchResult
from tensor_stereo.sweeps.plan import Task
from tensor_stereo.workers import Outcome, WorkerPool, call_in_process


class Engine(Protocol):
    """Runs batches of tasks on workers, in any order.

    Attributes:
        num_workers: batches that run at a time.
    """

    num_workers: int

    def submit(self, tasks: Sequence[Task]) -> None:
        """Queue a batch."""

    def collect(self, timeout_seconds: float) -> list[Outcome[Task, BatchResult]]:
        """Batches that ended since the last call; waits for one at most that long."""

    def close(self) -> None:
        """End the workers at once; what they are at is lost."""


def local_engine(config: SweepConfig, num_workers: int | None = None) -> WorkerPool[SweepConfig, Task, BatchResult]:
    """Processes on this machine; None: one per core."""
    return WorkerPool(config, run_batch, num_workers)


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
    call_in_process(_check_points, config)


def _check_points(config: SweepConfig) -> None:
    from tensor_stereo.sweeps.units import check_trials

    check_trials(config)
