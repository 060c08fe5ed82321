from __future__ import annotations

import math
from functools import reduce
from operator import add

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo.evaluation.metrics import (
    Confusion,
    IsolatedCounts,
    MatchRates,
    confusion_update,
    isolated_update,
    match_rates,
    roc_auc,
    roc_curve,
    roc_update,
    specificity_at_sensitivity,
)

# few distinct values, so that ties are the normal case
scored = st.lists(st.tuples(st.sampled_from([-math.inf, -1.0, -0.0, 0.0, 0.25, 3.0, math.inf]), st.booleans()))
verdicts = st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans()))


def columns(rows: list, dtypes: tuple[torch.dtype, ...]) -> list[torch.Tensor]:
    return [torch.tensor([row[k] for row in rows], dtype=dtype) for k, dtype in enumerate(dtypes)]


def scores_of(rows: list) -> list[torch.Tensor]:
    return columns(rows, (torch.float32, torch.bool))


def masks_of(rows: list) -> list[torch.Tensor]:
    return columns(rows, (torch.bool,) * 3)


def same(a: float, b: float) -> bool:
    return a == b or (math.isnan(a) and math.isnan(b))


def brute_auc(rows: list) -> float:
    good = [score for score, correct in rows if correct]
    bad = [score for score, correct in rows if not correct]
    if not good or not bad:
        return math.nan
    return sum((g > b) + 0.5 * (g == b) for g in good for b in bad) / (len(good) * len(bad))


def brute_specificity(rows: list, sensitivity: float) -> float:
    num_bad = sum(not correct for _, correct in rows)
    num_good = len(rows) - num_bad
    for threshold in sorted({score for score, _ in rows}):
        rejected = sum(score <= threshold and not correct for score, correct in rows)
        if rejected >= sensitivity * num_bad and num_bad and num_good:
            return sum(score > threshold and correct for score, correct in rows) / num_good
    return math.nan


@given(verdicts)
def test_confusion_counts_incorrect_as_positive(rows: list) -> None:
    known = [(kept, correct) for kept, correct, valid in rows if valid]
    assert confusion_update(*masks_of(rows)) == Confusion(
        true_positive=known.count((False, False)),
        false_positive=known.count((False, True)),
        true_negative=known.count((True, True)),
        false_negative=known.count((True, False)),
        num_unknown=len(rows) - len(known),
    )


def test_rates_follow_their_definitions() -> None:
    rates = Confusion(true_positive=6, false_positive=3, true_negative=9, false_negative=2, num_unknown=50).rates()
    assert rates.sensitivity == 6 / 8
    assert rates.specificity == 9 / 12
    assert rates.ppv == 6 / 9
    assert rates.npv == 9 / 11
    assert rates.fraction_incorrect == 8 / 20


def test_rates_of_nothing_are_nan() -> None:
    rates = Confusion(num_unknown=3).rates()
    assert all(math.isnan(value) for value in vars(rates).values())


@given(st.lists(verdicts, max_size=4))
def test_parts_merge_to_the_whole(parts: list[list]) -> None:
    whole = masks_of([row for part in parts for row in part])
    assert reduce(add, [confusion_update(*masks_of(part)) for part in parts], Confusion()) == confusion_update(*whole)
    isolated = [isolated_update(*masks_of(part)) for part in parts]
    assert reduce(add, isolated, IsolatedCounts()) == isolated_update(*whole)
    metric, other = MatchRates(), MatchRates()
    for index, part in enumerate(parts):
        (metric if index % 2 else other).update(*masks_of(part))
    metric.merge(other)
    for name, value in vars(match_rates(*whole)).items():
        assert same(getattr(metric.compute(), name), value)
    metric.reset()
    assert metric.confusion == Confusion()


def test_confusion_names_what_is_wrong() -> None:
    mask = torch.zeros(3, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"valid must have shape \(3,\)"):
        confusion_update(mask, mask, mask[:2])
    with pytest.raises(TypeError, match="correct must be bool"):
        confusion_update(mask, mask.long(), mask)
    with pytest.raises(TypeError, match="isolated must be bool"):
        isolated_update(mask.long(), mask, mask)


@given(verdicts)
def test_isolated_counts_agree_with_python(rows: list) -> None:
    known = [(isolated, correct) for isolated, correct, valid in rows if valid]
    assert isolated_update(*masks_of(rows)) == IsolatedCounts(
        num_correct=sum(correct for _, correct in known),
        num_correct_isolated=known.count((True, True)),
        num_incorrect=sum(not correct for _, correct in known),
        num_incorrect_isolated=known.count((True, False)),
        num_unknown=len(rows) - len(known),
    )


