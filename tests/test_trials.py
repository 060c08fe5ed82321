from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from tensor_stereo.configs import SCORES, FASTConfig, MatchingConfig, Score, SIFTConfig, TrialConfig
from tensor_stereo.datasets.synthetic import render_pair
from tensor_stereo.metrics import roc_auc, specificity_at_sensitivity
from tensor_stereo.modules import DelaunayFilter
from tensor_stereo.pipeline import run_pipeline
from tensor_stereo.scores.evidence import measure_images
from tensor_stereo.trials import SCORE_BINS, STAGES, TrialRunner, stage_keys

PAIR = render_pair(0)
TRIALS = [
    TrialConfig(),
    TrialConfig(threshold=0.4),
    TrialConfig(constrained=True, restriction="adjacency"),
    TrialConfig(outlier_rate=0.3, noise_px=0.2, seed=4),
    TrialConfig(detector="gftt", score="none"),
    TrialConfig(matching=MatchingConfig(max_row_offset_px=1.0), temperature=0.5, temperature_unit="px"),
]


def test_trials_give_the_same_alone_and_after_others() -> None:
    runner = TrialRunner(PAIR)
    for trial in [*TRIALS, *reversed(TRIALS)]:
        shared, alone = runner.run(trial).row(), TrialRunner(PAIR).run(trial).row()
        assert shared.keys() == alone.keys()
        for name in shared.keys() - {"seconds"}:
            same = shared[name] == alone[name] or (shared[name] != shared[name] and alone[name] != alone[name])
            assert same, name


@pytest.mark.parametrize("constrained", [False, True])
def test_a_trial_is_the_pipeline(constrained: bool) -> None:
    trial = TrialConfig(constrained=constrained, restriction="adjacency", min_group_size=2)
    found, expected = TrialRunner(PAIR).run(trial), run_pipeline([(PAIR.image0, PAIR.image1)], trial)
    assert torch.equal(found.matches.keypoints1, expected.matches.keypoints1)
    assert torch.equal(found.classification.inlier, expected.classification.inlier)
    score = DelaunayFilter(restriction="adjacency", min_group_size=2)(found.matches).score
    assert torch.equal(found.score, score)
    assert torch.equal(found.score, expected.score)


@pytest.mark.parametrize("constrained", [False, True])
@pytest.mark.parametrize("score", SCORES)
def test_the_score_is_that_of_the_module(score: Score, constrained: bool) -> None:
    trial = TrialConfig(score=score, constrained=constrained, temperature=0.5, min_group_size=6, threshold=0.3)
    found = TrialRunner(PAIR).run(trial)
    evidence = None
    if score == "learned":
        evidence = measure_images([PAIR.image0], [PAIR.image1], found.matches, found.graphs)
    module = DelaunayFilter(score=score, temperature=0.5, min_group_size=6, threshold=0.3)
    expected = module(found.matches, evidence=evidence)
    assert torch.equal(found.score, expected.score)
    assert torch.equal(found.classification.inlier, expected.inlier)
    assert 0 < found.classification.inlier.sum() < found.matches.num_matches


def test_a_threshold_replaces_the_restriction() -> None:
    plain, by_score = TrialRunner(PAIR).run(TrialConfig()), TrialRunner(PAIR).run(TrialConfig(threshold=0.4))
    tested = plain.classification.relation != 0
    assert torch.equal(by_score.classification.inlier, tested & (plain.score >= 0.4))
    assert not torch.equal(by_score.classification.inlier, plain.classification.inlier)


def test_rows_count_scores_in_bins_that_hold_every_valid_match() -> None:
    trial = TrialRunner(PAIR).run(TrialConfig(outlier_rate=0.2))
    row = trial.row()
    correct, incorrect = row["score_counts_correct"], row["score_counts_incorrect"]
    assert len(correct) == len(incorrect) == SCORE_BINS
    assert sum(correct) == row["true_negative"] + row["false_positive"]
    assert sum(incorrect) == row["true_positive"] + row["false_negative"]
    assert row["auc"] == roc_auc(trial.score, trial.correct, valid=trial.valid)
    at = specificity_at_sensitivity(trial.score, trial.correct, 0.96, valid=trial.valid)
    assert row["specificity_at_sensitivity_96"] == at


def test_injected_outliers_are_incorrect_and_seeded_by_pair_and_seed() -> None:
    rates = [TrialRunner(PAIR).run(TrialConfig(outlier_rate=rate)).row()["fraction_incorrect"] for rate in (0, 0.5, 1)]
    assert rates[0] < rates[1] < rates[2]
    assert rates[2] > 0.9
    moved = [
        TrialRunner(pair).run(TrialConfig(outlier_rate=0.5, seed=seed)).matches.keypoints1
        for pair, seed in ((PAIR, 0), (PAIR, 1), (replace(PAIR, name="other"), 0), (PAIR, 0))
    ]
    assert torch.equal(moved[0], moved[3])
    assert not torch.equal(moved[0], moved[1])
    assert not torch.equal(moved[0], moved[2])


def test_no_ground_truth_leaves_rates_open() -> None:
    row = TrialRunner(replace(PAIR, disparity_gt=None)).run(TrialConfig()).row()
    assert row["num_valid"] == 0 < row["num_matches"]
    assert math.isnan(row["sensitivity"])
    assert math.isnan(row["auc"])


@pytest.mark.parametrize(
    ("change", "first"),
    [
        ({"fast": FASTConfig(window_px=9)}, "detect"),
        ({"sift": SIFTConfig(max_keypoints=9)}, None),
        ({"matching": MatchingConfig(mutual=True)}, "match"),
        ({"max_error_px": 2.0}, "perturb"),
        ({"constrained": True}, "group"),
        ({"tie_tolerance": 0.0}, "graph"),
        ({"score": "learned"}, "score"),
        ({"threshold": 0.5}, None),
        ({"min_precision": 0.5}, None),
        ({"min_group_size": 7}, "relate"),
    ],
)
def test_a_setting_changes_the_stages_from_its_own_on(change: dict[str, object], first: str | None) -> None:
    before, after = stage_keys(TrialConfig()), stage_keys(replace(TrialConfig(), **change))
    changed = [stage for stage in STAGES if before[stage] != after[stage]]
    after_first = [] if first is None else list(STAGES[STAGES.index(first) :])
    if first == "relate":
        after_first.remove("score")  # the score knows no restriction and no least group
    assert changed == after_first


def test_the_ratio_of_sift_belongs_to_the_matcher() -> None:
    before = stage_keys(TrialConfig(detector="sift"))
    after = stage_keys(TrialConfig(detector="sift", sift=SIFTConfig(max_ratio=0.6)))
    assert before["detect"] == after["detect"]
    assert before["match"] != after["match"]
