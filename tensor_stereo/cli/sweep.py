"""``tensor-stereo sweep``: progress on standard error, a summary on standard output, an exit code."""

from __future__ import annotations

import math
import time

from tensor_stereo.cli.checks import parse_shard
from tensor_stereo.cli.commands import Sweep
from tensor_stereo.cli.endings import INTERRUPTED, OK, fail, most_frequent
from tensor_stereo.cli.progress import describe_time, show_progress
from tensor_stereo.datasets.pair_table import PairTable
from tensor_stereo.evaluation.rows import STAGES
from tensor_stereo.sweeps import SweepProgress, build_plan, read_errors, read_grid, run_sweep
from tensor_stereo.sweeps.grid import explain_grid
from tensor_stereo.sweeps.plan import Plan
from tensor_stereo.sweeps.results import has_ground_truth


def run_sweep_command(command: Sweep) -> int:
    """Run a sweep; 0 if every unit is done, 1 if some failed, 130 if it was interrupted."""
    shard = parse_shard(command.shard)
    if command.dry_run:
        for line in explain_grid(command.settings):
            print(line)
    config = read_grid(command.settings)
    if command.dry_run:
        print_plan(build_plan(config, PairTable(command.manifest, check_files=False)), shard)
        return OK
    with show_progress("sweep") as show:
        summary = run_sweep(
            config,
            command.manifest,
            command.out,
            engine=command.engine,
            num_workers=command.workers,
            ray_address=command.ray_address,
            shard=shard,
            limit=command.limit,
            retry_errors=command.retry_errors,
            seconds_per_part=command.seconds_per_part,
            verify=command.verify,
            log_level=command.log_level,
            on_progress=lambda state: show(*_count(state, command.limit), _describe(state)),
        )
    end = summary.progress
    print(f"{end.num_done} of {end.num_units} units done, {end.num_new} now, {end.num_failed} failed: {command.out}")
    if end.num_failed:
        print(f"The reasons are in {command.out / 'errors.parquet'}; --retry-errors does them again.")
        reasons = read_errors(command.out)["message"].to_list()
        print(f"Most frequent: {most_frequent(reasons)}")
    if summary.interrupted:
        print("Interrupted; the same command goes on.")
        return INTERRUPTED
    if end.num_failed:
        return fail(f"{end.num_failed} of {end.num_units} units failed: {most_frequent(reasons)}")
    if end.num_done == end.num_units and not config.export_matches and not has_ground_truth(command.out):
        return fail("no pair has known ground truth, so there are no rates; matches come with export_matches = true")
    return OK


def print_plan(plan: Plan, shard: tuple[int, int]) -> None:
    """Print what a sweep would run, how stages are shared, and what a unit takes, timed on one pair."""
    from tensor_stereo.sweeps.units import check_trials, run_tasks

    units = plan.shard(*shard)
    check_trials(plan.config)
    num_pairs = len(units) // len(plan.groups)
    print(f"{num_pairs} pairs x {len(plan.config.trials)} points of the grid = {len(units)} units of work")
    if not num_pairs:
        return
    print("Runs of each stage in one unit (one pair, one detector setting), and seconds of one unit:")
    widths = {"features": 8, "detector": 8, "trials": 6, **dict.fromkeys(STAGES, 7), "seconds": 8}
    print("  ".join(f"{name:>{width}}" for name, width in widths.items()))
    total = 0.0
    pair = int(units[len(units) // 2]) // len(plan.groups)
    for number, row in enumerate(plan.costs().iter_rows(named=True)):
        start = time.perf_counter()  # the libraries are warm: check_trials has run every point
        result = run_tasks(plan.config, [plan.task(pair * len(plan.groups) + number)])
        seconds = math.nan if result.errors else time.perf_counter() - start
        total += seconds
        print(
            "  ".join(f"{row[name]:>{width}}" for name, width in widths.items() if name != "seconds"),
            f"{seconds:>9.3f}",
        )
    files = plan.pairs[pair]
    print(f"Timed on {files.dataset}/{files.scene}: about {describe_time(total * num_pairs)} for all on one worker.")


def _count(state: SweepProgress, limit: int | None) -> tuple[int, int]:
    """How many of how many: of all units, or of those that this call does, where it is limited."""
    return (state.num_done, state.num_units) if limit is None else (state.num_new, state.num_todo)


def _describe(state: SweepProgress) -> str:
    left = "" if math.isnan(state.seconds_left) else f", {describe_time(state.seconds_left)} left"
    failed = f", {state.num_failed} failed" if state.num_failed else ""
    return f"{state.units_per_second:.1f} units/s{left}{failed}"
