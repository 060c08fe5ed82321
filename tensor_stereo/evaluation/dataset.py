"""Dataset x settings -> verdicts against ground truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import polars as pl
import torch
from torch.utils.data import Dataset

from tensor_stereo.configs import ConsensusConfig, Detector, EvaluationConfig, SGBMConfig, SweepConfig
from tensor_stereo.evaluation.metrics import IsolatedCounts, isolated_update
from tensor_stereo.evaluation.trials import STAGES, Trial, TrialRunner
from tensor_stereo.objects import isolated_matches
from tensor_stereo.types import StereoPair

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


@dataclass(frozen=True, eq=False)
class PairEvaluation:
    """One pair, one detector, under every verdict that the tables show.

    Attributes:
        pair: the images and their ground truth.
        detector: the detector of both views.
        trials: one result per setting of :meth:`tensor_stereo.configs.EvaluationConfig.trials`, the constrained ones
            last.
    """

    pair: StereoPair
    detector: Detector
    trials: tuple[Trial, ...]

    def isolated(self) -> IsolatedCounts:
        """How many correct and incorrect matches join two objects that no other match joins."""
        last = self.trials[-1]
        if last.matches.group is None:
            raise ValueError("trials must end with a constrained one, whose matches have a group")
        alone = isolated_matches(last.matches.group, last.matches.ptr)
        return isolated_update(alone, last.correct, last.valid)

    def rows(self) -> list[dict[str, Any]]:
        """One record per trial, as :func:`score_dataset` documents them, under the full name of the pair."""
        return [trial.row() | {"scene": self.pair.name} for trial in self.trials]


def evaluate_dataset(
    dataset: Iterable[StereoPair] | Dataset[StereoPair],
    config: EvaluationConfig = EvaluationConfig(),
    *,
    on_error: Callable[[str, Exception], None] | None = None,
) -> Iterator[PairEvaluation]:
    """Classify every pair of a dataset with every detector and hold the verdicts against ground truth.

    Each detector runs once on noise first, so that no scene's run-time contains the start-up of libraries.

    Args:
        dataset: Pairs with ``disparity_gt``, one after another, or a map-style data set of them.
        config: settings of every step.
        on_error: Called with the name of a pair that cannot be read or evaluated and the reason, after which the next
            pair follows; None: the error is raised.

    Yields:
        One evaluation per pair and detector, as soon as it is there.

    Raises:
        ValueError: for a pair without ground truth.
    """
    noise = torch.randint(0, 256, (1, 96, 96), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    blank = StereoPair("warm-up", noise, noise, torch.zeros(96, 96))
    for detector in config.detectors:
        evaluate_pair(blank, detector, config)
    for name, read in _readers(dataset):
        try:
            pair = read()
            evaluations = [evaluate_pair(pair, detector, config) for detector in config.detectors]
        except (ValueError, TypeError, OSError) as error:
            if on_error is None:
                raise
            on_error(name, error)
            continue
        yield from evaluations


def _readers(
    dataset: Iterable[StereoPair] | Dataset[StereoPair],
) -> Iterator[tuple[str, Callable[[], StereoPair]]]:
    """Name of each pair and what reads it."""
    if isinstance(dataset, Dataset):
        names = getattr(dataset, "names", None)
        for k in range(len(dataset)):  # type: ignore[arg-type]
            yield names[k] if names else f"pair {k}", partial(dataset.__getitem__, k)
        return
    for pair in dataset:
        yield pair.name, partial(_same, pair)


def _same(pair: StereoPair) -> StereoPair:
    return pair


def evaluate_pair(
    pair: StereoPair, detector: Detector, config: EvaluationConfig = EvaluationConfig()
) -> PairEvaluation:
    """Run one detector on one pair, under every verdict that the tables show.

    Raises:
        ValueError: if the pair has no ground truth.
    """
    check_truth(pair)
    runner = TrialRunner(pair)
    return PairEvaluation(pair, detector, tuple(runner.run(trial) for trial in config.trials(detector)))


def score_dataset(
    dataset: Iterable[StereoPair], config: SweepConfig | EvaluationConfig = EvaluationConfig()
) -> pl.DataFrame:
    """Score every pair of a dataset, as one table.

    Args:
        dataset: pairs with ``disparity_gt``.
        config: the points of a sweep, as :func:`tensor_stereo.sweeps.read_grid` makes them, or the settings of the
            paper's tables: every detector by its score, and under both restrictions without and with Restriction 3.

    Returns:
        One row per pair and point, in this order, with the columns of ``ROW_SCHEMA``: the settings; ``num_matches``,
        ``num_valid``, ``num_untested``; the counts and rates of the verdict (positive: estimated incorrectly); area
        under the ROC curve and binned counts of the score, if there is one; and ``seconds`` by stage. A sweep over the
        same pairs stores the same rows.

    Raises:
        ValueError: for a pair without ground truth.

    Source: Bustos, Vargas & Trujillo, CIARP 2016, section 4.

    Example:
        >>> from tensor_stereo.datasets.synthetic.rendering import SyntheticDataset
        >>> table = score_dataset(SyntheticDataset(num_pairs=1), EvaluationConfig(detectors=("fast",)))
        >>> table.select("detector", "variant", "verdict").rows()[-1]
        ('fast', 'constrained', 'cardinality')
    """
    if isinstance(config, SweepConfig):
        trials = config.trials
    else:
        trials = tuple(trial for detector in config.detectors for trial in config.trials(detector))
    rows = []
    for pair in dataset:
        check_truth(pair)
        runner = TrialRunner(pair)
        rows += [{"trial": k} | runner.run(trial).row() for k, trial in enumerate(trials)]
    return pl.DataFrame(rows, schema=ROW_SCHEMA)


def check_truth(pair: StereoPair) -> None:
    """Raise if a pair has no ground truth."""
    if pair.disparity_gt is None:
        raise ValueError(f"disparity_gt of {pair.name!r} is missing; an evaluation needs ground truth")