@given(scored)
def test_auc_is_the_fraction_of_ordered_pairs(rows: list) -> None:
    assert same(roc_auc(*scores_of(rows)), brute_auc(rows))


@given(scored)
def test_auc_of_the_reversed_score_is_the_complement(rows: list) -> None:
    score, correct = scores_of(rows)
    # abs: each side is one correctly rounded quotient below 1
    assert 1 - roc_auc(-score, correct) == pytest.approx(roc_auc(score, correct), rel=0, abs=2**-52, nan_ok=True)


@given(scored, st.sampled_from([0.0, 0.3, 0.5, 0.9, 0.96, 1.0]))
def test_specificity_is_read_at_the_first_sufficient_threshold(rows: list, sensitivity: float) -> None:
    assert same(specificity_at_sensitivity(*scores_of(rows), sensitivity), brute_specificity(rows, sensitivity))


@given(scored, st.sampled_from([0.0, 0.5, 0.96]))
def test_monotone_transform_changes_nothing(rows: list, sensitivity: float) -> None:
    score, correct = scores_of(rows)
    for changed in (score * 4 - 1, torch.atan(score)):
        assert same(roc_auc(changed, correct), roc_auc(score, correct))
        assert same(
            specificity_at_sensitivity(changed, correct, sensitivity),
            specificity_at_sensitivity(score, correct, sensitivity),
        )


@given(scored, scored)
def test_score_counts_merge_to_the_whole(part: list, other: list) -> None:
    merged, whole = roc_update(*scores_of(part)) + roc_update(*scores_of(other)), roc_update(*scores_of(part + other))
    assert torch.equal(merged.score, whole.score)
    assert torch.equal(merged.num_correct, whole.num_correct)
    assert torch.equal(merged.num_incorrect, whole.num_incorrect)


@given(scored)
def test_curve_counts_what_each_threshold_rejects(rows: list) -> None:
    curve = roc_curve(*scores_of(rows))
    num_good = sum(correct for _, correct in rows)
    num_bad = len(rows) - num_good
    assert curve.threshold.tolist() == [-math.inf, *sorted({score for score, _ in rows})]
    for row, threshold in enumerate(curve.threshold.tolist()):
        rejected = [correct for score, correct in rows if row and score <= threshold]
        assert same(curve.sensitivity[row].item(), rejected.count(False) / num_bad if num_bad else math.nan)
        kept = num_good - rejected.count(True)
        assert same(curve.specificity[row].item(), kept / num_good if num_good else math.nan)
    if num_good and num_bad:
        area = torch.trapezoid(curve.sensitivity, 1 - curve.specificity).item()
        assert area == pytest.approx(brute_auc(rows), abs=1e-14)  # a sum of rounded products


@given(st.lists(st.tuples(st.sampled_from([0.0, 1.0, 2.0]), st.booleans(), st.booleans())))
def test_matches_without_ground_truth_are_left_out_of_the_curve(rows: list) -> None:
    score, correct, valid = columns(rows, (torch.float64, torch.bool, torch.bool))
    known = [(s, c) for s, c, v in rows if v]
    assert same(roc_auc(score, correct, valid=valid), brute_auc(known))
    assert same(specificity_at_sensitivity(score, correct, 0.9, valid=valid), brute_specificity(known, 0.9))
    assert len(roc_curve(score, correct, valid=valid).threshold) == len({s for s, _ in known}) + 1


def test_auc_is_exact_for_many_matches() -> None:
    generator = torch.Generator().manual_seed(0)
    score, correct = torch.rand(20_001, generator=generator), torch.rand(20_001, generator=generator) < 0.3
    score = (score * 500).floor()
    good, bad = score[correct].long(), score[~correct].long()
    histogram = torch.bincount(bad, minlength=501)
    below = histogram.cumsum(0) - histogram
    doubled = int((2 * below[good] + histogram[good]).sum())
    assert roc_auc(score, correct) == doubled / (2 * len(good) * len(bad))


def test_score_errors_name_what_is_wrong() -> None:
    correct = torch.tensor([True, False])
    with pytest.raises(ValueError, match="score must not be NaN, got 1 of 2"):
        roc_auc(torch.tensor([math.nan, 0.0]), correct)
    with pytest.raises(ValueError, match="score must have shape"):
        roc_auc(torch.zeros(3), correct)
    with pytest.raises(TypeError, match="correct must be bool"):
        roc_auc(torch.zeros(2), correct.long())
    with pytest.raises(ValueError, match="sensitivity must lie in"):
        specificity_at_sensitivity(torch.zeros(2), correct, 96)


def test_scores_have_no_gradient() -> None:
    score = torch.tensor([0.1, 0.9], requires_grad=True)
    assert not roc_curve(score, torch.tensor([False, True])).sensitivity.requires_grad
