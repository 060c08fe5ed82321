"""Tasks on a Ray cluster.

Plain Ray tasks rather than Ray Data: ``map_batches`` splits, merges and repeats blocks as it sees fit, and does not say
which block a lost worker was at. Here a batch is one task that Ray never repeats by itself; what a lost worker or node
was at is run again by the sweep, which counts the attempts.
"""

from __future__ import annotations

import importlib
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from tensor_stereo.configs import SweepConfig
from tensor_stereo.sweeps.batches import BatchResult
from tensor_stereo.sweeps.engines import run_batch
from tensor_stereo.sweeps.plan import Task
from tensor_stereo.waiting import chosen_policy
from tensor_stereo.workers import Outcome


def find_ray() -> Any:
    """The module ``ray``.

    Raises:
        ImportError: if Ray is not installed.
    """
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        raise ImportError("the engine 'ray' needs Ray: pip install 'tensor-stereo[ray]'") from error


class RayEngine:
    """A Ray cluster whose nodes see the images, and this library, under the same paths.

    Args:
        config: the points of the sweep.
        num_workers: batches that run at a time, one CPU each; None: all CPUs of the cluster.
        address: of a running cluster, as ``ray start`` prints it, or ``auto``; None: the one that this process is
            connected to, else a new one on this machine.
        run: what a worker does with a batch.

    Raises:
        ImportError: if Ray is not installed.
        ConnectionError: if there is no cluster at ``address``.
    """

    def __init__(
        self,
        config: SweepConfig,
        num_workers: int | None = None,
        address: str | None = None,
        *,
        run: Callable[[SweepConfig, Sequence[Task]], BatchResult] = run_batch,
    ) -> None:
        self._ray = ray = find_ray()
        self._started = not ray.is_initialized()
        if self._started:
            local = {} if address else {"num_cpus": num_workers, "include_dashboard": False}
            ray.init(address=address or "local", log_to_driver=False, configure_logging=False, **local)
        self.num_workers = num_workers or max(1, int(ray.cluster_resources().get("CPU", 1)))
        self._config = ray.put(config)
        self._task = ray.remote(num_cpus=1, max_retries=0, runtime_env={"env_vars": chosen_policy()})(run)
        self._running: dict[Any, tuple[Task, ...]] = {}
        self._waiting: deque[tuple[Task, ...]] = deque()

    def submit(self, tasks: Sequence[Task]) -> None:
        self._waiting.append(tuple(tasks))
        self._dispatch()

    def _dispatch(self) -> None:
        while self._waiting and len(self._running) < self.num_workers:
            batch = self._waiting.popleft()
            self._running[self._task.remote(self._config, batch)] = batch

    def collect(self, timeout_seconds: float) -> list[Outcome[Task, BatchResult]]:
        ray = self._ray
        if not self._running:
            return []
        running = list(self._running)
        done, _ = ray.wait(running, num_returns=1, timeout=timeout_seconds)
        if done:  # and all others that have ended meanwhile
            done, _ = ray.wait(running, num_returns=len(running), timeout=0)
        outcomes = []
        for reference in done:
            tasks = self._running.pop(reference)
            try:
                outcomes.append(Outcome(tasks, ray.get(reference)))
            except ray.exceptions.RayTaskError:
                raise  # not of a unit: these are caught where they run
            except ray.exceptions.RayError:  # the worker, its node or its memory is gone
                outcomes.append(Outcome(tasks, None))
        self._dispatch()
        return outcomes

    def close(self) -> None:
        for reference in self._running:
            self._ray.cancel(reference, force=True)
        if self._started:
            self._ray.shutdown()
