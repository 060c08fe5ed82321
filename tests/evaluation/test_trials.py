from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from tensor_stereo import ops
from tensor_stereo.configs import (
    SCORES,
    VERDICTS,
    ConsensusConfig,
    FASTConfig,
    MatchingConfig,
    Score,
    ScoreName,
    SGBMConfig,
    SIFTConfig,
    TrialConfig,
    Verdict,
)
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tensor_stereo.evaluation import trials
from tensor_stereo.evaluation.metrics import roc_auc, specificity_at_sensitivity
from tensor_stereo.evaluation.rows import ROW_SCHEMA, SCORE_BINS, STAGES, stage_keys
from tensor_stereo.evaluation.trials import TrialRunner
from tensor_stereo.evaluation.truth import matches_against_gt
from tensor_stereo.modules import DelaunayFilter
from tensor_stereo.ops import backends
from tensor_stereo.pipeline import map_pairs, run_pipeline, score_pairs
from tensor_stereo.scores.domain import DomainWarning
from tensor_stereo.scores.image_evidence import measure_images

PAIR = render_pair(0)
PAPER = TrialConfig(verdict="cardinality")  # no score
TOPOLOGY = TrialConfig(verdict="cardinality", score="topology")
CONSENSUS = TrialConfig(score="consensus")
DENSE = TrialConfig(verdict="cardinality", matching=MatchingConfig(method="sgbm"))
TRIALS = [
    TrialConfig(),
    TOPOLOGY,
    TrialConfig(score="topology", threshold=0.4),
    TrialConfig(constrained=True, verdict="adjacency"),
    replace(TOPOLOGY, outlier_rate=0.3, noise_px=0.2, seed=4),
    TrialConfig(detector="gftt", verdict="cardinality", score="none"),
    replace(TOPOLOGY, matching=MatchingConfig(max_row_offset_px=1.0), temperature=0.5, temperature_unit="px"),
    CONSENSUS,
    replace(CONSENSUS, consensus=ConsensusConfig(slope=1.0), min_precision=0.95),
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
@pytest.mark.parametrize(("verdict", "score"), [("adjacency", "topology"), ("score", "auto")])
def test_a_trial_is_the_pipeline(verdict: Verdict, score: ScoreName, constrained: bool) -> None:
    trial = TrialConfig(constrained=constrained, verdict=verdict, score=score, min_group_size=2)
    found, expected = TrialRunner(PAIR).run(trial), run_pipeline([(PAIR.image0, PAIR.image1)], trial)
    assert torch.equal(found.matches.keypoints1, expected.matches.keypoints1)
    assert torch.equal(found.classification.inlier, expected.classification.inlier)
    images = {} if verdict == "adjacency" else {"images0": [PAIR.image0], "images1": [PAIR.image1]}
    module = DelaunayFilter(verdict=verdict, score=score, min_group_size=2)(found.matches, **images)
    assert torch.equal(found.score, module.score)
    assert torch.equal(found.classification.inlier, module.inlier)
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


@pytest.mark.parametrize(
    ("settings", "least"),
    [
        ({"score": "topology", "threshold": 0.4}, 0.4),
        ({"score": "consensus", "threshold": 0.9}, 0.9),
        ({"score": "consensus"}, 0.5),
        ({}, 0.5),  # learned
    ],
)
def test_the_verdict_of_the_score_asks_no_set_test(settings: dict[str, Any], least: float) -> None:
    runner, trial = TrialRunner(PAIR), TrialConfig(**settings)
    by_set = runner.run(replace(trial, verdict="cardinality", score=trial.resolved_score, threshold=None))
    by_score = runner.run(trial)
    tested = by_set.classification.relation != 0
    assert torch.equal(by_score.score, by_set.score)
    assert torch.equal(by_score.classification.inlier, tested & (by_set.score >= least))
    assert torch.equal(by_set.classification.inlier, by_set.classification.inlier_of("cardinality"))
    assert not torch.equal(by_score.classification.inlier, by_set.classification.inlier)


@pytest.mark.parametrize("score", SCORES)
def test_rows_count_scores_in_bins_that_hold_every_valid_match(score: Score) -> None:
    trial = TrialRunner(PAIR).run(TrialConfig(verdict="cardinality", score=score, outlier_rate=0.2))
    row = trial.row()
    correct, incorrect = row["score_counts_correct"], row["score_counts_incorrect"]
    assert len(correct) == len(incorrect) == SCORE_BINS
    assert sum(correct) == row["true_negative"] + row["false_positive"]
    assert sum(incorrect) == row["true_positive"] + row["false_negative"]
    assert row["auc"] == roc_auc(trial.score, trial.correct, valid=trial.valid)
    at = specificity_at_sensitivity(trial.score, trial.correct, 0.96, valid=trial.valid)
    assert row["specificity_at_sensitivity_96"] == at


def test_injected_outliers_are_incorrect_and_seeded_by_pair_and_seed() -> None:
    rates = [
        TrialRunner(PAIR).run(replace(PAPER, outlier_rate=rate)).row()["fraction_incorrect"] for rate in (0, 0.5, 1)
    ]
    assert rates[0] < rates[1] < rates[2]
    assert rates[2] > 0.9
    moved = [
        TrialRunner(pair).run(replace(PAPER, outlier_rate=0.5, seed=seed)).matches.keypoints1
        for pair, seed in ((PAIR, 0), (PAIR, 1), (replace(PAIR, name="other"), 0), (PAIR, 0))
    ]
    assert torch.equal(moved[0], moved[3])
    assert not torch.equal(moved[0], moved[1])
    assert not torch.equal(moved[0], moved[2])


def test_no_ground_truth_leaves_rates_open() -> None:
    runner = TrialRunner(replace(PAIR, disparity_gt=None))
    for trial in (TOPOLOGY, CONSENSUS):
        row = runner.run(trial).row()
        assert row["num_valid"] == 0 < row["num_matches"]
        assert math.isnan(row["sensitivity"])
        assert math.isnan(row["auc"])


def test_rows_name_the_settings_of_the_score_that_ran_and_leave_the_others_null() -> None:
    runner = TrialRunner(PAIR)
    columns = {f"consensus_{name}": value for name, value in vars(ConsensusConfig(slope=0.3)).items()}
    assert len(columns) == 9
    for score, trial in (("none", PAPER), ("topology", TOPOLOGY), ("consensus", CONSENSUS), ("learned", TrialConfig())):
        row = runner.run(replace(trial, consensus=ConsensusConfig(slope=0.3))).row()
        assert (row["verdict"], row["score"]) == (trial.verdict, score)
        assert row["temperature"] == (1.0 if score == "topology" else None)
        assert {name: row[name] for name in columns} == (columns if score == "consensus" else dict.fromkeys(columns))


def test_a_semi_global_map_is_shared_and_its_settings_stand_in_the_rows() -> None:
    runner = TrialRunner(PAIR)
    found = [runner.run(replace(DENSE, detector=name, verdict=verdict)) for name in ("fast", "gftt")
             for verdict in ("adjacency", "cardinality")]  # fmt: skip
    assert found[0].matches is found[1].matches
    assert found[2].matches is found[3].matches
    for trial in found:
        alone = run_pipeline([(PAIR.image0, PAIR.image1)], trial.config).matches
        for name in ("keypoints0", "keypoints1", "cost"):
            assert torch.equal(getattr(trial.matches, name), getattr(alone, name)), name
        assert trial.seconds.keys() == set(STAGES)
        assert trial.seconds["match"] > 0
    dense, sparse = found[0].row(), runner.run(TOPOLOGY).row()
    assert (dense["method"], sparse["method"]) == ("sgbm", "ssd")
    columns = {f"sgbm_{name}": value for name, value in vars(SGBMConfig()).items()}
    assert {name: dense[name] for name in columns} == columns
    assert {name: sparse[name] for name in columns} == dict.fromkeys(columns)
    assert (dense["window_px"], sparse["window_px"]) == (None, 11)
    assert dense.keys() <= ROW_SCHEMA.keys()
    calls = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trials, "map_pairs", lambda *arguments: calls.append(0) or map_pairs(*arguments))
        other = TrialRunner(PAIR)
        for trial in found:
            other.run(trial.config)
        other.run(replace(DENSE, sgbm=SGBMConfig(mode="hh")))
    assert len(calls) == 2


