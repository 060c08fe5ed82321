"""Operating points of scores and verdicts, per detector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tensor_stereo.reports.sweep.pooling import mildest, pool_trials, score_counts
from tensor_stereo.reports.sweep.rows import COUNTS
from tensor_stereo.reports.sweep.settings import SETTINGS, order_detectors


@dataclass(frozen=True, eq=False)
class ScoreCurve:
    """What a score does at every threshold, all pairs pooled.

    Attributes:
        trials: rows of the trials that have this score; they differ in their verdicts only.
        sensitivity: (U + 1,) fraction of the incorrect matches rejected, from rejecting none to rejecting all.
        specificity: (U + 1,) fraction of the correct matches kept.
        precision: (U + 1,) fraction of the kept matches that are correct; NaN where none is kept.
        auc: area under the ROC curve.
    """

    trials: tuple[dict[str, Any], ...]
    sensitivity: NDArray[np.float64]
    specificity: NDArray[np.float64]
    precision: NDArray[np.float64]
    auc: float

    def fixed_settings(self) -> list[str]:
        """The settings that are the same in all trials of the curve."""
        return [name for name in SETTINGS if name != "seed" and len({row[name] for row in self.trials}) == 1]


@dataclass(frozen=True, eq=False)
class DetectorCurves:
    """Curves and verdicts of one detector.

    Attributes:
        detector: which one.
        curves: by falling area under the ROC curve.
        verdicts: rows of the trials without a curve: they have no score, or no correct or no incorrect match.
    """

    detector: str
    curves: tuple[ScoreCurve, ...]
    verdicts: tuple[dict[str, Any], ...]


def detector_curves(trials: pl.DataFrame) -> list[DetectorCurves]:
    """Curves of every detector of one run, on the mildest perturbation, with pairs and seeds pooled.

    Trials whose pooled scores are the same share a curve: a verdict by another restriction or threshold changes no
    score.

    Args:
        trials: sums of one run, as :attr:`~tensor_stereo.reports.sweep.rows.RunRows.trials`.
    """
    if trials.is_empty():
        return []
    pooled = pool_trials(mildest(trials), over=("seed",))
    found = []
    for detector in order_detectors(pooled["detector"].unique()):
        of_score: dict[tuple[tuple[int, ...], ...], list[dict[str, Any]]] = {}
        verdicts = []
        for row in pooled.filter(pl.col("detector") == detector).iter_rows(named=True):
            if row[COUNTS[0]] is None:
                verdicts.append(row)
            else:
                of_score.setdefault(tuple(tuple(row[name]) for name in COUNTS), []).append(row)
        curves = []
        for sharing in of_score.values():
            curve = _curve(sharing)
            if curve is None:
                verdicts += sharing
            else:
                curves.append(curve)
        curves.sort(key=lambda curve: -curve.auc)
        found.append(DetectorCurves(detector, tuple(curves), tuple(verdicts)))
    return found


def _curve(trials: list[dict[str, Any]]) -> ScoreCurve | None:
    """The curve that trials share; None if there are no correct or no incorrect matches."""
    counts = score_counts(trials[0])
    num_correct, num_incorrect = int(counts.num_correct.sum()), int(counts.num_incorrect.sum())
    if not num_correct or not num_incorrect:
        return None
    points = counts.curve()
    sensitivity, specificity = points.sensitivity.numpy(), points.specificity.numpy()
    kept, wrong = specificity * num_correct, (1 - sensitivity) * num_incorrect
    total = kept + wrong
    precision = np.divide(kept, total, out=np.full_like(total, np.nan), where=total > 0.5)  # counts, up to rounding
    return ScoreCurve(tuple(trials), sensitivity, specificity, precision, counts.auc())
