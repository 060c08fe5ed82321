"""What a row of results holds: the settings of its trial, counts, rates, times. Imports no torch."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import fields, replace
from typing import Any

import polars as pl

from tensor_stereo.configs import CUTS, PIPELINE_STAGES, ConsensusConfig, SGBMConfig, TrialConfig

STAGES = (*PIPELINE_STAGES[:2], "perturb", *PIPELINE_STAGES[2:])
SCORE_BINS = 128  # equal bins of [0, 1] in which the rows count scores
_COLUMN_TYPES = {bool: pl.Boolean, int: pl.Int32, float: pl.Float64, str: pl.String}
ROW_SCHEMA: dict[str, Any] = {
    "trial": pl.Int32,  # number of the setting in the configuration
    "dataset": pl.String,
    "scene": pl.String,
    "detector": pl.String,
    "feature_backend": pl.String,  # null where the detector has one implementation
    "method": pl.String,  # of matching: ssd or sgbm
    "window_px": pl.Int32,  # null where no image windows are compared by SSD
    "max_ratio": pl.Float64,  # null: no ratio test; so for every gate
    "mutual": pl.Boolean,
    "max_row_offset_px": pl.Float64,
    "min_disparity_px": pl.Float64,
    "max_disparity_px": pl.Float64,
    **{f"sgbm_{name}": _COLUMN_TYPES[type(value)] for name, value in vars(SGBMConfig()).items()},  # of sgbm, else null
    "variant": pl.String,  # unconstrained, or constrained: Restriction 3
    "repair": pl.Boolean,
    "refine": pl.Boolean,
    "verdict": pl.String,  # score, adjacency or cardinality
    "min_group_size": pl.Int32,
    "tie_tolerance": pl.Float64,
    "outlier_rate": pl.Float64,
    "noise_px": pl.Float64,
    "seed": pl.Int64,
    "score": pl.String,  # the one that was computed, or none
    "rectified": pl.String,  # true, false or auto; null where the score does not ask
    "temperature": pl.Float64,  # of the score topology, else null
    "temperature_unit": pl.String,
    **{  # of the score consensus, else null
        f"consensus_{f.name}": pl.Int32 if f.name == "num_rounds" else pl.Float64 for f in fields(ConsensusConfig)
    },
    "threshold": pl.Float64,  # one of these three at most, under the verdict score
    "target_sensitivity": pl.Float64,
    "min_precision": pl.Float64,
    "max_error_px": pl.Float64,  # of a correct match; the score is the probability of it
    "num_matches": pl.Int64,
    "num_valid": pl.Int64,  # ground truth is known
    "num_untested": pl.Int64,  # among all matches
    "true_positive": pl.Int64,  # incorrect and rejected
    "false_positive": pl.Int64,  # correct and rejected
    "true_negative": pl.Int64,  # correct and kept
    "false_negative": pl.Int64,  # incorrect and kept
    "fraction_incorrect": pl.Float64,  # of the valid ones; NaN where undefined, so for every rate
    "sensitivity": pl.Float64,  # incorrect matches rejected
    "specificity": pl.Float64,  # correct matches kept
    "ppv": pl.Float64,
    "npv": pl.Float64,
    "precision": pl.Float64,  # of the kept matches, those that are correct: npv
    "recall": pl.Float64,  # of the correct matches, those that are kept: specificity
    "auc": pl.Float64,  # of the score; null without score, so for the next three
    "specificity_at_sensitivity_96": pl.Float64,
    "score_counts_correct": pl.List(pl.Int64),  # 128 equal bins of [0, 1]; they add up over pairs
    "score_counts_incorrect": pl.List(pl.Int64),
    "domain": pl.String,  # why the score may be far off, empty if it may not; null where it is no probability
    "is_rectified": pl.Boolean,  # what the score took the pair for; null where it does not ask
    "seconds": pl.Struct(dict.fromkeys(STAGES, pl.Float64)),  # wall time by stage, also where it was shared
}


def setting_columns(config: TrialConfig) -> dict[str, Any]:
    """The settings of a trial as columns of a row; None where a setting does not apply.

    >>> setting_columns(TrialConfig(detector="sift"))["max_ratio"]
    0.8
    >>> [setting_columns(TrialConfig(rectified=kind))["rectified"] for kind in (True, False, "auto")]
    ['true', 'false', 'auto']
    """
    features, score = getattr(config, config.detector), config.resolved_score
    is_dense = config.matching.method == "sgbm"
    return {
        "detector": config.detector,
        "feature_backend": getattr(features, "backend", None),
        "method": config.matching.method,
        "window_px": None if is_dense else getattr(features, "window_px", None),
        "max_ratio": config.resolved_matching.max_ratio,
        "mutual": config.matching.mutual,
        "max_row_offset_px": None if is_dense else config.matching.max_row_offset_px,
        "min_disparity_px": config.matching.min_disparity_px,
        "max_disparity_px": config.matching.max_disparity_px,
        **{f"sgbm_{name}": value if is_dense else None for name, value in vars(config.sgbm).items()},
        "variant": "constrained" if config.constrained else "unconstrained",
        "repair": config.repair,
        "refine": config.refine,
        "verdict": config.verdict,
        "min_group_size": config.min_group_size,
        "tie_tolerance": config.tie_tolerance,
        "outlier_rate": config.outlier_rate,
        "noise_px": config.noise_px,
        "seed": config.seed,
        "score": score,
        "rectified": str(config.rectified).lower() if config.is_probability else None,
        "temperature": config.temperature if score == "topology" else None,
        "temperature_unit": config.temperature_unit if score == "topology" else None,
        **{
            f"consensus_{name}": value if score == "consensus" else None
            for name, value in vars(config.consensus).items()
        },
        **{name: getattr(config, name) for name in CUTS},
        "max_error_px": config.max_error_px,
    }


def stage_keys(trial: TrialConfig) -> dict[str, Hashable]:
    """What the result of each stage depends on; trials with equal keys share it.

    >>> trial = TrialConfig()
    >>> keys, other = stage_keys(trial), stage_keys(replace(trial, verdict="adjacency"))
    >>> [stage for stage in STAGES if keys[stage] != other[stage]]
    ['relate', 'score']
    """
    features = getattr(trial, trial.detector)
    if trial.detector == "sift":
        features = replace(features, max_ratio=None)  # a setting of the matcher
    keys: dict[str, Hashable] = {"detect": (trial.detector, features)}
    if trial.matching.method == "sgbm":
        keys["disparity"] = trial.sgbm  # of the images alone
        keys["match"] = keys["detect"], trial.matching, trial.sgbm
    else:
        keys["match"] = keys["detect"], trial.resolved_matching, trial.backend
    keys["perturb"] = keys["match"], trial.outlier_rate, trial.noise_px, trial.seed
    if trial.constrained:
        keys["label"] = trial.objects  # of the images alone
    keys["group"] = keys["perturb"], trial.objects if trial.constrained else None
    keys["graph"] = keys["group"], trial.tie_tolerance, trial.backend
    keys["relate"] = keys["graph"], trial.verdict == "adjacency", trial.min_group_size
    used = {
        "topology": (trial.temperature, trial.temperature_unit),
        "consensus": (trial.consensus, trial.rectified),
        "learned": trial.rectified,
    }
    keys["score"] = keys["graph"], trial.resolved_score, used.get(trial.resolved_score)
    decides = trial.verdict, *(getattr(trial, name) for name in CUTS), trial.max_error_px
    asked = trial.repair, trial.refine
    keys["improve"] = (keys["relate"], keys["score"], decides, asked) if any(asked) else None
    return keys
