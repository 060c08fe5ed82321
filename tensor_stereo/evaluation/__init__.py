"""Verdicts against ground truth: rates and curves, trials of many settings, tables over a dataset."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensor_stereo.lazy import attach

if TYPE_CHECKING:
    from tensor_stereo.evaluation.dataset import PairEvaluation as PairEvaluation
    from tensor_stereo.evaluation.dataset import evaluate_dataset as evaluate_dataset
    from tensor_stereo.evaluation.dataset import evaluate_pair as evaluate_pair
    from tensor_stereo.evaluation.dataset import score_dataset as score_dataset
    from tensor_stereo.evaluation.metrics import Confusion as Confusion
    from tensor_stereo.evaluation.metrics import MatchRates as MatchRates
    from tensor_stereo.evaluation.metrics import Rates as Rates
    from tensor_stereo.evaluation.metrics import ScoreCounts as ScoreCounts
    from tensor_stereo.evaluation.metrics import match_rates as match_rates
    from tensor_stereo.evaluation.metrics import roc_auc as roc_auc
    from tensor_stereo.evaluation.metrics import roc_curve as roc_curve
    from tensor_stereo.evaluation.perturbation import add_noise as add_noise
    from tensor_stereo.evaluation.perturbation import inject_outliers as inject_outliers
    from tensor_stereo.evaluation.rows import ROW_SCHEMA as ROW_SCHEMA
    from tensor_stereo.evaluation.sparsification import sparsification_area as sparsification_area
    from tensor_stereo.evaluation.sparsification import sparsification_curve as sparsification_curve
    from tensor_stereo.evaluation.trials import Trial as Trial
    from tensor_stereo.evaluation.trials import TrialRunner as TrialRunner
    from tensor_stereo.evaluation.truth import errors_against_gt as errors_against_gt
    from tensor_stereo.evaluation.truth import errors_to_partners as errors_to_partners
    from tensor_stereo.evaluation.truth import matches_against_gt as matches_against_gt

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Confusion": "metrics",
        "MatchRates": "metrics",
        "PairEvaluation": "dataset",
        "ROW_SCHEMA": "rows",
        "Rates": "metrics",
        "ScoreCounts": "metrics",
        "Trial": "trials",
        "TrialRunner": "trials",
        "add_noise": "perturbation",
        "errors_against_gt": "truth",
        "errors_to_partners": "truth",
        "evaluate_dataset": "dataset",
        "evaluate_pair": "dataset",
        "inject_outliers": "perturbation",
        "match_rates": "metrics",
        "matches_against_gt": "truth",
        "roc_auc": "metrics",
        "roc_curve": "metrics",
        "score_dataset": "dataset",
        "sparsification_area": "sparsification",
        "sparsification_curve": "sparsification",
    },
)