@pytest.mark.parametrize(
    ("trial", "change", "first"),
    [
        (TOPOLOGY, {"fast": FASTConfig(window_px=9)}, "detect"),
        (TOPOLOGY, {"sift": SIFTConfig(max_keypoints=9)}, None),
        (TOPOLOGY, {"matching": MatchingConfig(mutual=True)}, "match"),
        (TOPOLOGY, {"matching": MatchingConfig(method="sgbm")}, "match"),
        (TOPOLOGY, {"sgbm": SGBMConfig(window_px=3)}, None),
        (DENSE, {"sgbm": SGBMConfig(window_px=3)}, "match"),
        (DENSE, {"matching": MatchingConfig(method="sgbm", max_disparity_px=20.0)}, "match"),
        (TOPOLOGY, {"backend": "scipy"}, "match"),
        (PAPER, {"backend": "scipy"}, "match"),
        (TOPOLOGY, {"max_error_px": 2.0}, None),
        (TrialConfig(), {"max_error_px": 2.0}, None),
        (TOPOLOGY, {"constrained": True}, "group"),
        (TOPOLOGY, {"tie_tolerance": 0.0}, "graph"),
        (TOPOLOGY, {"score": "learned"}, "score"),
        (PAPER, {"score": "topology"}, "score"),
        (TOPOLOGY, {"temperature": 2.0}, "score"),
        (TOPOLOGY, {"temperature_unit": "px"}, "score"),
        (CONSENSUS, {"temperature": 2.0}, None),
        *((CONSENSUS, {"consensus": replace(CONSENSUS.consensus, **{name: 3})}, "score")
          for name in vars(CONSENSUS.consensus)),
        (TOPOLOGY, {"consensus": ConsensusConfig(slope=0.5)}, None),
        (TrialConfig(), {"consensus": ConsensusConfig(slope=0.5)}, None),
        (TrialConfig(), {"rectified": False}, "score"),
        (CONSENSUS, {"rectified": "auto"}, "score"),
        (TOPOLOGY, {"rectified": "auto"}, None),
        (PAPER, {"rectified": False}, None),
        (TrialConfig(), {"score": "learned"}, None),  # as auto is
        (TrialConfig(score="topology", threshold=0.4), {"threshold": 0.5}, None),
        (TrialConfig(), {"threshold": 0.5}, None),
        (TrialConfig(), {"min_precision": 0.5}, None),
        (TrialConfig(), {"target_sensitivity": 0.5}, None),
        (TOPOLOGY, {"verdict": "score", "threshold": 0.5}, None),
        (TOPOLOGY, {"verdict": "adjacency"}, "relate"),
        (TOPOLOGY, {"min_group_size": 7}, "relate"),
    ],
)  # fmt: skip
def test_a_setting_changes_the_stages_from_its_own_on(
    trial: TrialConfig, change: dict[str, object], first: str | None
) -> None:
    before, after = stage_keys(trial), stage_keys(replace(trial, **change))
    assert before["improve"] is after["improve"] is None  # not asked for
    changed = [stage for stage in STAGES if before[stage] != after[stage]]
    after_first = [] if first is None else list(STAGES[STAGES.index(first) : -1])
    if first == "relate":
        after_first.remove("score")  # the score knows no restriction and no least group
    assert changed == after_first


