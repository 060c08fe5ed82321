"""Many disparity maps of a manifest: one file of probabilities per pair, and a table of what they are worth."""

from __future__ import annotations

import glob
import hashlib
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import cv2
import polars as pl
import torch
from torch import Tensor

from tensor_stereo.atomic import whole_file
from tensor_stereo.datasets.files import ESTIMATES, READ, PairFiles
from tensor_stereo.datasets.manifest import read_manifest
from tensor_stereo.datasets.map_files import read_map, write_confidence
from tensor_stereo.datasets.pairs import read_pair
from tensor_stereo.datasets.remote import fetched
from tensor_stereo.dense.confidence import WEIGHTS, DisparityConfidence, check_verdict
from tensor_stereo.paths import MAPS, TABLES, check_ending, check_source, prepare_folder
from tensor_stereo.reports.confidence import RATES, ConfidenceSummary, summarize_confidence
from tensor_stereo.reports.tables import Table
from tensor_stereo.result_folders import ONE_SOURCE_FAILS, ResultFolder, Source, check_shard, in_turn
from tensor_stereo.sweeps.stored_confidence import KIND, map_source
from tensor_stereo.table_files import write_table
from tensor_stereo.workers import WorkerPool

_SHOWN = ("bad", "bad_kept", "epe_px", "epe_px_kept", "sparsification", "sparsification_optimum")


@dataclass(frozen=True)
class ManifestSummary:
    """What became of the maps of a manifest.

    Attributes:
        num_pairs: All pairs of the shard.
        num_found: Those that an earlier call has finished.
        errors: Reason of each pair that failed, by its dataset and scene.
        frame: One row for each pair that is done, also by calls for other shards; see :func:`confidence_frame`.
        table: The file of these rows.
    """

    num_pairs: int
    num_found: int
    errors: dict[str, str]
    frame: pl.DataFrame
    table: Path


def score_disparity_manifest(
    manifest: Path | str,
    out: Path | str,
    *,
    ending: str = ".png",
    unknown: float | None = None,
    max_error_px: float = 1.0,
    max_error_share: float = 0.0,
    stride: int = 1,
    threshold: float | None = None,
    min_precision: float | None = None,
    num_workers: int = 1,
    shard: tuple[int, int] = (1, 1),
    on_progress: Callable[[int, int, str], None] | None = None,
) -> ManifestSummary:
    """How likely is every pixel of the disparity maps of many pairs right, and what is left of their errors?

    The probabilities of a pair go to ``DATASET/SCENE`` below ``out``, with an ending. ``confidence.parquet`` holds one
    row per pair: dataset, scene, the counts of :class:`~tensor_stereo.reports.confidence.ConfidenceSummary` and, where
    there is ground truth, its rates. Call it again to go on after an interruption: pairs whose files have not changed
    since are not done again, and those that failed are.

    Args:
        manifest: A ``.parquet`` manifest or a ``.csv`` list of pairs with the column ``disparity_est`` and optionally
            ``disparity1_est``, ``est_scale``, ``disparity_gt`` and ``gt_scale``; see
            :func:`~tensor_stereo.datasets.build_manifest`.
        out: Folder of the results; it is made.
        ending: Of the files of probabilities: ``.png`` (16 bits, 65535 is 1), ``.pfm``, ``.npy`` or ``.tiff``.
        unknown: A stored value of the maps that stands for an unknown disparity.
        max_error_px: A pixel is right if its error is at most this,
        max_error_share: or at most this share of its estimate.
        stride: Distance of the pixels that are judged.
        threshold: Least probability of a kept pixel; None: .5, unless ``min_precision`` is given.
        min_precision: Least expected share of the kept pixels of each map that is right.
        num_workers: Processes of one thread each; 1: this process, with all of its threads. About 1 GB each.
        shard: (i, n): the i-th of n parts of the pairs, counted from 1, as for an array of jobs. The table has the
            pairs of all calls that have ended.
        on_progress: Called after each pair with the number of pairs done, their total and the name of the pair.

    Returns:
        Counts, the rows of the table, and the reason for each one that failed.

    Raises:
        ValueError: If the manifest is wrong or names no map, a setting lies out of range, or ``out`` holds results of
            other settings.
        FileNotFoundError: If the manifest is missing.
        OSError: If nothing can be written to ``out``.
    """
    manifest, out = Path(manifest), Path(out)
    pairs, sources = find_maps(manifest, out, ending)
    check_verdict(threshold, min_precision)
    check_shard(shard)
    if num_workers < 1:
        raise ValueError(f"num_workers must be at least 1, got {num_workers}")
    prepare_folder("out", out)
    job = _Job(unknown, max_error_px, max_error_share, stride, threshold, min_precision)
    _network(job)  # which checks the settings
    tasks = [_Task(pair, source.results[0]) for pair, source in zip(pairs, sources, strict=True)]
    weights = hashlib.sha256(WEIGHTS.read_bytes()).hexdigest()
    folder: ResultFolder[ConfidenceSummary] = ResultFolder(
        out,
        KIND,
        asdict(job) | {"ending": ending, "weights": weights},
        to_json=asdict,
        from_json=lambda values: ConfidenceSummary(**values),
        shard=shard,
    )
    table = out / f"{KIND}.parquet"

    def write(summaries: Mapping[str, ConfidenceSummary]) -> None:
        with whole_file(table) as part:
            write_table(confidence_frame(summaries, pairs), part)

    alone = in_turn(lambda number: _score(job, tasks[number]))
    run = alone if num_workers == 1 else partial(_in_parallel, job, tasks, num_workers)
    worked = folder.work(sources, run, on_progress, write)
    frame = confidence_frame(worked.summaries, pairs)
    num_pairs = len(range(shard[0] - 1, len(pairs), shard[1]))
    return ManifestSummary(num_pairs, worked.num_found, worked.errors, frame, table)


