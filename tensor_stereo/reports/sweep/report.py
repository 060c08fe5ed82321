"""A sweep, or two of them compared, as report.html and report.md."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tensor_stereo.reports.sweep.compare import compare_runs
from tensor_stereo.reports.sweep.markdown import render_markdown
from tensor_stereo.reports.sweep.page import render_page
from tensor_stereo.reports.sweep.results import RunResults


def write_report(runs: Sequence[RunResults], out: Path) -> list[Path]:
    """Write the report of one run, or of two that it compares.

    The page needs no network and no other file. Equal runs give equal files.

    Args:
        runs: one run, or run A and run B; differences are B - A.
        out: folder, made if it is not there; files of an earlier report are replaced.

    Returns:
        The paths of ``report.html`` and ``report.md``.

    Raises:
        ValueError: if there are no runs or more than two.
        OSError: if ``out`` cannot be written.

    Example:
        >>> import tempfile
        >>> import polars as pl
        >>> from tensor_stereo.datasets.synthetic.rendering import SyntheticDataset
        >>> from tensor_stereo.evaluation.dataset import score_dataset
        >>> from tensor_stereo.reports.sweep.results import ERROR_COLUMNS
        >>> from tensor_stereo.reports.sweep.rows import RunRows
        >>> from tensor_stereo.configs import SweepConfig
        >>> table = score_dataset(SyntheticDataset(1), SweepConfig()).with_columns(unit=0, host=pl.lit("here"))
        >>> rows = RunRows.of(table)
        >>> run = RunResults("run", rows, pl.DataFrame(schema=dict.fromkeys(ERROR_COLUMNS, pl.String)), {}, [])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     [path.name for path in write_report([run], Path(folder))]
        ['report.html', 'report.md']
    """
    if len(runs) not in (1, 2):
        raise ValueError(f"runs must hold one or two runs, got {len(runs)}")
    comparison = compare_runs(*(run.rows for run in runs)) if len(runs) == 2 else None
    texts = {"report.html": render_page(runs, comparison), "report.md": render_markdown(runs, comparison)}
    out.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, text in texts.items():
        paths.append(out / name)
        paths[-1].write_text(text, encoding="utf-8", newline="\n")
    return paths
