"""What can be said of a command before any work: paths, endings, names. Imports no torch, so errors come at once."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

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
    Sweep,
)
from tensor_stereo.datasets.files import check_gt_scale, check_sample_bits
from tensor_stereo.datasets.remote import to_location
from tensor_stereo.interop.formats import check_files
from tensor_stereo.interop.match_lists import find_match_files, is_many
from tensor_stereo.interop.result_names import check_score_name
from tensor_stereo.paths import (
    MAPS,
    TABLES,
    check_folder,
    check_source,
    prepare_folder,
    prepare_target,
    prepare_targets,
)

FIGURES = (".png",)


def check(command: Any) -> None:
    """Raise for what cannot work, and make the folders of the results.

    Raises:
        ValueError, OSError: naming the argument.
    """
    _CHECKS[type(command)](command)


def _check_least(name: str, value: int, least: int) -> None:
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value}")


def _check_demo(command: Demo) -> None:
    _check_least("num_pairs", command.num_pairs, 1)
    if command.out is not None:
        prepare_folder("out", command.out)


def _check_classify(command: Classify) -> None:
    _check_files(command, ("left", "right", "disparity_gt"), TABLES)


def _check_confidence(command: Confidence) -> None:
    _check_least("stride", command.stride, 1)
    if command.is_manifest:
        _check_maps(command)
        return
    if command.ending is not None:
        raise ValueError("ending must not be given without a manifest: that of --out counts")
    for name in ("workers", "shard"):
        if getattr(command, name) is not None:
            raise ValueError(f"{name} must not be given without a manifest")
    for name in ("right", "disparity"):
        if getattr(command, name) is None:
            raise ValueError(f"{name} must be given beside left, unless left is a manifest, .csv or .parquet")
    for name in ("disparity", "disparity1"):
        path = getattr(command, name)
        if path is not None:
            check_source(name, path, (*MAPS, ".pgm"))
    _check_files(command, ("left", "right", "disparity", "disparity1", "disparity_gt"), MAPS)


def _check_maps(command: Confidence) -> None:
    """A manifest of maps; what it names itself cannot be given beside it."""
    check_source("left", command.left)
    parse_shard(command.shard or "1/1")
    if command.workers is not None:
        _check_least("workers", command.workers, 1)
    columns = {"disparity1": "disparity1_est", "scale": "est_scale"} | {
        name: name for name in ("right", "disparity", "disparity_gt", "gt_scale", "sample_bits")
    }
    for name, column in columns.items():
        if getattr(command, name) is not None:
            instead = f"; its column {column} holds it" if name not in ("right", "disparity") else ""
            raise ValueError(f"{name} must not be given beside a manifest{instead}")
    if command.figure is not None:
        raise ValueError("figure must not be given beside a manifest; draw that of one pair")
    if command.out is None:
        raise ValueError("out must name a folder for the results of a manifest")
    prepare_folder("out", command.out)


def _check_files(command: Classify | Confidence, sources: Sequence[str], endings: Sequence[str]) -> None:
    """Files that one pair is read from, and the result and the figure that are written."""
    given = {name: getattr(command, name) for name in sources}
    for name, path in given.items():
        if path is not None:
            check_source(name, path)
    prepare_targets({"out": (command.out, endings), "figure": (command.figure, FIGURES)}, given)
    check_gt_scale(command.gt_scale)
    check_sample_bits(command.sample_bits)


def _check_evaluate(command: Evaluate) -> None:
    check_folder("root", command.root)
    check_gt_scale(command.gt_scale)
    check_sample_bits(command.sample_bits)
    if command.out is not None:
        prepare_folder("out", command.out)


def _check_filter(command: Filter) -> None:
    if is_many(command.matches, command.out):
        check_score_name(command.score_name)
        find_match_files(command.matches, command.out, command.keypoints)
        return
    check_files(command.matches, command.out, command.keypoints, command.score_name)


def parse_shard(text: str) -> tuple[int, int]:
    """``i/n`` as two numbers.

    >>> parse_shard("1/4")
    (1, 4)
    """
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise ValueError(f"shard must be i/n with 1 <= i <= n, such as 1/4, got {text!r}")
    return int(match[1]), int(match[2])


def _check_download(command: Download) -> None:
    from tensor_stereo.datasets.download.releases import RELEASES

    for name in command.releases:
        if name not in RELEASES:
            raise ValueError(f"releases must be among {', '.join(RELEASES)}, got {name!r}")
    prepare_folder("out", command.out)


def _check_index(command: Index) -> None:
    for root in command.roots:
        if not root.exists():
            raise FileNotFoundError(f"roots: there is no file or folder {root}")
    check_sample_bits(command.sample_bits)
    prepare_target("out", command.out, (".parquet",))


def _check_render(command: Render) -> None:
    _check_least("num_pairs", command.num_pairs, 1)
    prepare_folder("out", command.out)


def _check_report(command: Report) -> None:
    if not 1 <= len(command.runs) <= 2:
        raise ValueError(f"runs must name one run folder, or two, got {len(command.runs)}")
    for run in command.runs:
        check_folder("runs", run)
        if not (run / "config.json").is_file():
            raise FileNotFoundError(f"runs: {run} is no run of a sweep: it has no config.json")
    if command.out is not None:
        prepare_folder("out", command.out)


def _check_sweep(command: Sweep) -> None:
    from tensor_stereo.sweeps.grid import read_grid

    if not command.dry_run:  # which tells of every point
        read_grid(command.settings)
    parse_shard(command.shard)
    for name, least in (("workers", 1), ("limit", 0)):
        value = getattr(command, name)
        if value is not None:
            _check_least(name, value, least)
    manifest = to_location(command.manifest)
    if isinstance(manifest, Path) and not manifest.is_dir():
        check_source("manifest", manifest, (".csv", ".parquet"))
    if not command.seconds_per_part >= 0:
        raise ValueError(f"seconds_per_part must not be negative, got {command.seconds_per_part}")
    if not command.dry_run:
        prepare_folder("out", command.out)


_CHECKS: dict[type, Callable[[Any], None]] = {
    Demo: _check_demo,
    Classify: _check_classify,
    Confidence: _check_confidence,
    Evaluate: _check_evaluate,
    Filter: _check_filter,
    Download: _check_download,
    Index: _check_index,
    Render: _check_render,
    Report: _check_report,
    Sweep: _check_sweep,
}