class _Task(NamedTuple):
    """One map and the file of its probabilities."""

    pair: PairFiles
    result: Path


@dataclass(frozen=True)
class _Job:
    """What all maps share; names as in :func:`score_disparity_manifest`."""

    unknown: float | None
    max_error_px: float
    max_error_share: float
    stride: int
    threshold: float | None
    min_precision: float | None


@cache
def _network(job: _Job) -> DisparityConfidence:
    return DisparityConfidence(job.max_error_px, job.max_error_share, job.stride)


def _score(job: _Job, task: _Task) -> ConfidenceSummary:
    """Write the probabilities of one map."""
    with fetched(task.pair, (*READ, *ESTIMATES)) as files:
        pair = read_pair(files)
        given, other = (
            None if path is None else _read(name, Path(path), files.est_scale, job.unknown)
            for name, path in (("disparity_est", files.disparity_est), ("disparity1_est", files.disparity1_est))
        )
    found = _network(job)(given, pair.image0[None], pair.image1[None], other)
    kept = found.keep(threshold=job.threshold, min_precision=job.min_precision)[0, 0]
    task.result.parent.mkdir(parents=True, exist_ok=True)
    write_confidence(task.result, found.probability[0, 0].numpy())
    tolerance = {"max_error_px": job.max_error_px, "max_error_share": job.max_error_share}
    return summarize_confidence(found, kept, pair.disparity_gt, **tolerance)


class _Failure(NamedTuple):
    """Why there is no result, as it comes from another process; ``errno`` is that of an ``OSError``.

    ``trace`` is set for what is no fault of the files.
    """

    text: str
    errno: int | None = None
    trace: str = ""

    def to_error(self) -> Exception:
        return RuntimeError(self.text) if self.errno is None else OSError(self.errno, self.text)


