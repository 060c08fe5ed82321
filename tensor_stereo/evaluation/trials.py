"""One pair through many settings: what they share is computed once."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from tensor_stereo.classification import classify_graphs
from tensor_stereo.configs import TrialConfig
from tensor_stereo.dense.semi_global import match_keypoints
from tensor_stereo.evaluation.metrics import PAPER_SENSITIVITY, confusion_update, roc_update
from tensor_stereo.evaluation.perturbation import add_noise, inject_outliers
from tensor_stereo.evaluation.rows import SCORE_BINS, STAGES, setting_columns, stage_keys
from tensor_stereo.evaluation.truth import errors_against_gt
from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.matching import match_features
from tensor_stereo.objects import group_matches, label_objects
from tensor_stereo.pipeline import (
    ImagePair,
    Judged,
    Stopwatch,
    detect_pairs,
    improve_pairs,
    judge_matches,
    map_pairs,
    score_pairs,
    to_gray_pairs,
)
from tensor_stereo.scores.domain import describe_domain
from tensor_stereo.types import Classification, Features, Matches, Relation, StereoPair

_OUTDATED = {"graph": ("graph", "relate", "score"), "relate": (), "score": ()}  # what a new result makes useless
_Result = TypeVar("_Result")
Detect = Callable[[ImagePair, TrialConfig], tuple[tuple[Features, Features], float]]


@dataclass(frozen=True, eq=False)
class Trial:
    """One pair under one setting.

    Attributes:
        pair: the images and their ground truth.
        config: the setting.
        matches: the putative matches, exchanged and moved as the setting says, with ``group`` if constrained.
        correct: (M,) bool, disparity and row are right within ``max_error_px``.
        valid: (M,) bool, ground truth is known; all False for a pair without.
        graphs: the Delaunay graphs of both views.
        classification: the set tests; ``inlier`` follows the verdict that the setting names.
        score: (M,), higher is better; None if the setting asks for none.
        domain: Why the pair lies outside of what the probability was calibrated on, a value of
            :class:`tensor_stereo.scores.Domain`, 0 inside; None where there is no probability.
        is_rectified: Whether the score took the pair for a rectified one; None where it does not ask.
        seconds: wall time of each of ``STAGES``, also where it was shared with other trials.
    """

    pair: StereoPair
    config: TrialConfig
    matches: Matches
    correct: Tensor
    valid: Tensor
    graphs: MatchGraphs
    classification: Classification
    score: Tensor | None
    domain: int | None
    is_rectified: bool | None
    seconds: dict[str, float]

    def row(self) -> dict[str, Any]:
        """One record, whose fields :func:`tensor_stereo.score_dataset` documents."""
        config = self.config
        confusion = confusion_update(self.classification.inlier, self.correct, self.valid)
        rates = confusion.rates()
        return {
            "dataset": self.pair.dataset,
            "scene": scene_name(self.pair),
            **setting_columns(config),
            "num_matches": self.matches.num_matches,
            "num_valid": confusion.num_valid,
            "num_untested": int((self.classification.relation == Relation.UNTESTED).sum()),
            "true_positive": confusion.true_positive,
            "false_positive": confusion.false_positive,
            "true_negative": confusion.true_negative,
            "false_negative": confusion.false_negative,
            "fraction_incorrect": rates.fraction_incorrect,
            "sensitivity": rates.sensitivity,
            "specificity": rates.specificity,
            "ppv": rates.ppv,
            "npv": rates.npv,
            "precision": rates.precision,
            "recall": rates.recall,
            **self._score_row(),
            "domain": None if self.domain is None else describe_domain(self.domain),
            "is_rectified": self.is_rectified,
            "seconds": self.seconds,
        }

    def _score_row(self) -> dict[str, Any]:
        if self.score is None:
            names = ("auc", "specificity_at_sensitivity_96", "score_counts_correct", "score_counts_incorrect")
            return dict.fromkeys(names)
        counts = roc_update(self.score, self.correct, valid=self.valid)
        cell = (self.score.detach().double() * SCORE_BINS).long().clamp(0, SCORE_BINS - 1)
        correct, incorrect = (
            cell[self.valid & (self.correct == wanted)].bincount(minlength=SCORE_BINS).tolist()
            for wanted in (True, False)
        )
        return {
            "auc": counts.auc(),
            "specificity_at_sensitivity_96": counts.specificity_at(PAPER_SENSITIVITY),
            "score_counts_correct": correct,
            "score_counts_incorrect": incorrect,
        }


class TrialRunner:
    """Runs trials on one pair; a stage runs again only when its settings, or those of a stage before it, change.

    One result of each stage is held, and all verdicts and scores of the last graphs, so trials that share stages should
    follow one another.

    Args:
        pair: images, with or without ground truth.
        detect: What gives the features of both grey views, and the seconds that they took; None: they are detected.

    Example:
        >>> from tensor_stereo.datasets.synthetic.rendering import render_pair
        >>> runner = TrialRunner(render_pair(0))
        >>> first, second = (runner.run(TrialConfig(verdict=name)) for name in ("adjacency", "cardinality"))
        >>> first.graphs is second.graphs
        True
    """

    def __init__(self, pair: StereoPair, detect: Detect | None = None) -> None:
        self.pair = pair
        self._detect = detect
        self.stage = "read"  # under way, for whoever reports an error
        self._gray = to_gray_pairs([(pair.image0, pair.image1)])
        self._held: dict[str, dict[Hashable, tuple[Any, float]]] = {}

    @torch.no_grad()
    def run(self, trial: TrialConfig) -> Trial:
        """Run one trial. No gradient.

        Raises:
            ValueError: for bad settings, or ground truth that does not cover the keypoints.
        """
        keys = stage_keys(trial)
        seconds = dict.fromkeys(STAGES, 0.0)

        def share(stage: str, compute: Callable[[], _Result]) -> _Result:
            held = self._held.setdefault(stage, {})
            if keys[stage] not in held:
                self.stage = stage
                watch = Stopwatch({stage: 0.0})
                with watch.measure(stage):
                    value = compute()
                for name in _OUTDATED.get(stage, (stage,)):
                    self._held.get(name, {}).clear()
                held[keys[stage]] = value, watch.seconds[stage]
            result: _Result
            result, seconds[stage] = held[keys[stage]]
            return result

        detect = self._detect
        if detect is None:
            features = share("detect", lambda: detect_pairs(self._gray, trial))
        else:
            features, seconds["detect"] = share("detect", lambda: detect(self._gray[0], trial))
        if trial.matching.method == "sgbm":
            maps = share("disparity", lambda: map_pairs(self._gray, trial))
            putative = share("match", lambda: match_keypoints(features[0], maps, trial.matching))
            seconds["match"] += seconds.pop("disparity")
        else:
            putative = share("match", lambda: match_features(*features, trial))
        matches, error_px = share("perturb", lambda: self._perturb(putative, trial))
        correct, valid = error_px <= trial.max_error_px, ~error_px.isnan()
        if trial.constrained:
            labels = share("label", lambda: [label_objects(image, trial.objects) for image in self._gray[0]])
            matches = share("group", lambda: replace(matches, group=group_matches(matches, *labels)))
            seconds["group"] += seconds.pop("label")
        graphs = share(
            "graph",
            lambda: build_match_graphs(matches, tie_tolerance=trial.tie_tolerance, backend=trial.backend),
        )
        verdict = share(
            "relate",
            lambda: classify_graphs(graphs, trial),
        )
        found = None
        if trial.resolved_score != "none":
            found = share("score", lambda: score_pairs(self._gray, matches, graphs, trial))
        if found is not None:  # it may be that of another tolerance
            found = found._replace(score=found.within(trial.max_error_px).to(found.score.dtype))
        judged = judge_matches(matches, graphs, verdict, found, trial)
        if trial.repair or trial.refine:
            given = judged
            judged, error_px = share("improve", lambda: self._improve(given, features[0], trial))
            correct, valid = error_px <= trial.max_error_px, ~error_px.isnan()
        found, domain, is_rectified = judged.found, None, None
        if found is not None:
            domain = None if found.domain is None else int(found.domain)
            is_rectified = None if found.alignment is None else bool(found.alignment.rectified)
        known = judged.graphs, judged.verdict, judged.score, domain, is_rectified, seconds
        return Trial(self.pair, trial, judged.matches, correct, valid, *known)

    def _improve(self, judged: Judged, keypoints: Features, trial: TrialConfig) -> tuple[Judged, Tensor]:
        """What repair and refinement leave, and how far it is from ground truth."""
        improved = improve_pairs(self._gray, judged, keypoints, trial)
        return improved, self._errors(improved.matches)

    def _perturb(self, matches: Matches, trial: TrialConfig) -> tuple[Matches, Tensor]:
        """The matches as the setting wants them, and how far they are from ground truth, NaN where it is unknown."""
        name = f"{trial.seed}/{self.pair.dataset}/{scene_name(self.pair)}"
        seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") >> 1
        generator = torch.Generator().manual_seed(seed)
        if trial.outlier_rate:
            matches = inject_outliers(matches, trial.outlier_rate, generator)
        if trial.noise_px:
            height, width = self.pair.image0.shape[1:]
            matches = add_noise(matches, trial.noise_px, generator, [(height, width)])
        return matches, self._errors(matches)

    def _errors(self, matches: Matches) -> Tensor:
        """(M,) px from ground truth, NaN where it is unknown."""
        if self.pair.disparity_gt is None:
            return torch.full((matches.num_matches,), torch.nan)
        return errors_against_gt(matches, [self.pair.disparity_gt])


def scene_name(pair: StereoPair) -> str:
    """Name of a pair within its dataset, also where a data set of several releases names it ``dataset/scene``."""
    return pair.name.removeprefix(f"{pair.dataset}/")
