"""Dataset x settings -> verdicts against ground truth, as the paper evaluates them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import polars as pl
import torch
from torch import Tensor

from tensor_stereo.configs import RESTRICTIONS, ClassifyConfig, Detector, EvaluationConfig, Restriction
from tensor_stereo.filters import classify_graphs
from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.metrics import Confusion, IsolatedCounts, confusion_update, isolated_update, matches_against_gt
from tensor_stereo.objects import isolated_matches
from tensor_stereo.pipeline import Stopwatch, group_pairs, match_pairs, to_gray_pairs
from tensor_stereo.types import Classification, Matches, Relation, StereoPair

VARIANTS = ("unconstrained", "constrained")


@dataclass(frozen=True, eq=False)
class VariantEvaluation:
    """One pair, one detector, with or without Restriction 3.

    Attributes:
        variant: ``unconstrained`` or ``constrained``.
        matches: the putative matches, with ``group`` if constrained.
        graphs: their Delaunay graphs.
        verdicts: one classification per restriction.
        seconds: wall time by stage.
    """

    variant: str
    matches: Matches
    graphs: MatchGraphs
    verdicts: dict[Restriction, Classification]
    seconds: dict[str, float]


@dataclass(frozen=True, eq=False)
class PairEvaluation:
    """One pair, one detector: both variants, both restrictions.

    Attributes:
        pair: the images and their ground truth.
        detector: the detector of both views.
        correct: (M,) bool, the disparity is right.
        valid: (M,) bool, ground truth is known.
        variants: unconstrained and constrained.
    """

    pair: StereoPair
    detector: Detector
    correct: Tensor
    valid: Tensor
    variants: tuple[VariantEvaluation, ...]

    def isolated(self) -> IsolatedCounts:
        """How many correct and incorrect matches join two objects that no other match joins."""
        constrained = self.variants[-1].matches
        if constrained.group is None:
            raise ValueError("variants must end with the constrained one, whose matches have a group")
        alone = isolated_matches(constrained.group, constrained.ptr)
        return isolated_update(alone, self.correct, self.valid)

    def rows(self) -> list[dict[str, Any]]:
        """One record per variant and restriction, as :func:`score_dataset` documents them."""
        return [
            _row(self, variant, restriction) for variant in self.variants for restriction in variant.verdicts
        ]  # fmt: skip


def evaluate_dataset(
    dataset: Iterable[StereoPair], config: EvaluationConfig = EvaluationConfig()
) -> Iterator[PairEvaluation]:
    """Classify every pair of a dataset with every detector and hold the verdicts against ground truth.

    Each detector runs once on noise first, so that no scene's run-time contains the start-up of libraries.

    Args:
        dataset: pairs with ``disparity_gt``.
        config: settings of every step.

    Yields:
        One evaluation per pair and detector, as soon as it is there.

    Raises:
        ValueError: for a pair without ground truth.
    """
    noise = torch.randint(0, 256, (1, 96, 96), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    blank = StereoPair("warm-up", noise, noise, torch.zeros(96, 96))
    for detector in config.detectors:
        evaluate_pair(blank, detector, config)
    for pair in dataset:
        for detector in config.detectors:
            yield evaluate_pair(pair, detector, config)


def evaluate_pair(
    pair: StereoPair, detector: Detector, config: EvaluationConfig = EvaluationConfig()
) -> PairEvaluation:
    """Run one detector on one pair, with and without Restriction 3, under both restrictions.

    Raises:
        ValueError: if the pair has no ground truth.
    """
    if pair.disparity_gt is None:
        raise ValueError(f"disparity_gt of {pair.name!r} is missing; an evaluation needs ground truth")
    settings = config.pipeline(detector)
    watch = Stopwatch()
    gray = to_gray_pairs([(pair.image0, pair.image1)])
    matches = match_pairs(gray, settings, watch)
    correct, valid = matches_against_gt(matches, [pair.disparity_gt], max_error_px=config.max_error_px)
    shared = dict(watch.seconds)
    plain = _evaluate_variant("unconstrained", matches, Stopwatch(dict(shared)), settings)
    watch = Stopwatch(dict(shared))
    constrained = _evaluate_variant("constrained", group_pairs(gray, matches, settings, watch), watch, settings)
    return PairEvaluation(pair, detector, correct, valid, (plain, constrained))


def score_dataset(dataset: Iterable[StereoPair], config: EvaluationConfig = EvaluationConfig()) -> pl.DataFrame:
    """Score every pair of a dataset, as one table.

    Args:
        dataset: pairs with ``disparity_gt``.
        config: settings of every step.

    Returns:
        One row per scene, detector, variant and restriction: ``num_matches``, ``num_valid`` (ground truth known),
        ``num_untested`` (among all matches), ``fraction_incorrect`` (of the valid ones), ``sensitivity`` (incorrect
        matches rejected), ``specificity`` (correct matches kept), ``ppv``, ``npv``, and the struct ``seconds`` of wall
        time by stage. Rates with an empty denominator are NaN.

    Raises:
        ValueError: for a pair without ground truth.

    Source: Bustos, Vargas & Trujillo, CIARP 2016, section 4.

    Example:
        >>> from tensor_stereo.datasets.synthetic import SyntheticDataset
        >>> table = score_dataset(SyntheticDataset(num_pairs=1), EvaluationConfig(detectors=("fast",)))
        >>> table.select("detector", "variant", "restriction").rows()[-1]
        ('fast', 'constrained', 'cardinality')
    """
    return pl.DataFrame([row for result in evaluate_dataset(dataset, config) for row in result.rows()])


def _evaluate_variant(variant: str, matches: Matches, watch: Stopwatch, options: ClassifyConfig) -> VariantEvaluation:
    with watch.measure("graph"):
        graphs = build_match_graphs(matches, tie_tolerance=options.tie_tolerance, backend=options.backend)
    verdicts: dict[Restriction, Classification] = {}
    for restriction in RESTRICTIONS:
        relate = Stopwatch(dict(watch.seconds))
        with relate.measure("relate"):
            verdicts[restriction] = classify_graphs(
                graphs, restriction=restriction, min_group_size=options.min_group_size
            )
    return VariantEvaluation(variant, matches, graphs, verdicts, relate.seconds)


def _row(result: PairEvaluation, variant: VariantEvaluation, restriction: Restriction) -> dict[str, Any]:
    verdict = variant.verdicts[restriction]
    confusion: Confusion = confusion_update(verdict.inlier, result.correct, result.valid)
    rates = confusion.rates()
    return {
        "scene": result.pair.name,
        "detector": result.detector,
        "variant": variant.variant,
        "restriction": restriction,
        "num_matches": variant.matches.num_matches,
        "num_valid": int(result.valid.sum()),
        "num_untested": int((verdict.relation == Relation.UNTESTED).sum()),
        "fraction_incorrect": rates.fraction_incorrect,
        "sensitivity": rates.sensitivity,
        "specificity": rates.specificity,
        "ppv": rates.ppv,
        "npv": rates.npv,
        "seconds": variant.seconds,
    }
