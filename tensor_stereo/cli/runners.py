"""What each subcommand does: call the library, print."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table as RichTable

from tensor_stereo.cli.commands import Classify, Demo, Download, Evaluate, Filter, Index, Render, Report
from tensor_stereo.cli.download import run_download_command
from tensor_stereo.configs import EvaluationConfig
from tensor_stereo.datasets import PairDataset, build_manifest, find_pairs, write_manifest
from tensor_stereo.datasets.synthetic.rendering import SyntheticDataset, write_synthetic
from tensor_stereo.evaluation.dataset import PairEvaluation, evaluate_dataset
from tensor_stereo.interop.match_files import filter_file
from tensor_stereo.reports.evaluation import write_evaluation
from tensor_stereo.reports.pair import classify_files
from tensor_stereo.reports.sweep.report import write_report
from tensor_stereo.reports.sweep.runs import load_run
from tensor_stereo.reports.tables import Table, to_markdown


def run(command: Any) -> int:
    """Carry out a parsed command; its exit code."""
    _RUNNERS[type(command)](command)
    return 0


def _run_demo(command: Demo) -> None:
    dataset = SyntheticDataset(command.num_pairs, seed=command.seed)
    config = EvaluationConfig()
    source = {"dataset": "synthetic", "num_pairs": command.num_pairs, "seed": command.seed}
    _print_tables(write_evaluation(_progress(dataset, config), config, source=source, out=command.out))
    if command.out is None:
        print("Figures and summary.json are written with --out DIR.")
    else:
        print(f"Tables, summary.json and figures: {command.out}")


def _run_evaluate(command: Evaluate) -> None:
    config = command.config
    if command.preset == "paper":
        config = replace(config, sift=replace(config.sift, max_ratio=0.6))
    files = find_pairs(command.root, scenes=command.scenes, gt_scale=command.gt_scale)
    source = {"root": str(command.root), "scenes": [f"{pair.dataset}/{pair.scene}" for pair in files]}
    tables = write_evaluation(_progress(PairDataset(files), config), config, source=source, out=command.out)
    _print_tables(tables)


def _run_index(command: Index) -> None:
    manifest = build_manifest(command.roots, gt_scale=command.gt_scale)
    write_manifest(manifest, command.out)
    for dataset, count in sorted(Counter(manifest["dataset"]).items()):
        print(f"{dataset}: {count} pairs")
    print(f"{len(manifest)} pairs in {command.out}")


def _run_filter(command: Filter) -> None:
    summary = filter_file(command.matches, command.out, keypoints=command.keypoints, config=command.config)
    for name, value in asdict(summary).items():
        print(f"{name:20}{value:8}")


def _run_render(command: Render) -> None:
    print(write_synthetic(command.out, command.num_pairs, seed=command.seed))


def _run_report(command: Report) -> None:
    for path in write_report([load_run(run) for run in command.runs], command.out or command.runs[-1]):
        print(path)


def _run_classify(command: Classify) -> None:
    summary = classify_files(
        command.left,
        command.right,
        command.config,
        disparity_gt=command.disparity_gt,
        gt_scale=command.gt_scale,
        out=command.out,
        figure=command.figure,
    )
    values = asdict(summary)
    rates = values.pop("rates") or {}
    kept_by = {f"kept_by_{name}": count for name, count in values.pop("kept_by").items()}
    for name, value in (values | kept_by | rates).items():
        print(f"{name:20}{value:8.2f}" if isinstance(value, float) else f"{name:20}{value:8}")


def _progress(dataset: SyntheticDataset | PairDataset, config: EvaluationConfig) -> Iterator[PairEvaluation]:
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("evaluate", total=len(dataset) * len(config.detectors))
        for result in evaluate_dataset((dataset[k] for k in range(len(dataset))), config):
            progress.update(task, advance=1, description=f"{result.pair.name} {result.detector}")
            yield result


def _print_tables(tables: Iterable[Table]) -> None:
    console = Console()
    for table in tables:
        if not console.is_terminal:
            print(to_markdown(table))
            continue
        view = RichTable(title=table.title, title_justify="left")
        for k, column in enumerate(table.columns):
            view.add_column(column, justify="left" if k == 0 else "right")
        for row in table.text_rows():
            view.add_row(*row)
        console.print(view)


_RUNNERS: dict[type, Callable[[Any], None]] = {
    Demo: _run_demo,
    Classify: _run_classify,
    Evaluate: _run_evaluate,
    Filter: _run_filter,
    Download: run_download_command,
    Index: _run_index,
    Render: _run_render,
    Report: _run_report,
}
