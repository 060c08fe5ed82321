"""The report as Markdown: summary and tables, for a README, an issue or a terminal."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from tensor_stereo.reports.sweep.compare import Comparison
from tensor_stereo.reports.sweep.pooling import pool_trials
from tensor_stereo.reports.sweep.results import RunResults
from tensor_stereo.reports.sweep.settings import varying_settings
from tensor_stereo.reports.sweep.summary import (
    EXPLANATION,
    best_table,
    changed_table,
    difference_table,
    environment_table,
    failure_kinds_table,
    failure_table,
    runtime_table,
    settings_table,
    summary_table,
    trial_tables,
    worst_table,
)
from tensor_stereo.reports.tables import Table, to_markdown


def render_markdown(runs: Sequence[RunResults], comparison: Comparison | None) -> str:
    """Summary, settings, trials, run-time, worst pairs, failures and environment; first the differences of two runs."""
    title = " and ".join(_plain(run.name) for run in runs)
    varying = varying_settings([run.rows.trials for run in runs])
    tables = [summary_table(runs), settings_table(runs)]
    if comparison is not None:
        tables += [changed_table(comparison), difference_table(comparison)]
    tables += [best_table(run) for run in runs]
    for run in runs:
        tables += trial_tables(run, pool_trials(run.rows.trials), varying)
    tables.append(runtime_table(runs))
    for run in runs:
        tables += [worst_table(run), failure_kinds_table(run), failure_table(run), environment_table(run)]
    parts = [
        f"# Sweep report: {title}\n",
        f"{EXPLANATION}\n",
        *(to_markdown(_escaped(table)) for table in tables if table.rows),
    ]
    return "\n".join(parts)


def _escaped(table: Table) -> Table:
    rows = tuple(tuple(_plain(cell) if isinstance(cell, str) else cell for cell in row) for row in table.rows)
    return replace(table, title=_plain(table.title), rows=rows)


def _plain(text: str) -> str:
    """Text that Markdown shows as it is: on one line, without markup."""
    return re.sub(r"([\\`*_\[\]<>#&~])", r"\\\1", " ".join(text.split()))
