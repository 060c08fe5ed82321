"""Made-up sweeps whose rows hang together as those of real ones do."""

from __future__ import annotations

import io
import itertools
import math
import zlib
from collections.abc import Sequence
from dataclasses import asdict, fields
from typing import Any

import numpy as np
import polars as pl
import torch
from PIL import Image

from tensor_stereo.configs import ConsensusConfig, SGBMConfig
from tensor_stereo.evaluation.metrics import confusion_update, roc_update
from tensor_stereo.evaluation.rows import ROW_SCHEMA, SCORE_BINS, STAGES
from tensor_stereo.reports.sweep.results import ERROR_COLUMNS, Overlay, RunResults
from tensor_stereo.reports.sweep.rows import RunRows

SCENES = ("Art", "Books", "Cones", "Dolls", "Laundry", "Moebius", "Reindeer", "Teddy")
_INCORRECT = {"sift": 0.15, "fast": 0.5, "surf": 0.7, "gftt": 0.42}  # about what the detectors give
_SECONDS = {"sift": (0.21, 0.012), "fast": (0.004, 0.002), "surf": (0.15, 0.009), "gftt": (0.018, 0.002)}


def make_grid(
    detectors: Sequence[str] = ("sift", "fast", "surf", "gftt"),
    *,
    outlier_rates: Sequence[float] = (0.0, 0.2, 0.4),
    verdicts: Sequence[str] = ("adjacency", "cardinality"),
    scores: Sequence[str] = ("topology",),
    slopes: Sequence[float] = (0.2,),
    rectified: Sequence[str] = ("true",),
    seeds: Sequence[int] = (0,),
) -> list[dict[str, Any]]:
    """Settings of every trial, by the names of the columns.

    ``slopes`` are of the score consensus, ``rectified`` of this and ``learned``.
    """
    axes = detectors, ("unconstrained", "constrained"), verdicts, scores, outlier_rates
    return [
        {
            "detector": detector,
            "feature_backend": "kornia" if detector in ("sift", "gftt") else None,
            "method": "ssd",
            "window_px": 11 if detector in ("fast", "gftt") else None,
            "max_ratio": 0.8 if detector == "sift" else None,
            "mutual": False,
            "max_row_offset_px": 1.0,
            "min_disparity_px": 0.0,
            "max_disparity_px": 128.0,
            **dict.fromkeys(f"sgbm_{f.name}" for f in fields(SGBMConfig)),
            "variant": variant,
            "repair": False,
            "refine": False,
            "verdict": verdict,
            "min_group_size": 4,
            "tie_tolerance": 1e-3,
            "outlier_rate": rate,
            "noise_px": 0.0,
            "seed": seed,
            "score": score,
            "rectified": kind,
            "temperature": 1.0 if score == "topology" else None,
            "temperature_unit": "edge" if score == "topology" else None,
            **consensus_columns(ConsensusConfig(slope=slope) if score == "consensus" else None),
            "threshold": 0.4 if (verdict, score) == ("score", "topology") else None,
            "target_sensitivity": None,
            "min_precision": None,
            "max_error_px": 1.0,
        }
        for detector, variant, verdict, score, rate in itertools.product(*axes)
        for slope in (slopes if score == "consensus" else (None,))
        for kind in (rectified if score in ("learned", "consensus") else (None,))
        for seed in seeds
    ]


def consensus_columns(settings: ConsensusConfig | None) -> dict[str, Any]:
    """The columns of the score consensus; all null for another score."""
    return {f"consensus_{f.name}": settings and getattr(settings, f.name) for f in fields(ConsensusConfig)}


def make_results(
    grid: Sequence[dict[str, Any]] | None = None, *, num_pairs: int = 8, seed: int = 0, gain: float = 0.0
) -> pl.DataFrame:
    """One row per pair and trial.

    Verdicts and scores of some hundred matches are drawn for each, and counted by ``tensor_stereo.evaluation.metrics``.
    ``gain`` makes the correct matches score higher.
    """
    rows = []
    trials = make_grid() if grid is None else grid
    detectors = list(dict.fromkeys(trial["detector"] for trial in trials))
    for pair in range(num_pairs):
        scene = SCENES[pair] if pair < len(SCENES) else f"frame_{pair:04d}"
        dataset = "middlebury-2005" if pair < len(SCENES) else "kitti-2015"
        difficulty = np.random.default_rng((seed, pair)).normal(0, 0.08)
        for k, trial in enumerate(trials):
            unit = pair * len(detectors) + detectors.index(trial["detector"])
            names = {"unit": unit, "trial": k, "dataset": dataset, "scene": scene, "host": f"node-{pair % 2}"}
            rows.append(names | trial | _measure(trial, pair, seed, difficulty, gain))
    return pl.DataFrame(rows, schema={"unit": pl.Int32} | ROW_SCHEMA | {"host": pl.String})


