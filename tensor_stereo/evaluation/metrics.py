"""How good verdicts and scores are, against ground truth.

**Positive means estimated incorrectly**: a match is positive if it is wrong, and predicted positive if it is
rejected. Every figure comes from integer counts that add up exactly, so parts merged give what the whole gives.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from operator import add

import torch
from torch import Tensor

from tensor_stereo.types import check_mask, check_vector

PAPER_SENSITIVITY, PAPER_SPECIFICITY = 0.96, 0.70  # Bustos, Vargas & Trujillo, CIARP 2016, in words


@dataclass(frozen=True)
class Rates:
    """Rates of a confusion, each NaN where its denominator is 0.

    Attributes:
        sensitivity: incorrect matches that are rejected / incorrect matches.
        specificity: correct matches that are kept / correct matches.
        ppv: incorrect matches that are rejected / rejected matches.
        npv: correct matches that are kept / kept matches.
        precision: the same as ``npv``, in the words of the field: of the kept matches, those that are correct.
        recall: the same as ``specificity``: of the correct matches, those that are kept.
        fraction_incorrect: incorrect matches / matches.
    """

    sensitivity: float
    specificity: float
    ppv: float
    npv: float
    precision: float
    recall: float
    fraction_incorrect: float


@dataclass(frozen=True)
class Confusion:
    """Counts of verdicts against ground truth; ``+`` merges two sets of matches exactly.

    Attributes:
        true_positive: incorrect and rejected.
        false_positive: correct and rejected.
        true_negative: correct and kept.
        false_negative: incorrect and kept.
        num_unknown: matches left out because ground truth is unknown.

    Example:
        >>> Confusion(true_positive=3, false_negative=1) + Confusion(true_negative=2)
        Confusion(true_positive=3, false_positive=0, true_negative=2, false_negative=1, num_unknown=0)
    """

    true_positive: int = 0
    false_positive: int = 0
    true_negative: int = 0
    false_negative: int = 0
    num_unknown: int = 0

    def __add__(self, other: Confusion) -> Confusion:
        return Confusion(*map(add, astuple(self), astuple(other)))

    @property
    def num_valid(self) -> int:
        return self.true_positive + self.false_positive + self.true_negative + self.false_negative

    def rates(self) -> Rates:
        """Rates of the counts, NaN where a denominator is 0."""
        precision = _ratio(self.true_negative, self.true_negative + self.false_negative)
        recall = _ratio(self.true_negative, self.true_negative + self.false_positive)
        return Rates(
            sensitivity=_ratio(self.true_positive, self.true_positive + self.false_negative),
            specificity=recall,
            ppv=_ratio(self.true_positive, self.true_positive + self.false_positive),
            npv=precision,
            precision=precision,
            recall=recall,
            fraction_incorrect=_ratio(self.true_positive + self.false_negative, self.num_valid),
        )


def confusion_update(inlier: Tensor, correct: Tensor, valid: Tensor) -> Confusion:
    """Count verdicts against ground truth.

    Args:
        inlier: (M,) bool, kept; untested matches are not, so they count as rejected.
        correct: (M,) bool; ignored where ground truth is unknown.
        valid: (M,) bool, ground truth is known.

    Returns:
        The counts; all 0 for no match.

    Raises:
        ValueError: if the lengths differ.
        TypeError: if a tensor is not boolean.

    Example:
        >>> kept, right = torch.tensor([True, False, True]), torch.tensor([True, False, False])
        >>> confusion_update(kept, right, torch.tensor([True, True, False]))
        Confusion(true_positive=1, false_positive=0, true_negative=1, false_negative=0, num_unknown=1)
    """
    _check_masks(len(inlier), inlier=inlier, correct=correct, valid=valid)
    cell = torch.where(valid, 2 * inlier.long() + correct.long(), 4)
    incorrect_rejected, correct_rejected, incorrect_kept, correct_kept, unknown = cell.bincount(minlength=5).tolist()
    return Confusion(incorrect_rejected, correct_rejected, correct_kept, incorrect_kept, unknown)


def match_rates(inlier: Tensor, correct: Tensor, valid: Tensor) -> Rates:
    """Rates of one set of verdicts, which :func:`confusion_update` describes.

    Example:
        >>> kept, right = torch.tensor([True, True]), torch.tensor([True, False])
        >>> match_rates(kept, right, torch.tensor([True, True])).npv
        0.5
    """
    return confusion_update(inlier, correct, valid).rates()


class MatchRates:
    """Rates of verdicts that arrive in parts; the same formulas as :func:`match_rates`.

    Example:
        >>> metric = MatchRates()
        >>> metric.update(torch.tensor([True]), torch.tensor([True]), torch.tensor([True]))
        >>> metric.update(torch.tensor([False]), torch.tensor([True]), torch.tensor([True]))
        >>> metric.compute().specificity
        0.5
    """

    def __init__(self) -> None:
        self.confusion = Confusion()

    def update(self, inlier: Tensor, correct: Tensor, valid: Tensor) -> None:
        """Add the verdicts of some matches; the arguments are those of :func:`confusion_update`."""
        self.confusion += confusion_update(inlier, correct, valid)

    def merge(self, other: MatchRates) -> None:
        """Add what another metric, perhaps of another process, has seen."""
        self.confusion += other.confusion

    def compute(self) -> Rates:
        """Rates of everything seen since the start or the last reset."""
        return self.confusion.rates()

    def reset(self) -> None:
        """Forget everything."""
        self.confusion = Confusion()


@dataclass(frozen=True, eq=False)
class ROC:
    """Operating points of a score, from rejecting nothing to rejecting everything.

    Attributes:
        threshold: (U + 1,) float64 ascending; a match is rejected iff its score is at most the threshold. The first
            row, -inf, stands for rejecting nothing.
        sensitivity: (U + 1,) float64 fraction of the incorrect matches rejected; NaN if there are none.
        specificity: (U + 1,) float64 fraction of the correct matches kept; NaN if there are none.
    """

    threshold: Tensor
    sensitivity: Tensor
    specificity: Tensor


@dataclass(frozen=True, eq=False)
class ScoreCounts:
    """How many correct and incorrect matches have each score; ``+`` merges two sets of matches exactly.

    Attributes:
        score: (U,) distinct scores, ascending, float64.
        num_correct: (U,) int64.
        num_incorrect: (U,) int64.
    """

    score: Tensor
    num_correct: Tensor
    num_incorrect: Tensor

    def __add__(self, other: ScoreCounts) -> ScoreCounts:
        score, row = torch.unique(torch.cat([self.score, other.score]), return_inverse=True)
        both = torch.cat([torch.stack([part.num_correct, part.num_incorrect], 1) for part in (self, other)])
        return ScoreCounts(score, *both.new_zeros(len(score), 2).index_add(0, row, both).unbind(1))

    def curve(self) -> ROC:
        """The ROC curve; see :func:`roc_curve`."""
        none = self.num_correct.new_zeros(1)
        rejected = torch.cat([none, self.num_incorrect.cumsum(0)]).double()
        lost = torch.cat([none, self.num_correct.cumsum(0)])
        kept = (lost[-1] - lost).double()
        threshold = torch.cat([self.score.new_full((1,), -math.inf), self.score])
        return ROC(threshold, rejected / rejected[-1], kept / kept[0])

    def auc(self) -> float:
        """The area under the ROC curve; see :func:`roc_auc`."""
        below = self.num_incorrect.cumsum(0) - self.num_incorrect
        # every correct match counts 2 for each incorrect one below it and 1 for each tie: an integer, hence exact
        doubled = int((self.num_correct * (2 * below + self.num_incorrect)).sum())
        return _ratio(doubled, 2 * int(self.num_correct.sum()) * int(self.num_incorrect.sum()))

    def specificity_at(self, sensitivity: float) -> float:
        """The specificity where the sensitivity is reached; see :func:`specificity_at_sensitivity`."""
        if not 0 <= sensitivity <= 1:
            raise ValueError(f"sensitivity must lie in 0..1, got {sensitivity}")
        num_correct, num_incorrect = int(self.num_correct.sum()), int(self.num_incorrect.sum())
        if not num_correct or not num_incorrect:
            return math.nan
        rejected = self.num_incorrect.cumsum(0)
        first = int((rejected < math.ceil(sensitivity * num_incorrect)).sum())
        return _ratio(num_correct - int(self.num_correct[: first + 1].sum()), num_correct)


def roc_update(score: Tensor, correct: Tensor, *, valid: Tensor | None = None) -> ScoreCounts:
    """Count correct and incorrect matches at each score.

    Args:
        score: (M,), higher is more likely correct; infinite values are allowed.
        correct: (M,) bool.
        valid: (M,) bool, ground truth is known; the others are left out. None: all are known.

    Returns:
        The counts, no rows for no match. No gradient.

    Raises:
        ValueError: if the lengths differ or a score is NaN.
        TypeError: if ``correct`` or ``valid`` is not boolean.

    Example:
        >>> roc_update(torch.tensor([0.5, 0.1, 0.5]), torch.tensor([True, False, False])).num_incorrect
        tensor([1, 1])
    """
    _check_masks(len(correct), correct=correct)
    check_vector("score", score, len(correct))
    if valid is not None:
        _check_masks(len(correct), valid=valid)
        score, correct = score[valid], correct[valid]
    score = score.detach().double()
    if bool(score.isnan().any()):
        raise ValueError(f"score must not be NaN, got {int(score.isnan().sum())} of {len(score)}")
    values, row = torch.unique(score, return_inverse=True)
    counts = torch.bincount(2 * row + correct.long(), minlength=2 * len(values)).view(-1, 2)
    return ScoreCounts(values, counts[:, 1], counts[:, 0])


def roc_curve(score: Tensor, correct: Tensor, *, valid: Tensor | None = None) -> ROC:
    """ROC curve of a score; equal scores are rejected together.

    The result has one operating point per distinct score, and one that rejects nothing. No gradient. Arguments and
    errors are those of :func:`roc_update`.

    Example:
        >>> roc_curve(torch.tensor([0.1, 0.9]), torch.tensor([False, True])).specificity
        tensor([1., 1., 0.], dtype=torch.float64)
    """
    return roc_update(score, correct, valid=valid).curve()


def roc_auc(score: Tensor, correct: Tensor, *, valid: Tensor | None = None) -> float:
    """Probability that a correct match scores higher than an incorrect one, ties counting one half.

    This is the area under the ROC curve; NaN if there is no correct or no incorrect match. No gradient. Arguments and
    errors are those of :func:`roc_update`.

    Example:
        >>> roc_auc(torch.tensor([0.1, 0.5, 0.5]), torch.tensor([False, True, False]))
        0.75
    """
    return roc_update(score, correct, valid=valid).auc()


def specificity_at_sensitivity(
    score: Tensor, correct: Tensor, sensitivity: float, *, valid: Tensor | None = None
) -> float:
    """Fraction of correct matches kept at the lowest threshold that rejects enough incorrect ones.

    The threshold is one of the scores, and everything up to it is rejected: equal scores go together, and even
    ``sensitivity=0`` rejects the lowest of them. ``sensitivity`` is the fraction of the incorrect matches to reject,
    0..1, else ValueError; the other arguments and errors are those of :func:`roc_update`. NaN if there is no correct or
    no incorrect match. No gradient.

    Example:
        >>> score, correct = torch.tensor([0.1, 0.2, 0.2, 0.7]), torch.tensor([False, False, True, True])
        >>> specificity_at_sensitivity(score, correct, 0.96)
        0.5
    """
    return roc_update(score, correct, valid=valid).specificity_at(sensitivity)


@dataclass(frozen=True)
class IsolatedCounts:
    """How many matches are the only one between their two objects; ``+`` merges two sets of matches exactly.

    Attributes:
        num_correct: correct matches.
        num_correct_isolated: correct matches that are alone between their two objects.
        num_incorrect: incorrect matches.
        num_incorrect_isolated: incorrect matches that are alone between their two objects.
        num_unknown: matches left out because ground truth is unknown.
    """

    num_correct: int = 0
    num_correct_isolated: int = 0
    num_incorrect: int = 0
    num_incorrect_isolated: int = 0
    num_unknown: int = 0

    def __add__(self, other: IsolatedCounts) -> IsolatedCounts:
        return IsolatedCounts(*map(add, astuple(self), astuple(other)))


def isolated_update(isolated: Tensor, correct: Tensor, valid: Tensor) -> IsolatedCounts:
    """Count the matches that join two objects alone: how far "the same 3D object" would go as evidence by itself.

    Args:
        isolated: (M,) bool from :func:`tensor_stereo.objects.isolated_matches`, over all matches: one whose ground
            truth is unknown accompanies another all the same.
        correct: (M,) bool; ignored where ground truth is unknown.
        valid: (M,) bool, ground truth is known.

    Returns:
        The counts; all 0 for no match. Raises what :func:`confusion_update` raises.

    Example:
        >>> alone, right = torch.tensor([True, False, True]), torch.tensor([False, True, True])
        >>> isolated_update(alone, right, torch.tensor([True, True, False])).num_incorrect_isolated
        1
    """
    _check_masks(len(correct), isolated=isolated)
    counts = confusion_update(~isolated, correct, valid)  # isolated plays the part of rejected
    return IsolatedCounts(
        num_correct=counts.false_positive + counts.true_negative,
        num_correct_isolated=counts.false_positive,
        num_incorrect=counts.true_positive + counts.false_negative,
        num_incorrect_isolated=counts.true_positive,
        num_unknown=counts.num_unknown,
    )


def _ratio(numerator: int, denominator: int) -> float:
    return numerator / denominator if denominator else math.nan


def _check_masks(num_matches: int, **masks: Tensor) -> None:
    for name, mask in masks.items():
        check_vector(name, mask, num_matches)
        check_mask(name, mask)
