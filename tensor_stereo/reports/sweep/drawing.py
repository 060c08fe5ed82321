"""What the figures of a report share: colours, shapes, labels, the frame around them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from tensor_stereo.configs import DETECTORS
from tensor_stereo.reports.sweep.results import RunResults
from tensor_stereo.reports.sweep.settings import SETTINGS, settings_label, telling_settings
from tensor_stereo.reports.sweep.svg import NUM_COLORS, Key, color_class, legend

PAPER_CLAIM = "the paper's claim: specificity around .70 at sensitivity up to .96"
MAX_SERIES = 6  # of one run in one panel
RUN_STYLES = ("", "dashed")  # lines of run A and run B
_SHAPES = ("circle", "square", "triangle", "diamond")


def panels(parts: Iterable[str], caption: str, *, keys: Sequence[Key] = ()) -> str:
    """Plots side by side above their legend and a caption of plain text."""
    inside = f'<div class="panels">{"".join(parts)}</div>{legend(keys)}'
    return f"<figure>{inside}<figcaption>{escape(caption)}</figcaption></figure>"


def detector_key(detector: str) -> Key:
    """The mark that a detector has in all figures."""
    number = DETECTORS.index(detector) if detector in DETECTORS else len(DETECTORS)
    return Key(detector.upper(), color_class(number), shape=_SHAPES[number % len(_SHAPES)])


def run_prefix(runs: Sequence[RunResults], k: int) -> str:
    """Which run something belongs to, where there are two."""
    return f"{'AB'[k]}: " if len(runs) > 1 else ""


def telling_names(rows: Sequence[Mapping[str, Any]], runs: Sequence[int]) -> list[str]:
    """Settings that tell rows of one run apart; what tells the runs apart is said by their letters."""
    parts = [[row for row, run in zip(rows, runs, strict=True) if run == k] for k in sorted(set(runs))]
    told = {name for part in parts for name in telling_settings(part)}
    return [name for name in SETTINGS if name in told]


def distinct_labels(rows: Sequence[Mapping[str, Any]], names: Sequence[str], runs: Sequence[int]) -> list[str]:
    """Labels of the rows by some settings, with the trial where a run has two that agree in these."""
    labels = [settings_label(row, names) for row in rows]
    seen = Counter(zip(runs, labels, strict=True))
    return [
        f"{label} (trial {row['trial']})" if seen[run, label] > 1 else label
        for row, label, run in zip(rows, labels, runs, strict=True)
    ]


def color_labels(figures: Sequence[Sequence[str]]) -> list[dict[str, str]]:
    """A colour class per label of each figure; the same in all figures, if there are colours enough."""
    together = dict.fromkeys(label for labels in figures for label in labels)
    if len(together) <= NUM_COLORS:
        figures = [list(together)] * len(figures)
    return [{label: color_class(k) for k, label in enumerate(dict.fromkeys(labels))} for labels in figures]


def rate_text(value: float | None) -> str:
    """A rate with three decimals.

    >>> rate_text(0.5), rate_text(None)
    ('0.500', 'undefined')
    """
    return "undefined" if value is None or math.isnan(value) else f"{value:.3f}"