def _score_in_worker(job: _Job, tasks: Sequence[_Task]) -> ConfidenceSummary | _Failure:
    """What becomes of one map, in a process with one thread."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    (task,) = tasks
    try:
        return _score(job, task)
    except ONE_SOURCE_FAILS as error:
        return _Failure(str(error), error.errno if isinstance(error, OSError) else None)
    except Exception as error:
        return _Failure(str(error), trace=traceback.format_exc())


def _in_parallel(
    job: _Job, tasks: Sequence[_Task], num_workers: int, numbers: Iterable[int]
) -> Iterator[tuple[int, ConfidenceSummary | Exception]]:
    """Maps as worker processes are done with them; one whose worker dies is not tried again."""
    pool: WorkerPool[_Job, _Task, ConfidenceSummary | _Failure] = WorkerPool(job, _score_in_worker, num_workers)
    at_work: dict[_Task, int] = {}
    waiting = iter(numbers)
    try:
        while True:
            for number in islice(waiting, 2 * num_workers - len(at_work)):
                at_work[tasks[number]] = number
                pool.submit([tasks[number]])
            if not at_work:
                return
            for outcome in pool.collect(timeout_seconds=0.5):
                (task,) = outcome.tasks
                found = outcome.result
                if found is None:
                    _drop_parts(task.result)
                    found = _Failure("the process that worked on it was killed; is there enough memory?")
                if isinstance(found, _Failure) and found.trace:
                    raise RuntimeError(f"{task.pair.dataset}/{task.pair.scene}: a worker raised\n{found.trace}")
                yield at_work.pop(task), found.to_error() if isinstance(found, _Failure) else found
    finally:
        pool.close()
        for task in at_work:
            _drop_parts(task.result)


def _drop_parts(result: Path) -> None:
    """Remove what a process that was killed has left of a file."""
    for part in result.parent.glob(f".*.{glob.escape(result.name)}"):
        part.unlink(missing_ok=True)


def _read(name: str, path: Path, scale: float | None, unknown: float | None) -> Tensor:
    return torch.from_numpy(read_map(path, scale=scale, unknown=unknown, name=name, scale_name="est_scale"))


def find_maps(manifest: Path, out: Path, ending: str) -> tuple[list[PairFiles], list[Source]]:
    """The pairs of a manifest or a list, all of which have a map, and where their results go.

    Args:
        manifest: ``.parquet`` or ``.csv``.
        out: Folder of the results.
        ending: Of the results.

    Raises:
        ValueError: If it is wrong, a pair has no ``disparity_est``, or two results would have one name.
        FileNotFoundError: If it is missing.
    """
    check_source("manifest", manifest, TABLES)
    check_ending("ending", Path("confidence" + ending), MAPS)
    pairs = read_manifest(manifest, check_files=False)
    if not pairs:
        raise ValueError(f"manifest: {manifest} lists no pair")
    taken: dict[Path, PairFiles] = {}
    sources = []
    read: set[Path] = set()
    for pair in pairs:
        name = f"{pair.dataset}/{pair.scene}"
        if pair.disparity_est is None:
            raise ValueError(f"manifest: {manifest} must name a disparity_est for every pair, {name} has none")
        source = map_source(pair, out, ending)
        read |= {path.resolve() for path in source.inputs}
        place = source.results[0].resolve()
        if not place.is_relative_to(out.resolve()):
            raise ValueError(f"manifest: {manifest} must have names of pairs that stay below out, got {name!r}")
        other = taken.setdefault(place, pair)
        if other is not pair:
            names = f"{other.dataset}/{other.scene} and {name}"
            raise ValueError(f"manifest: {manifest} names {names}, whose results would have one name")
        sources.append(source)
    replaced = next((place for place in taken if place in read), None)
    if replaced is not None:
        raise ValueError(
            f"out must be another folder than that of the files of the pairs, {replaced} would be replaced"
        )
    return pairs, sources


def confidence_frame(summaries: Mapping[str, ConfidenceSummary], pairs: Sequence[PairFiles]) -> pl.DataFrame:
    """One row per pair that is done: its names, its counts and its rates, null without ground truth.

    >>> confidence_frame({}, []).columns[:3]
    ['dataset', 'scene', 'num_pixels']
    """
    counts = ("num_pixels", "num_known", "num_kept")
    schema = {"dataset": pl.String, "scene": pl.String, **dict.fromkeys(counts, pl.Int64)}
    schema |= dict.fromkeys(("expected_precision", *RATES), pl.Float64)
    rows = []
    for pair in pairs:
        summary = summaries.get(f"{pair.dataset}/{pair.scene}")
        if summary is not None:
            values = asdict(summary)
            rows.append({"dataset": pair.dataset, "scene": pair.scene} | values | values.pop("rates"))
    return pl.DataFrame(rows, schema=schema)


def confidence_table(frame: pl.DataFrame) -> Table:
    """Means over the maps of each data set, and over all: what is kept, and errors before and after.

    >>> confidence_table(confidence_frame({}, [])).columns[:3]
    ('dataset', 'maps', 'kept %')
    """
    kept = (100 * pl.col("num_kept") / pl.col("num_known")).fill_nan(None).mean()
    means = [pl.len(), kept, *(pl.col(name).fill_nan(None).mean() for name in _SHOWN)]
    rows = frame.group_by("dataset", maintain_order=True).agg(*_named(means)).rows()
    if len(rows) > 1:
        rows += [("all", *row) for row in frame.select(*_named(means)).rows()]
    cells = [tuple(float("nan") if cell is None else cell for cell in row) for row in rows]
    return Table("Means over the maps", ("dataset", "maps", "kept %", *_SHOWN), tuple(cells), 4)


def _named(means: list[pl.Expr]) -> list[pl.Expr]:
    return [mean.alias(f"{k}") for k, mean in enumerate(means)]
