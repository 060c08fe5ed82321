"""The figures of trials, run-times and perturbations, each as HTML."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl

from tensor_stereo.evaluation.metrics import PAPER_SENSITIVITY, PAPER_SPECIFICITY
from tensor_stereo.reports.sweep.drawing import (
    MAX_SERIES,
    PAPER_CLAIM,
    RUN_STYLES,
    color_labels,
    detector_key,
    distinct_labels,
    panels,
    rate_text,
    run_prefix,
    telling_names,
)
from tensor_stereo.reports.sweep.pooling import pool_trials, stage_times
from tensor_stereo.reports.sweep.results import RunResults
from tensor_stereo.reports.sweep.settings import SETTINGS, order_detectors, settings_label
from tensor_stereo.reports.sweep.svg import INK, Axis, Key, Plot, log_axis, name_axis, rate_axis


def scatter_figure(runs: Sequence[RunResults]) -> str:
    """Sensitivity and specificity of every trial, pairs pooled, with the paper's headline point."""
    shown = [(k, row) for k, run in enumerate(runs) for row in pool_trials(run.rows.trials).iter_rows(named=True)]
    plot = Plot(
        rate_axis(
            "sensitivity: incorrect matches rejected", [PAPER_SENSITIVITY, *(r["sensitivity"] for _, r in shown)]
        ),
        rate_axis("specificity: correct matches kept", [PAPER_SPECIFICITY, *(r["specificity"] for _, r in shown)]),
        title="All trials, pairs pooled",
        description="Specificity against sensitivity of every trial; the table of trials has the numbers. "
        f"A star marks {PAPER_CLAIM}.",
        width=500,
        height=400,
    )
    for k, row in shown:
        rates = f"sensitivity {rate_text(row['sensitivity'])}, specificity {rate_text(row['specificity'])}"
        tip = f"{run_prefix(runs, k)}trial {row['trial']}: {settings_label(row, list(SETTINGS))}\n{rates}"
        filled = k == 1 if len(runs) > 1 else row["variant"] == "constrained"
        plot.mark(
            row["sensitivity"], row["specificity"], replace(detector_key(row["detector"]), filled=filled), tip=tip
        )
    paper = Key(PAPER_CLAIM, INK, shape="star")
    plot.mark(PAPER_SENSITIVITY, PAPER_SPECIFICITY, paper, tip=PAPER_CLAIM)
    plot.note(PAPER_SENSITIVITY, PAPER_SPECIFICITY, "paper's claim")
    meaning = ("run A", "run B") if len(runs) > 1 else ("unconstrained", "constrained")
    keys = [detector_key(name) for name in order_detectors({row["detector"] for _, row in shown})]
    keys += [Key(text, INK, shape="circle", filled=k == 1) for k, text in enumerate(meaning)]
    caption = "One mark per trial; point at it for its settings. Up and to the right is better."
    return panels([plot.render()], caption, keys=[*keys, paper])


def runtime_figure(runs: Sequence[RunResults]) -> str:
    """Mean wall time of every stage and detector; empty if nothing was measured."""
    rows = [(k, row) for k, run in enumerate(runs) for row in stage_times(run.rows.trials).iter_rows(named=True)]
    stages = list(dict.fromkeys(name for _, row in rows for name in row if name != "detector"))
    stages.sort(key=lambda name: name == "total")  # last, also if a stage is in the second run only
    spent = [row[stage] for _, row in rows for stage in stages if row.get(stage) is not None]
    if not spent:
        return ""
    totals = (f"{run_prefix(runs, k)}{row['detector'].upper()} {_milliseconds(row['total'])}" for k, row in rows)
    plot = Plot(
        log_axis("ms per pair", spent),
        name_axis(stages),
        title="Run-time by stage",
        description=f"Mean run-time by stage; the table beside it has the numbers. In total: {'; '.join(totals)}.",
        width=500,
        height=80 + 30 * len(stages),
        left=72,
    )
    names = order_detectors({row["detector"] for _, row in rows})
    for k, row in rows:
        key = replace(detector_key(row["detector"]), filled=len(runs) == 1 or k == 1)
        lane = _LANE * (names.index(row["detector"]) - (len(names) - 1) / 2)  # or equal times would hide one another
        for place, stage in enumerate(stages):
            if row.get(stage) is not None:
                tip = f"{run_prefix(runs, k)}{key.label}, {stage}: {_milliseconds(row[stage])}"
                plot.mark(row[stage], place + lane, key, tip=tip)
    keys = [detector_key(name) for name in names]
    if len(runs) > 1:
        keys += [Key(f"run {tag}", INK, shape="circle", filled=tag == "B") for tag in "AB"]
    caption = "Mean over the trials in which a stage ran; what several trials share counts in each. Logarithmic scale."
    return panels([plot.render()], caption, keys=keys)


