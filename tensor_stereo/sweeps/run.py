"""A sweep from its settings to its run folder. Imports no torch."""

from __future__ import annotations

import logging
import platform
from collections.abc import Callable
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from tensor_stereo.configs import SweepConfig
from tensor_stereo.datasets.pair_table import PairTable
from tensor_stereo.paths import check_no_store
from tensor_stereo.sweeps.driver import SweepProgress, SweepSummary, drive
from tensor_stereo.sweeps.engines import Engine, check_points, local_engine
from tensor_stereo.sweeps.grid import simplify
from tensor_stereo.sweeps.log import log_to_file
from tensor_stereo.sweeps.plan import build_plan
from tensor_stereo.sweeps.ray_engine import RayEngine, find_ray
from tensor_stereo.sweeps.store import FORMAT, RunStore, append_environment
from tensor_stereo.versions import package_versions

EngineName = Literal["local", "ray"]
LOG = logging.getLogger(__name__)


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
    seconds_per_part: float = 10.0,
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
        manifest: Parquet file as :func:`tensor_stereo.datasets.write_manifest` writes it, a folder of such files, or a
            CSV list of pairs.
        out: run folder; see :mod:`tensor_stereo.sweeps.store` for what it holds.
        engine: ``local``, processes on this machine, or ``ray``.
        num_workers: None: one per core of this machine or cluster.
        ray_address: of a running Ray cluster; None: the one that this process is connected to, or a new one.
        shard: (i, n): do the i-th of n parts of the sweep, counted from 1. Shards may run at the same time.
        limit: do no more than so many units now.
        retry_errors: do failed units again.
        verify: hash the finished parts instead of trusting their size.
        units_per_part: units after which a part is written, and
        seconds_per_part: the time that a finished unit waits for its part at most; with the batch of about a second
            that a worker is at, what a crash costs.
        log_level: of ``log.jsonl``.
        on_progress: called after every batch.

    Returns:
        What is done, and whether the sweep was interrupted.

    Raises:
        ValueError: for bad settings, a wrong manifest, or a run folder of another configuration.
        SweepError: if another process works on the same shard.
        RuntimeError: if no worker starts.
        OSError: if the run folder cannot be written; what its journal lists is safe.
    """
    out = Path(out)
    check_no_store("out", out)
    if limit is not None and limit < 0:
        raise ValueError(f"limit must not be negative, got {limit}")
    if num_workers is not None and num_workers < 1:
        raise ValueError(f"num_workers must be at least 1, got {num_workers}")
    if not seconds_per_part >= 0:
        raise ValueError(f"seconds_per_part must not be negative, got {seconds_per_part}")
    if engine not in ("local", "ray"):
        raise ValueError(f"engine must be 'local' or 'ray', got {engine!r}")
    config = replace(config, trials=tuple(simplify(trial) for trial in config.trials))
    pairs = PairTable(manifest, check_files=False)
    plan = build_plan(config, pairs)
    units = plan.shard(*shard)
    if engine == "ray":
        find_ray()
    if not (out / "config.json").exists():
        check_points(config)
    record = {"format": FORMAT, "sweep": asdict(config), "manifest": {"num_pairs": len(pairs)}}
    store = RunStore(
        out,
        record,
        pairs,
        shard=shard,
        units_per_part=units_per_part,
        seconds_per_part=seconds_per_part,
        verify=verify,
    )
    plan = replace(plan, pairs=pairs.moved_to(out / "manifest.parquet"))  # whatever becomes of the given one
    with store, log_to_file(out / "log.jsonl", log_level):
        known = store.state.good.among(units) if retry_errors else store.state.done(units)
        todo = units[~known]
        num_found = len(units) - len(todo)
        todo = todo if limit is None else todo[:limit]
        LOG.info("start", extra={"units": len(units), "todo": len(todo), "engine": engine, "shard": list(shard)})
        append_environment(out, _environment(engine, num_workers, shard))
        workers: Engine | None = None
        if len(todo):
            local = engine == "local"
            workers = local_engine(config, num_workers) if local else RayEngine(config, num_workers, ray_address)
        summary = drive(workers, plan, store, units, todo, num_found, on_progress)
        LOG.info("end", extra={"interrupted": summary.interrupted, **asdict(summary.progress)})
        return summary


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