def _measure(trial: dict[str, Any], pair: int, seed: int, difficulty: float, gain: float) -> dict[str, Any]:
    kept = [(name, trial[name]) for name in ("detector", "variant", "outlier_rate", "noise_px", "seed")]
    number = zlib.crc32(repr(kept).encode())
    draw = np.random.default_rng((seed, pair, number))
    num_matches = int(draw.integers(150, 420))
    wrong = np.clip(_INCORRECT[trial["detector"]] + difficulty, 0.03, 0.95)
    wrong += (1 - wrong) * trial["outlier_rate"]
    correct = draw.random(num_matches) > wrong
    valid = draw.random(num_matches) > 0.07
    helped = 0.04 if trial["variant"] == "constrained" else 0.0
    scorer = np.random.default_rng((seed, pair, number, zlib.crc32(trial["score"].encode())))
    score = np.where(
        correct,
        scorer.beta(1.1 + 2.0 * (1 - wrong) + 6 * helped + 4 * gain, 2.4, num_matches),
        scorer.beta(0.8, 2.6, num_matches),
    )
    strict = 0.72 if trial["verdict"] == "adjacency" else 1.0
    chance = np.where(correct, strict * (0.15 + helped + 0.6 * (1 - wrong)), strict * (0.10 + 2 * helped))
    inlier = draw.random(num_matches) < chance
    if trial["verdict"] == "score":
        inlier = score >= (trial["threshold"] or 0.5)
    truth = torch.from_numpy(correct), torch.from_numpy(valid)
    confusion = confusion_update(torch.from_numpy(inlier), *truth)
    measured: dict[str, Any] = {"num_matches": num_matches, "num_valid": confusion.num_valid}
    measured |= {"num_untested": int(draw.integers(0, 9))} | asdict(confusion) | asdict(confusion.rates())
    del measured["num_unknown"]
    if trial["score"] != "none":
        counts = roc_update(torch.from_numpy(score), truth[0], valid=truth[1])
        measured["auc"], measured["specificity_at_sensitivity_96"] = counts.auc(), counts.specificity_at(0.96)
        for name, which in (("correct", correct), ("incorrect", ~correct)):
            cells = (score[valid & which] * SCORE_BINS).astype(int).clip(0, SCORE_BINS - 1)
            measured[f"score_counts_{name}"] = np.bincount(cells, minlength=SCORE_BINS).tolist()
    else:
        measured |= dict.fromkeys(("auc", "specificity_at_sensitivity_96"))
        measured |= dict.fromkeys(("score_counts_correct", "score_counts_incorrect"))
    detect, match = _SECONDS[trial["detector"]]
    spent = {"detect": detect, "match": match, "graph": 4e-4, "relate": 6e-5}
    spent |= {"perturb": 1e-4} if trial["outlier_rate"] else {}
    spent |= {"group": 7e-3} if trial["variant"] == "constrained" else {}
    spent |= {"score": 2e-3} if trial["score"] != "none" else {}
    seconds = {stage: spent.get(stage, 0.0) * math.exp(draw.normal(0, 0.2)) for stage in STAGES}
    domain = "" if trial["score"] in ("learned", "consensus") else None
    is_rectified = None if domain is None else trial["rectified"] != "false"
    return measured | {"domain": domain, "is_rectified": is_rectified, "seconds": seconds}


def make_png() -> bytes:
    """A grey picture."""
    file = io.BytesIO()
    Image.new("L", (8, 6), 128).save(file, "PNG")
    return file.getvalue()


def make_errors(num: int = 2) -> pl.DataFrame:
    """Failed units, none of which has results."""
    reasons = (
        ("read", "ValueError", "DATA/kitti-2015/image_2/frame_0077.png is damaged: it ends after 1024 bytes"),
        ("detect", "MemoryError", "Unable to allocate 1.07 GiB for an array with shape (12000, 8000, 3)"),
    )
    rows = []
    for k in range(num):
        reason = reasons[k % len(reasons)]
        rows.append((10_000 + k, "kitti-2015", f"frame_{9000 + k}", "fast", *reason, 3))
    kinds = (pl.Int32, pl.String, pl.String, pl.String, pl.String, pl.String, pl.String, pl.Int32)
    return pl.DataFrame(rows, schema=dict(zip(ERROR_COLUMNS, kinds, strict=True)), orient="row")


def trials_of(results: pl.DataFrame) -> pl.DataFrame:
    """The sums of each trial."""
    return RunRows.of(results).trials


def make_run(name: str = "baseline", results: pl.DataFrame | None = None, *, num_errors: int = 2) -> RunResults:
    """A run with everything."""
    return RunResults(
        name=name,
        rows=RunRows.of(make_results() if results is None else results),
        errors=make_errors(num_errors),
        config={"manifest": "manifest.parquet", "trials": [{"detector": "fast", "score": "topology"}]},
        environment=[
            {"host": f"node-{k}", "python": "3.12.4", "versions": {"torch": "2.9.0", "kornia": "0.9.1"}} for k in (0, 1)
        ],
        overlays=(Overlay("Art, FAST: kept and rejected matches", make_png()),),
    )