_LANE = 0.17  # of the room of a stage
_METRICS = {
    "sensitivity": "sensitivity",
    "specificity": "specificity",
    "auc": "AUC",
    "specificity_at_sensitivity_96": "specificity at sensitivity .96",
}


@dataclass(frozen=True, eq=False)
class _Series:
    """How one point of settings does as a perturbation grows."""

    run: int
    detector: str
    rows: tuple[dict[str, Any], ...]

    def mean_accuracy(self) -> float:
        """The mean of sensitivity and specificity, over the perturbations."""
        values = [(row["sensitivity"] + row["specificity"]) / 2 for row in self.rows]
        known = [value for value in values if not math.isnan(value)]
        return math.fsum(known) / len(known) if known else -math.inf


def perturbation_figures(runs: Sequence[RunResults], name: str) -> str:
    """Rates against ``outlier_rate`` or ``noise_px``, a row of panels per detector; empty if it does not vary."""
    series = [item for k, run in enumerate(runs) for item in _series(run.rows.trials, name, k)]
    values = sorted({row[name] for item in series for row in item.rows})
    if len(values) < 2:
        return ""
    rows = [row for item in series for row in item.rows]
    metrics = {metric: text for metric, text in _METRICS.items() if any(row[metric] is not None for row in rows)}
    label = {"outlier_rate": "fraction of partners exchanged", "noise_px": "noise of the keypoints in px"}[name]
    ticks = values if len(values) <= 7 else np.linspace(values[0], values[-1], 5).tolist()
    axis = Axis(label, values[0], values[-1], tuple((value, f"{value:.3g}") for value in ticks))
    detectors = order_detectors({item.detector for item in series})
    chosen = [_best(series, name) for name in detectors]
    labels = [_labels(shown, name) for shown in chosen]
    figures = []
    for detector, shown, texts, colors in zip(detectors, chosen, labels, color_labels(labels), strict=True):
        keys = [
            Key(f"{run_prefix(runs, item.run)}{text}", colors[text], line=True, style=RUN_STYLES[item.run])
            for item, text in zip(shown, texts, strict=True)
        ]
        drawn = [
            _panel(shown, keys, axis, (name, metric), detector.upper(), heading) for metric, heading in metrics.items()
        ]
        total = sum(item.detector == detector for item in series)
        first = "" if len(shown) == total else f"The best {len(shown)} of {total} settings. "
        figures.append(panels(drawn, f"{first}Pairs and seeds pooled.", keys=keys))
    return "".join(figures)


def _best(series: Sequence[_Series], detector: str) -> list[_Series]:
    """The best of each run."""
    ranked = sorted(series, key=lambda item: -item.mean_accuracy())
    found = [[item for item in ranked if (item.run, item.detector) == (k, detector)][:MAX_SERIES] for k in (0, 1)]
    return found[0] + found[1]


def _labels(shown: Sequence[_Series], name: str) -> list[str]:
    firsts = [item.rows[0] for item in shown]
    runs = [item.run for item in shown]
    names = [each for each in telling_names(firsts, runs) if each != name]
    return distinct_labels(firsts, names or ["verdict"], runs)


def _panel(
    shown: Sequence[_Series], keys: Sequence[Key], axis: Axis, names: tuple[str, str], detector: str, heading: str
) -> str:
    """One rate of several series; ``names``: the columns of both axes."""
    name, metric = names
    ends = (
        f"{key.label} from {rate_text(item.rows[0][metric])} to {rate_text(item.rows[-1][metric])}"
        for item, key in zip(shown, keys, strict=True)
    )
    description = f"{detector}: {heading} against the {axis.label}. {'; '.join(ends)}."
    plot = Plot(axis, rate_axis(heading), title=f"{detector}: {heading}", description=description)
    for item, key in zip(shown, keys, strict=True):
        xs = [row[name] for row in item.rows]
        ys = [math.nan if row[metric] is None else row[metric] for row in item.rows]
        plot.line(xs, ys, key)
        for x, y in zip(xs, ys, strict=True):
            plot.mark(x, y, replace(key, shape="circle"), tip=f"{key.label}: {y:.3f} at {x:g}")
    return plot.render()


def _series(trials: pl.DataFrame, name: str, run: int) -> list[_Series]:
    """One series per point of the other settings, on the least of the other perturbation."""
    other = {"outlier_rate": "noise_px", "noise_px": "outlier_rate"}[name]
    pooled = pool_trials(trials.filter(pl.col(other) == pl.col(other).min().over("detector")), over=("seed",)).sort(
        name
    )
    keys = [key for key in SETTINGS if key not in (name, "seed")]
    found: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in pooled.iter_rows(named=True):
        found.setdefault((*(row[key] for key in keys), row["repeat"]), []).append(row)
    return [_Series(run, rows[0]["detector"], tuple(rows)) for rows in found.values() if len(rows) > 1]


def _milliseconds(value: float) -> str:
    return f"{value:.3g} ms"
