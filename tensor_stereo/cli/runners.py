"""What each subcommand does: call the library, print, say by the exit code how it ended."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from tensor_stereo.cli.checks import parse_shard
from tensor_stereo.cli.commands import (
    Classify,
    Confidence,
    Demo,
    Download,
    Evaluate,
    Filter,
    Index,
    Render,
    Report,
)
from tensor_stereo.cli.endings import OK, fail, most_frequent
from tensor_stereo.cli.progress import show_progress, time_left
from tensor_stereo.configs import EvaluationConfig

if TYPE_CHECKING:
    from tensor_stereo.interop.verdicts import FilterSummary

_FILTER_SETTINGS = ("keypoints", "score_name", "config", "images", "repair", "refine")

# The library is imported where it is called: no command waits for what it does not use.


def run(command: Any) -> int:
    """Carry out a parsed command; its exit code: 0, or 1 if the result is not what was asked for."""
    return _RUNNERS[type(command)](command)


def _run_demo(command: Demo) -> int:
    from tensor_stereo.datasets.synthetic import SyntheticDataset
    from tensor_stereo.reports.evaluation import write_evaluation

    dataset = SyntheticDataset(command.num_pairs, seed=command.seed)
    config = EvaluationConfig()
    source = {"dataset": "synthetic", "num_pairs": command.num_pairs, "seed": command.seed}
    _print_tables(write_evaluation(_evaluate(dataset, config, {}), config, source=source, out=command.out))
    if command.out is None:
        print("Figures and summary.json are written with --out DIR.")
    else:
        print(f"Tables, summary.json and figures: {command.out}")
    return OK


def _run_evaluate(command: Evaluate) -> int:
    from tensor_stereo.datasets.discovery import find_pairs

    config = command.config
    if command.preset == "paper":
        config = replace(config, sift=replace(config.sift, max_ratio=0.6))
    found = find_pairs(command.root, scenes=command.scenes, gt_scale=command.gt_scale, sample_bits=command.sample_bits)
    files = [pair for pair in found if pair.disparity_gt is not None]
    if not files:
        return fail(f"none of the {len(found)} pairs below {command.root} has ground truth, which an evaluation needs")
    if len(files) < len(found):
        print(f"{len(found) - len(files)} of {len(found)} pairs have no ground truth and are left out", file=sys.stderr)
    from tensor_stereo.datasets import PairDataset
    from tensor_stereo.reports.evaluation import write_errors, write_evaluation

    source = {"root": str(command.root), "scenes": [f"{pair.dataset}/{pair.scene}" for pair in files]}
    errors: dict[str, str] = {}
    num_known = 0

    def counted() -> Iterator[Any]:
        nonlocal num_known
        for result in _evaluate(PairDataset(files), config, errors):
            num_known += int(result.trials[0].valid.sum())
            yield result

    tables = write_evaluation(counted(), config, source=source, out=command.out)
    if len(errors) < len(files):
        _print_tables(tables)
    if command.out is not None:
        write_errors(errors, command.out)
    if errors:
        return fail(f"{len(errors)} of {len(files)} pairs failed: {most_frequent(errors.values())}")
    if not num_known:
        return fail(f"no match of the {len(files)} pairs has known ground truth, so there are no rates")
    return OK


def _run_index(command: Index) -> int:
    from tensor_stereo.datasets import build_manifest, write_manifest

    manifest = build_manifest(command.roots, gt_scale=command.gt_scale, sample_bits=command.sample_bits)
    write_manifest(manifest, command.out)
    for dataset, count in sorted(Counter(manifest["dataset"]).items()):
        print(f"{dataset}: {count} pairs")
    print(f"{len(manifest)} pairs in {command.out}")
    return OK


def _run_filter(command: Filter) -> int:
    from tensor_stereo.interop.match_files import filter_file
    from tensor_stereo.interop.match_lists import is_many

    settings = {name: getattr(command, name) for name in _FILTER_SETTINGS}
    if is_many(command.matches, command.out):
        return _filter_many(command, settings)
    return _print_counts(filter_file(command.matches, command.out, **settings), command)


def _filter_many(command: Filter, settings: dict[str, Any]) -> int:
    from tensor_stereo.interop.match_folders import filter_files

    begun = time.monotonic()
    with show_progress("filter") as show:
        summary = filter_files(
            command.matches,
            command.out,
            **settings,
            on_progress=lambda done, total, name: show(done, total, f"{name}, {time_left(begun, done, total)}"),
        )
    print(f"{'num_files':20}{summary.num_files:8}")
    print(f"{'num_found':20}{summary.num_found:8}")
    code = _print_counts(summary.matches, command)
    for name, reason in summary.errors.items():
        fail(f"{name}: {reason}")
    if summary.errors:
        return fail(f"{len(summary.errors)} of {summary.num_files} files failed")
    return code


def _print_counts(summary: FilterSummary, command: Filter) -> int:
    values = asdict(summary)
    num_agreeing = values.pop("num_agreeing")
    if not command.config.is_probability:
        del values["num_rectified"]
    if not (command.repair or command.refine):
        for name in ("num_improved", "num_refined", "num_repaired"):
            del values[name]
    for name, value in values.items():
        print(f"{name:20}{value:8}")
    return _check_kept(summary.num_kept, summary.num_matches, num_agreeing)


def _run_download(command: Download) -> int:
    from tensor_stereo.cli.download import run_download_command

    run_download_command(command)
    return OK


def _run_render(command: Render) -> int:
    from tensor_stereo.datasets.synthetic import write_synthetic

    print(write_synthetic(command.out, command.num_pairs, seed=command.seed))
    return OK


def _run_report(command: Report) -> int:
    from tensor_stereo.reports.sweep.report import write_report
    from tensor_stereo.reports.sweep.runs import load_run

    runs = [load_run(run) for run in command.runs]
    out = command.out
    if out is None:
        names = _tell_apart([run.resolve() for run in command.runs])
        out = command.runs[-1] if len(names) == 1 else command.runs[-1].parent / f"{names[0]}-and-{names[1]}"
    for path in write_report(runs, out):
        print(path)
    pairs = [run.rows.units["pair"].unique() for run in runs]
    if len(pairs) == 2 and not pairs[0].is_in(pairs[1].implode()).any():
        counts = f"{len(pairs[0])} and {len(pairs[1])}"
        return fail(f"{command.runs[0]} and {command.runs[1]} have no pair in common, of {counts}")
    return OK


def _tell_apart(runs: list[Path]) -> list[str]:
    """Names of run folders, with as many of the folders above as they need to differ."""
    depth = 1
    while len(runs) == 2 and runs[0] != runs[1] and runs[0].parts[-depth:] == runs[1].parts[-depth:]:
        depth += 1
    return ["-".join(part.strip("/") for part in run.parts[-depth:]) for run in runs]


def _run_classify(command: Classify) -> int:
    from tensor_stereo.reports.pair import classify_files

    summary = classify_files(
        command.left,
        command.right,
        command.config,
        disparity_gt=command.disparity_gt,
        gt_scale=command.gt_scale,
        sample_bits=command.sample_bits,
        out=command.out,
        figure=command.figure,
    )
    values = asdict(summary)
    rates = values.pop("rates") or {}
    num_agreeing, domain, rectified = (values.pop(name) for name in ("num_agreeing", "domain", "rectified"))
    kept_by = {f"kept_by_{name}": count for name, count in values.pop("kept_by").items()}
    for name, value in (values | kept_by | rates).items():
        print(f"{name:20}{value:8.2f}" if isinstance(value, float) else f"{name:20}{value:8}")
    if domain is not None:
        print(f"{'domain':20}{domain or 'inside':>8}")
    if rectified is not None and command.config.rectified == "auto":
        print(f"{'rectified':20}{'yes' if rectified else 'no':>8}")
    if summary.rates is not None and summary.rates.fraction_incorrect != summary.rates.fraction_incorrect:
        return fail(f"no match has known ground truth in {command.disparity_gt}, so there are no rates")
    return _check_kept(summary.num_kept, summary.num_matches, num_agreeing)


def _run_confidence(command: Confidence) -> int:
    if command.is_manifest:
        return _run_confidence_of_manifest(command)
    from tensor_stereo.reports.confidence import score_disparity_files

    of_manifests = ("ending", "workers", "shard")
    settings = {name: value for name, value in vars(command).items() if name not in of_manifests}
    summary = score_disparity_files(**settings)
    values = asdict(summary)
    for name, value in (values | values.pop("rates")).items():
        print(f"{name:24}{value:10.4f}" if isinstance(value, float) else f"{name:24}{value:10}")
    if not summary.num_known:
        return fail(f"{command.disparity} knows no disparity")
    if summary.rates and summary.rates["bad"] != summary.rates["bad"]:
        return fail(f"no pixel has known ground truth in {command.disparity_gt}, so there are no rates")
    return OK


def _run_confidence_of_manifest(command: Confidence) -> int:
    from tensor_stereo.reports.confidence_folder import confidence_table, score_disparity_manifest

    taken = ("unknown", "max_error_px", "max_error_share", "stride", "threshold", "min_precision")
    begun = time.monotonic()
    with show_progress("confidence") as show:
        summary = score_disparity_manifest(
            command.left,
            command.out,  # type: ignore[arg-type]
            ending=command.ending or ".png",
            num_workers=command.workers or 1,
            shard=parse_shard(command.shard or "1/1"),
            **{name: getattr(command, name) for name in taken},
            on_progress=lambda done, total, name: show(done, total, f"{name}, {time_left(begun, done, total)}"),
        )
    print(f"{'num_pairs':24}{summary.num_pairs:10}")
    print(f"{'num_found':24}{summary.num_found:10}")
    _print_tables([confidence_table(summary.frame)])
    print(summary.table)
    for name, reason in summary.errors.items():
        fail(f"{name}: {reason}")
    if summary.errors:
        return fail(f"{len(summary.errors)} of {summary.num_pairs} pairs failed")
    return OK


def _check_kept(num_kept: int, num_matches: int, num_agreeing: int) -> int:
    """The exit code: an empty result although most matches agree is hardly what was asked for."""
    if num_kept or 2 * num_agreeing <= num_matches:
        return OK
    return fail(
        f"no match is kept, although {num_agreeing} of {num_matches} agree with their neighbours; does --rectified "
        "fit, are the coordinates pixels, is the target in reach? --verdict cardinality asks for none of it"
    )


def _evaluate(dataset: Any, config: EvaluationConfig, errors: dict[str, str]) -> Iterator[Any]:
    """Evaluations with progress; pairs that fail go to ``errors`` with their reason."""
    from tensor_stereo.evaluation.dataset import evaluate_dataset

    total, done, begun = len(dataset) * len(config.detectors), 0, time.monotonic()

    def note(name: str, error: Exception) -> None:
        nonlocal done
        done += len(config.detectors)
        errors[name] = " ".join(str(error).split())

    with show_progress("evaluate") as show:
        for result in evaluate_dataset(dataset, config, on_error=note):
            done += 1
            show(done, total, f"{result.pair.name} {result.detector}, {time_left(begun, done, total)}")
            yield result


def _print_tables(tables: Iterable[Any]) -> None:
    from tensor_stereo.reports.tables import to_markdown

    console = Console()
    for table in tables:
        if not console.is_terminal:
            print(to_markdown(table))
            continue
        view = RichTable(title=escape(table.title), title_justify="left")
        for k, column in enumerate(table.columns):
            view.add_column(column, justify="left" if k == 0 else "right")
        for row in table.text_rows():
            view.add_row(*map(escape, row))
        console.print(view)


_RUNNERS: dict[type, Callable[[Any], int]] = {
    Demo: _run_demo,
    Classify: _run_classify,
    Confidence: _run_confidence,
    Evaluate: _run_evaluate,
    Filter: _run_filter,
    Download: _run_download,
    Index: _run_index,
    Render: _run_render,
    Report: _run_report,
}