@pytest.mark.parametrize(
    "change",
    [
        {"refine": True},
        {"repair": True, "refine": False},
        {"threshold": 0.3},
        {"max_error_px": 2.0},
        {"verdict": "adjacency"},
    ],
)
def test_what_is_repaired_depends_on_all_that_decides(change: dict[str, object]) -> None:
    trial = TrialConfig(repair=change.get("repair") is None, score="consensus")
    before, after = stage_keys(trial), stage_keys(replace(trial, **change))
    assert before["score"] == after["score"]
    assert before["improve"] != after["improve"]


def test_all_verdicts_share_features_matches_graphs_and_score() -> None:
    trials = [TrialConfig(verdict=name, score="consensus") for name in VERDICTS]
    keys = [stage_keys(trial) for trial in trials]
    for stage in STAGES:
        assert len({key[stage] for key in keys}) == (2 if stage == "relate" else 1), stage
    defaults = [stage_keys(TrialConfig(verdict=name)) for name in VERDICTS]
    for stage in STAGES[: STAGES.index("graph") + 1]:
        assert len({key[stage] for key in defaults}) == 1, stage
    runner = TrialRunner(PAIR)
    found = [runner.run(trial) for trial in trials]
    for other in found[1:]:
        assert other.matches is found[0].matches
        assert other.graphs is found[0].graphs
        assert other.seconds["score"] == found[0].seconds["score"] > 0
    for trial in found:
        by_score = trial.config.verdict == "score"
        relation = trial.classification.relation
        kept = (
            (relation != 0) & (trial.score >= 0.5) if by_score else trial.classification.inlier_of(trial.config.verdict)
        )
        assert torch.equal(trial.classification.inlier, kept)
    kept_counts = {int(trial.classification.inlier.sum()) for trial in found}
    assert len(kept_counts) == 3


