"""One pair of image files -> a table of matches and verdicts, and a figure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import polars as pl
from matplotlib.figure import Figure
from torch import Tensor

from tensor_stereo.configs import PipelineConfig, describe_verdict
from tensor_stereo.datasets import PairFiles, read_pair
from tensor_stereo.features import to_gray
from tensor_stereo.metrics import Rates, match_rates, matches_against_gt
from tensor_stereo.objects import trace_objects
from tensor_stereo.pipeline import PipelineOutput, run_pipeline
from tensor_stereo.reports.figures import draw_classification, write_figure
from tensor_stereo.types import Relation, StereoPair

Truth = tuple[Tensor, Tensor]  # correct (M,) and valid (M,), bool
ENDINGS = (".csv", ".parquet")


@dataclass(frozen=True)
class MatchSummary:
    """Counts over the matches of one pair, and the rates if ground truth is given."""

    num_matches: int
    num_kept: int
    num_rejected: int
    num_untested: int
    rates: Rates | None = None


def classify_files(
    left: Path,
    right: Path,
    config: PipelineConfig,
    *,
    disparity_gt: Path | None = None,
    gt_scale: float | None = None,
    out: Path | None = None,
    figure: Path | None = None,
) -> MatchSummary:
    """Run the pipeline on two image files.

    Args:
        left: image of view 0.
        right: image of view 1, of the same size.
        config: settings of every step.
        disparity_gt: ground truth of view 0, PFM or PNG.
        gt_scale: stored value / px of disparity in a PNG map.
        out: .csv or .parquet file for :func:`match_table`.
        figure: PNG file for both views, their matches and graphs.

    Raises:
        ValueError: for damaged images, views of different size, or another ending of ``out`` or ``figure``.
        FileNotFoundError: if a file or the folder of a result is missing.
    """
    if out is not None and out.suffix not in ENDINGS:
        raise ValueError(f"out must end in {' or '.join(ENDINGS)}, got {out.name!r}")
    if figure is not None and figure.suffix != ".png":
        raise ValueError(f"figure must end in .png, got {figure.name!r}")
    for name, path in (("out", out), ("figure", figure)):
        if path is not None and not path.parent.is_dir():
            raise FileNotFoundError(f"{name}: there is no folder {path.parent}")
    pair = read_pair(PairFiles("", left.stem, left, right, disparity_gt, gt_scale))
    output = run_pipeline([(pair.image0, pair.image1)], config)
    truth = None if pair.disparity_gt is None else matches_against_gt(output.matches, [pair.disparity_gt])
    if out is not None:
        table = match_table(output, truth)
        table.write_csv(out) if out.suffix == ".csv" else table.write_parquet(out)
    if figure is not None:
        write_figure(_draw(pair, output, config, truth), figure)
    verdict = output.classification
    num_untested = int((verdict.relation == Relation.UNTESTED).sum())
    num_kept = int(verdict.inlier.sum())
    return MatchSummary(
        num_matches=output.matches.num_matches,
        num_kept=num_kept,
        num_rejected=output.matches.num_matches - num_kept - num_untested,
        num_untested=num_untested,
        rates=None if truth is None else match_rates(verdict.inlier, *truth),
    )


def match_table(output: PipelineOutput, truth: Truth | None = None) -> pl.DataFrame:
    """One row per match of one pair.

    Columns: ``x0, y0, x1, y1, disparity`` in px, ``cost``, ``group`` if the run was constrained, ``inlier``, ``score``
    if there is one, ``relation`` by name, ``overlap, degree0, degree1``, and with ``truth`` = (correct, valid) also
    ``correct``, null where ground truth is not known.
    """
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
        "score": output.score,
        "relation": verdict.relation,
        "overlap": verdict.overlap,
        "degree0": verdict.degree0,
        "degree1": verdict.degree1,
    }
    table = pl.DataFrame({name: column.numpy() for name, column in columns.items() if column is not None})
    names = {relation.value: relation.name for relation in Relation}
    table = table.with_columns(pl.col("relation").replace_strict(names, return_dtype=pl.String))
    if truth is None:
        return table
    correct, valid = (pl.Series(name, values.numpy()) for name, values in zip(("correct", "valid"), truth, strict=True))
    return table.with_columns(pl.when(valid).then(correct).alias("correct"))


def _draw(pair: StereoPair, output: PipelineOutput, config: PipelineConfig, truth: Truth | None) -> Figure:
    correct, valid = truth if truth is not None else (None, None)
    images = pair.image0, pair.image1
    contours = [trace_objects(to_gray(image[None])[0], config.objects) for image in images if config.constrained]
    return draw_classification(
        *images,
        output.matches,
        output.classification,
        output.graphs.adjacency0,
        output.graphs.adjacency1,
        correct=correct,
        valid=valid,
        contours0=contours[0] if contours else None,
        contours1=contours[1] if contours else None,
        title=f"{pair.name}, {config.detector.upper()}, {describe_verdict(vars(config))}",
    )
