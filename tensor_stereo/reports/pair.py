"""One pair of image files -> a table of matches and verdicts, and a figure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import polars as pl
from matplotlib.figure import Figure
from torch import Tensor

from tensor_stereo.atomic import whole_file
from tensor_stereo.classification import verdicts_by_name
from tensor_stereo.configs import PipelineConfig, describe_settings
from tensor_stereo.datasets import PairFiles, read_image, read_pair
from tensor_stereo.datasets.discovery import find_scale
from tensor_stereo.datasets.files import check_gt_scale, check_sample_bits
from tensor_stereo.evaluation.metrics import Rates, match_rates
from tensor_stereo.evaluation.truth import matches_against_gt
from tensor_stereo.features import to_gray
from tensor_stereo.objects import trace_objects
from tensor_stereo.paths import TABLES, has_ending, prepare_targets
from tensor_stereo.pipeline import PipelineOutput, run_pipeline
from tensor_stereo.reports.figures import draw_classification, write_figure
from tensor_stereo.scores import Origin
from tensor_stereo.scores.domain import describe_domain
from tensor_stereo.table_files import write_table
from tensor_stereo.types import Relation

Truth = tuple[Tensor, Tensor]  # correct (M,) and valid (M,), bool


@dataclass(frozen=True)
class MatchSummary:
    """Counts over the matches of one pair, and the rates if ground truth is given.

    Attributes:
        num_matches: Putative matches.
        num_kept: Those that the verdict of the settings keeps.
        num_rejected: Those that it rejects on evidence.
        num_untested: Those without evidence, which it rejects too.
        num_agreeing: Those whose neighbours in one view contain those in the other.
        kept_by: What each verdict keeps: ``adjacency``, ``cardinality``, and ``score`` if there is one that can decide.
        rates: Of the verdict of the settings against ground truth, or None.
        domain: Why the pair lies outside of what the probability was calibrated on, empty inside; None without one.
        rectified: Whether the score took the pair for a rectified one; None where it does not ask.
    """

    num_matches: int
    num_kept: int
    num_rejected: int
    num_untested: int
    num_agreeing: int
    kept_by: dict[str, int]
    rates: Rates | None = None
    domain: str | None = None
    rectified: bool | None = None


def classify_files(
    left: Path | str,
    right: Path | str,
    config: PipelineConfig | None = None,
    *,
    disparity_gt: Path | str | None = None,
    gt_scale: float | None = None,
    sample_bits: int | None = None,
    out: Path | str | None = None,
    figure: Path | str | None = None,
) -> MatchSummary:
    """Match two image files and decide which matches are right.

    The pair is rectified unless the settings say otherwise.

    Args:
        left: Image of view 0.
        right: Image of view 1, of the same size if the pair is rectified or has ground truth.
        config: Settings of every step; None means the defaults.
        disparity_gt: Ground truth of view 0, PFM or PNG.
        gt_scale: Stored value / px of disparity in a PNG map; None: the one of the release, if its folders tell it.
        sample_bits: Bits in use, 8 to 16, of views that store 16 bits per sample and do not tell.
        out: File .csv or .parquet for :func:`match_table`.
        figure: File .png for both views, their matches by every verdict that decides, and their graphs.

    Returns:
        How many matches each verdict keeps.

    Raises:
        ValueError: for damaged images, views of different size, or another ending of ``out`` or ``figure``.
        FileNotFoundError: if a file is missing.
        OSError: if a result cannot be written; its folder is made.
    """
    config = config or PipelineConfig()
    left, right = Path(left), Path(right)
    disparity_gt, out, figure = (None if path is None else Path(path) for path in (disparity_gt, out, figure))
    sources = {"left": left, "right": right, "disparity_gt": disparity_gt}
    prepare_targets({"out": (out, TABLES), "figure": (figure, (".png",))}, sources)
    check_gt_scale(gt_scale)
    check_sample_bits(sample_bits)
    if gt_scale is not None and (disparity_gt is None or has_ending(disparity_gt, ".pfm")):
        raise ValueError(f"gt_scale must be None without disparity_gt in a PNG file, got {gt_scale}")
    if disparity_gt is not None and gt_scale is None:
        gt_scale = find_scale(left, disparity_gt)
    if disparity_gt is None and config.rectified is not True:  # of any sizes
        images = read_image(left, sample_bits=sample_bits), read_image(right, sample_bits=sample_bits)
        output, truth = run_pipeline([images], config), None
    else:
        pair = read_pair(PairFiles("", left.stem, left, right, disparity_gt, gt_scale, sample_bits=sample_bits))
        images = pair.image0, pair.image1
        output, truth = run_pipeline([images], config), None
        if pair.disparity_gt is not None:
            truth = matches_against_gt(output.matches, [pair.disparity_gt], max_error_px=config.max_error_px)
    if out is not None:
        table = match_table(output, config, truth)
        with whole_file(out) as part:
            write_table(table, part)
    if figure is not None:
        write_figure(_draw(left.stem, images, output, config, truth), figure)
    verdict = output.classification
    num_untested = int((verdict.relation == Relation.UNTESTED).sum())
    num_kept = int(verdict.inlier.sum())
    return MatchSummary(
        num_matches=output.matches.num_matches,
        num_kept=num_kept,
        num_rejected=output.matches.num_matches - num_kept - num_untested,
        num_untested=num_untested,
        num_agreeing=int(verdict.inlier_of("cardinality").sum()),
        kept_by={name: int(kept.sum()) for name, kept in _verdicts(output, config).items()},
        rates=None if truth is None else match_rates(verdict.inlier, *truth),
        domain=None if output.domain is None else describe_domain(int(output.domain)),
        rectified=_is_rectified(output),
    )


def match_table(
    output: PipelineOutput, config: PipelineConfig | None = None, truth: Truth | None = None
) -> pl.DataFrame:
    """One row per match of one pair.

    Columns: ``x0, y0, x1, y1, disparity`` in px, ``cost``, ``group`` if the run was constrained; ``inlier``, what the
    verdict of the settings says; ``probability`` of an error of at most ``max_error_px``, or ``score`` where that
    is none; ``inlier_adjacency``, ``inlier_cardinality`` and, if there is a score that can decide, ``inlier_score``;
    ``relation`` by name, ``overlap, degree0, degree1``; ``origin`` by name (given, refined, repaired) if the settings
    ask for either; beside a probability ``domain``, in every row why the pair lies
    outside of what it was calibrated on, empty inside; and with ``truth`` = (correct, valid) also ``correct``, null
    where ground truth is not known. ``config`` is that of the output; None means the defaults.
    """
    config = config or PipelineConfig()
    matches, verdict = output.matches, output.classification
    columns = {
        "x0": matches.keypoints0[:, 0],
        "y0": matches.keypoints0[:, 1],
        "x1": matches.keypoints1[:, 0],
        "y1": matches.keypoints1[:, 1],
        "disparity": matches.disparity,
        "cost": matches.cost,
        "group": matches.group,
        "inlier": verdict.inlier,
        "probability" if config.is_probability else "score": output.score,
        **{f"inlier_{name}": kept for name, kept in _verdicts(output, config).items()},
        "relation": verdict.relation,
        "overlap": verdict.overlap,
        "degree0": verdict.degree0,
        "degree1": verdict.degree1,
    }
    table = pl.DataFrame({name: column.numpy() for name, column in columns.items() if column is not None})
    names = {relation.value: relation.name.lower() for relation in Relation}
    table = table.with_columns(pl.col("relation").replace_strict(names, return_dtype=pl.String))
    if config.repair or config.refine:
        origins = {one.value: one.name.lower() for one in Origin}
        found = pl.Series("origin", None if output.origin is None else output.origin.numpy())
        table = table.with_columns(found.replace_strict(origins, return_dtype=pl.String))
    if output.domain is not None:
        table = table.with_columns(pl.lit(describe_domain(int(output.domain)), pl.String).alias("domain"))
    if truth is None:
        return table
    correct, valid = (pl.Series(name, values.numpy()) for name, values in zip(("correct", "valid"), truth, strict=True))
    return table.with_columns(pl.when(valid).then(correct).alias("correct"))


def _verdicts(output: PipelineOutput, config: PipelineConfig) -> dict[str, Tensor]:
    return verdicts_by_name(output.classification, output.score, config)


def _is_rectified(output: PipelineOutput) -> bool | None:
    return None if output.alignment is None else bool(output.alignment.rectified)


def _draw(
    name: str, images: tuple[Tensor, Tensor], output: PipelineOutput, config: PipelineConfig, truth: Truth | None
) -> Figure:
    correct, valid = truth if truth is not None else (None, None)
    verdicts = _verdicts(output, config)
    shown = {describe_settings(config): output.classification.inlier}
    if config.verdict == "score":
        shown["cardinality"] = verdicts["cardinality"]
    contours = [trace_objects(to_gray(image[None])[0], config.objects) for image in images if config.constrained]
    title = f"{name}, {config.detector.upper()}"
    if config.rectified == "auto" and output.alignment is not None:
        title += ", taken for rectified" if _is_rectified(output) else ", taken for not rectified"
    return draw_classification(
        *images,
        output.matches,
        shown,
        output.graphs.adjacency0,
        output.graphs.adjacency1,
        tested=output.classification.relation != Relation.UNTESTED,
        correct=correct,
        valid=valid,
        contours0=contours[0] if contours else None,
        contours1=contours[1] if contours else None,
        title=title,
    )
