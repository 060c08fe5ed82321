"""ROC and precision-recall curves of every detector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tensor_stereo.evaluation.metrics import PAPER_SENSITIVITY, PAPER_SPECIFICITY
from tensor_stereo.reports.sweep.curves import DetectorCurves, ScoreCurve, detector_curves
from tensor_stereo.reports.sweep.drawing import (
    MAX_SERIES,
    PAPER_CLAIM,
    RUN_STYLES,
    color_labels,
    distinct_labels,
    panels,
    rate_text,
    run_prefix,
    telling_names,
)
from tensor_stereo.reports.sweep.pooling import decided_by_score
from tensor_stereo.reports.sweep.results import RunResults
from tensor_stereo.reports.sweep.settings import PERTURBATIONS, order_detectors
from tensor_stereo.reports.sweep.svg import INK, Key, Plot, legend, rate_axis

_VERDICTS = {"cardinality": "circle", "adjacency": "triangle"}


@dataclass(frozen=True, eq=False)
class _Drawn:
    """A curve with its name and look."""

    run: int
    curve: ScoreCurve
    key: Key


def curve_figures(runs: Sequence[RunResults]) -> str:
    """A ROC and a precision-recall panel per detector, under one legend for marks and lines."""
    found = [{item.detector: item for item in detector_curves(run.rows.trials)} for run in runs]
    detectors = order_detectors({name for of_run in found for name in of_run})
    chosen = [
        [(k, curve) for k, of_run in enumerate(found) if name in of_run for curve in of_run[name].curves[:MAX_SERIES]]
        for name in detectors
    ]
    labels = [_labels(curves) for curves in chosen]
    figures = []
    for name, curves, texts, colors in zip(detectors, chosen, labels, color_labels(labels), strict=True):
        drawn = []
        for (k, curve), text in zip(curves, texts, strict=True):
            label = f"{run_prefix(runs, k)}{text}: AUC {curve.auc:.3f}"
            drawn.append(_Drawn(k, curve, Key(label, colors[text], line=True, style=RUN_STYLES[k])))
        figures.append(_figure(runs, name, [of_run.get(name) for of_run in found], drawn))
    keys = [
        Key("verdict of Restriction 2 (cardinality)", INK, shape="circle"),
        Key("verdict of Restriction 1 (adjacency)", INK, shape="triangle"),
        Key("verdict by score", INK, shape="diamond"),
        Key(PAPER_CLAIM, INK, shape="star"),
        Key("chance", INK, line=True, style="chance"),
    ]
    if len(runs) > 1:
        keys += [Key(f"run {tag}", INK, line=True, style=style) for tag, style in zip("AB", RUN_STYLES, strict=True)]
    return f'{legend(keys)}<div class="pairs">{"".join(figures)}</div>'


def _labels(curves: Sequence[tuple[int, ScoreCurve]]) -> list[str]:
    """Names of curves of one detector, by settings that do not differ within a curve."""
    firsts = [curve.trials[0] for _, curve in curves]
    runs = [k for k, _ in curves]
    fixed = [curve.fixed_settings() for _, curve in curves]
    names = [name for name in telling_names(firsts, runs) if all(name in alike for alike in fixed)]
    return distinct_labels(firsts, names or ["score"], runs)


def _figure(
    runs: Sequence[RunResults], detector: str, of_runs: Sequence[DetectorCurves | None], drawn: Sequence[_Drawn]
) -> str:
    """Both panels of one detector."""
    title = detector.upper()
    areas = "; ".join(item.key.label for item in drawn) or "No score, verdicts only"
    roc = Plot(
        rate_axis("1 - specificity: correct matches rejected"),
        rate_axis("sensitivity: incorrect matches rejected"),
        title=f"{title}: ROC",
        description=f"ROC of {title}. {areas}.",
    )
    recall = Plot(
        rate_axis("recall: correct matches kept"),
        rate_axis("precision: kept matches that are correct"),
        title=f"{title}: precision-recall",
        description=f"Precision against recall of the kept correct matches of {title}. {areas}.",
    )
    roc.line([0, 1], [0, 1], Key("", INK, style="chance"))
    for item in drawn:
        roc.line(1 - item.curve.specificity, item.curve.sensitivity, item.key)
        recall.line(item.curve.specificity, item.curve.precision, item.key)
    verdicts = [(item.run, row, item.key.color) for item in drawn for row in item.curve.trials]
    verdicts += [(k, row, INK) for k, of_run in enumerate(of_runs) if of_run for row in of_run.verdicts]
    seen: set[tuple[Any, ...]] = set()
    for k, row, color in verdicts:
        shape = "diamond" if decided_by_score(row) else _VERDICTS.get(row["verdict"], "circle")
        place = k, row["sensitivity"], row["specificity"], shape
        if place in seen:  # settings without an effect on the verdict
            continue
        seen.add(place)
        mark = Key("", color, shape=shape, filled=len(runs) == 1 or k == 1)
        tip = _tip(f"{run_prefix(runs, k)}trial {row['trial']}", row)
        roc.mark(1 - row["specificity"], row["sensitivity"], mark, tip=tip)
        recall.mark(row["recall"], row["precision"], mark, tip=tip)
    roc.mark(1 - PAPER_SPECIFICITY, PAPER_SENSITIVITY, Key("", INK, shape="star"), tip=PAPER_CLAIM)
    num_curves = sum(len(of_run.curves) for of_run in of_runs if of_run)
    chosen = f" The {len(drawn)} curves with the largest area of {num_curves}." if len(drawn) < num_curves else ""
    levels = [_level(of_run) for of_run in of_runs if of_run]
    if len(set(levels)) > 1:
        levels = [f"{run_prefix(runs, k)}{level}" for k, level in enumerate(levels)]
    return panels(
        [roc.render(), recall.render()],
        f"Pairs and seeds pooled; {'; '.join(dict.fromkeys(levels))}.{chosen}",
        keys=[item.key for item in drawn],
    )


def _level(found: DetectorCurves) -> str:
    """The perturbation that the curves were measured on."""
    row = [*found.verdicts, *(trial for curve in found.curves for trial in curve.trials)][0]
    outliers, noise = (row[name] for name in PERTURBATIONS)
    return f"{outliers:.3g} of the partners exchanged, noise {noise:.3g} px"


def _tip(start: str, row: Mapping[str, Any]) -> str:
    names = ("sensitivity", "specificity", "precision", "recall")
    return "\n".join([start, *(f"{name} {rate_text(row[name])}" for name in names)])
