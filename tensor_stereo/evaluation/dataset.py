"""Dataset x settings -> verdicts against ground truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import polars as pl
import torch
from torch.utils.data import Dataset

from tensor_stereo.configs import Detector, EvaluationConfig, SweepConfig
from tensor_stereo.evaluation.metrics import IsolatedCounts, isolated_update
from tensor_stereo.evaluation.rows import ROW_SCHEMA
from tensor_stereo.evaluation.trials import Trial, TrialRunner
from tensor_stereo.objects import isolated_matches
from tensor_stereo.types import StereoPair


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