@pytest.mark.parametrize("score", SCORES)
def test_no_stage_asks_for_another_back_end_than_that_of_the_settings(
    score: Score, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, set[str]] = {}
    runner, resolve = TrialRunner(PAIR), backends.resolve_backend

    def note(backend: str) -> str:
        asked.setdefault(runner.stage, set()).add(backend)
        return resolve(backend)

    monkeypatch.setattr(backends, "resolve_backend", note)
    monkeypatch.setattr(ops, "resolve_backend", note)
    gates = MatchingConfig(max_row_offset_px=1.0)  # searched by a kernel
    runner.run(TrialConfig(verdict="cardinality", score=score, matching=gates, backend="scipy"))
    assert asked.keys() == {"match", "graph", "relate", "score"}
    assert set.union(*asked.values()) == {"scipy"}


def test_settings_of_consensus_reach_its_score() -> None:
    runner = TrialRunner(PAIR)
    plain = runner.run(CONSENSUS)
    changed = runner.run(replace(CONSENSUS, consensus=ConsensusConfig(slope=3.0)))
    assert changed.graphs is plain.graphs
    expected = DelaunayFilter(score="consensus", consensus=ConsensusConfig(slope=3.0))(plain.matches)
    assert torch.equal(changed.score, expected.score)
    assert not torch.equal(changed.score, plain.score)


def test_the_ratio_of_sift_belongs_to_the_matcher() -> None:
    before = stage_keys(TrialConfig(detector="sift"))
    after = stage_keys(TrialConfig(detector="sift", sift=SIFTConfig(max_ratio=0.6)))
    assert before["detect"] == after["detect"]
    assert before["match"] != after["match"]


@pytest.mark.parametrize("score", ["learned", "consensus", "none"])
def test_tolerances_share_matches_graphs_and_score(score: ScoreName, monkeypatch: pytest.MonkeyPatch) -> None:
    """One forward pass; rates, verdicts and scores are those of each tolerance alone."""
    verdict: Verdict = "cardinality" if score == "none" else "score"
    settings = [TrialConfig(verdict=verdict, score=score, max_error_px=px) for px in (1.0, 0.5, 3.0, 5.0)]
    expected = [TrialRunner(PAIR).run(trial) for trial in settings]
    passes = []
    monkeypatch.setattr(trials, "score_pairs", lambda *given: passes.append(0) or score_pairs(*given))
    runner = TrialRunner(PAIR)
    found = [runner.run(trial) for trial in settings]
    assert len(passes) == (score != "none")
    for shared, alone in zip(found, expected, strict=True):
        assert shared.graphs is found[0].graphs
        assert torch.equal(shared.correct, alone.correct)
        assert torch.equal(shared.classification.inlier, alone.classification.inlier)
        truth, _ = matches_against_gt(shared.matches, [PAIR.disparity_gt], max_error_px=shared.config.max_error_px)
        assert torch.equal(shared.correct, truth)
        if score != "none":
            images = [(PAIR.image0, PAIR.image1)]
            assert torch.equal(shared.score, alone.score)
            assert torch.equal(shared.score, run_pipeline(images, shared.config).score)
        row = shared.row()
        assert row["max_error_px"] == shared.config.max_error_px
        assert row["domain"] == (None if score == "none" else "")
    counts = [int(trial.correct.sum()) for trial in found]
    assert counts[1] < counts[0] < counts[2] <= counts[3]


def test_a_pair_outside_of_the_domain_says_so_in_its_row() -> None:
    trial = TrialConfig(outlier_rate=1.0)
    with pytest.warns(DomainWarning, match="those of pair 0 hardly do"):
        assert TrialRunner(PAIR).run(trial).row()["domain"] == "agreement"


@pytest.mark.parametrize("rectified", [True, False, "auto"])
def test_a_row_says_what_the_pair_was_taken_for(rectified: Any) -> None:
    runner = TrialRunner(PAIR)
    for score in ("learned", "consensus"):
        trial = runner.run(TrialConfig(score=score, rectified=rectified))
        row = trial.row()
        assert row["rectified"] == str(rectified).lower()
        assert row["is_rectified"] is trial.is_rectified is (rectified is not False)
        output = run_pipeline([(PAIR.image0, PAIR.image1)], trial.config)
        assert torch.equal(trial.score, output.score)
        assert row["is_rectified"] == output.alignment.rectified.item()
    for config in (PAPER, TOPOLOGY):
        row = runner.run(replace(config, rectified=rectified)).row()
        assert row["rectified"] is row["is_rectified"] is None
