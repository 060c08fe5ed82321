from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
import torch

from tensor_stereo.configs import RESTRICTIONS, EvaluationConfig, SweepConfig, TrialConfig, Verdict
from tensor_stereo.datasets import PairDataset, find_pairs
from tensor_stereo.datasets.synthetic.rendering import SyntheticDataset
from tensor_stereo.evaluation.dataset import evaluate_pair, score_dataset
from tensor_stereo.evaluation.rows import ROW_SCHEMA, STAGES
from tensor_stereo.reports.tables import RATES, rates_table
from tests.test_pipeline import EIGHT

FAST = EvaluationConfig(detectors=("fast",))
PAPER = EvaluationConfig(detectors=("fast",), verdict="cardinality", score="none")
FOUR = [(variant, name) for variant in ("unconstrained", "constrained") for name in RESTRICTIONS]


@pytest.fixture(scope="module")
def table() -> pl.DataFrame:
    return score_dataset(SyntheticDataset(2), FAST)


@pytest.fixture(scope="module")
def paper() -> pl.DataFrame:
    return score_dataset(SyntheticDataset(2), PAPER)


def test_one_row_per_scene_detector_variant_and_verdict(table: pl.DataFrame, paper: pl.DataFrame) -> None:
    for rows, expected in ((table, [("unconstrained", "score"), *FOUR]), (paper, FOUR)):
        keys = rows.select("scene", "detector", "variant", "verdict")
        assert keys.height == keys.unique().height == 2 * 1 * len(expected)
        for (_, detector), of_scene in rows.group_by("scene", "detector", maintain_order=True):
            assert detector == "fast"
            assert of_scene.select("variant", "verdict").rows() == expected
    assert table.filter(verdict="score")["score"].unique().to_list() == ["learned"]
    assert table.filter(pl.col("verdict") != "score")["score"].unique().to_list() == ["none"]
    assert table.schema == pl.Schema(ROW_SCHEMA)
    assert [f.name for f in table.schema["seconds"].fields] == list(STAGES)  # type: ignore[attr-defined]


def test_restriction_1_rejects_all_that_restriction_2_rejects(paper: pl.DataFrame) -> None:
    wide = paper.pivot("verdict", index=["scene", "variant"], values=["sensitivity", "specificity"])
    assert len(wide) == 2 * 2
    assert (wide["sensitivity_adjacency"] >= wide["sensitivity_cardinality"]).all()
    assert (wide["specificity_adjacency"] <= wide["specificity_cardinality"]).all()


@pytest.mark.parametrize("restriction", RESTRICTIONS)
def test_the_verdict_of_the_score_changes_no_number_of_the_paper(
    table: pl.DataFrame, paper: pl.DataFrame, restriction: Verdict
) -> None:
    """All but the wall times, in the records and in Tables 1-4."""
    of_paper = table.filter(pl.col("verdict") != "score")
    for name in set(ROW_SCHEMA) - {"trial", "seconds"}:
        assert of_paper[name].equals(paper[name], null_equal=True), name
    both = rates_table(table.to_dicts(), "fast", restriction=restriction)
    alone = rates_table(paper.to_dicts(), "fast", restriction=restriction)
    assert both.columns[: len(alone.columns)] == alone.columns
    assert [row[: len(alone.columns)] for row in both.rows] == list(alone.rows)
    assert len(both.columns) == len(alone.columns) + len(RATES)
    assert not any(column.startswith("S ") for column in alone.columns)


def test_columns_of_the_score_are_the_rates_of_its_verdicts() -> None:
    """Counted by hand from the matches that the score keeps, and averaged over the scenes."""
    rows, expected = [], []
    for pair in SyntheticDataset(2):
        result = evaluate_pair(pair, "fast", FAST)
        rows += result.rows()
        (trial,) = [trial for trial in result.trials if trial.config.verdict == "score"]
        assert not trial.config.constrained
        tested = trial.classification.relation != 0
        kept = (tested & (trial.score >= 0.5)).tolist()
        known = list(zip(kept, trial.correct.tolist(), trial.valid.tolist(), strict=True))
        cell = {(k, c): sum(valid for a, b, valid in known if (a, b) == (k, c)) for k in (0, 1) for c in (0, 1)}
        expected.append((
            cell[0, 0] / (cell[0, 0] + cell[1, 0]),  # sensitivity: of the incorrect ones, those rejected
            cell[1, 1] / (cell[1, 1] + cell[0, 1]),  # specificity: of the correct ones, those kept
            cell[0, 0] / (cell[0, 0] + cell[0, 1]),  # PPV: of the rejected ones, those incorrect
            cell[1, 1] / (cell[1, 1] + cell[1, 0]),  # NPV: of the kept ones, those correct
        ))  # fmt: skip
    table = rates_table(rows, "fast")
    places = [k for k, column in enumerate(table.columns) if column.startswith("S ")]
    assert [table.columns[k] for k in places] == ["S sens.", "S spec.", "S PPV", "S NPV"]
    assert "learned, probability 0.5 (S)" in table.title
    found = [tuple(row[k] for k in places) for row in table.rows]
    assert found[:-1] == expected
    assert found[-1] == pytest.approx([sum(column) / 2 for column in zip(*expected, strict=True)], rel=1e-15)


def test_a_cut_belongs_to_the_verdict_of_the_score_alone() -> None:
    config = EvaluationConfig(min_precision=0.9, temperature=0.5, min_group_size=3)
    trials = config.trials("gftt")
    assert [trial.min_precision for trial in trials] == [0.9, None, None, None, None]
    assert {(trial.detector, trial.temperature, trial.min_group_size) for trial in trials} == {("gftt", 0.5, 3)}
    assert [trial.resolved_score for trial in trials] == ["learned", *["none"] * 4]
    named = EvaluationConfig(score="topology", threshold=0.3).trials("fast")
    assert [(trial.score, trial.threshold) for trial in named] == [("topology", 0.3), *[("none", None)] * 4]
    ranked = EvaluationConfig(verdict="adjacency", score="consensus").trials("fast")
    assert [(trial.constrained, trial.verdict, trial.score) for trial in ranked] == [
        (constrained, name, "consensus") for constrained in (False, True) for name in RESTRICTIONS
    ]


def test_points_of_a_sweep_are_scored_as_they_are() -> None:
    trials = (TrialConfig(score="consensus", min_precision=0.9), TrialConfig(verdict="adjacency"))
    rows = score_dataset(SyntheticDataset(1), SweepConfig(trials))
    assert rows.select("trial", "verdict", "score", "min_precision").rows() == [
        (0, "score", "consensus", 0.9),
        (1, "adjacency", "none", None),
    ]


def test_rates_follow_from_the_verdicts() -> None:
    pair = SyntheticDataset(1)[0]
    result = evaluate_pair(pair, "fast", FAST)
    assert len(result.trials) == 5
    for trial, row in zip(result.trials, result.rows(), strict=True):
        inlier = trial.classification.inlier
        cells = {(k, c): 0 for k in (False, True) for c in (False, True)}
        for kept, correct, valid in zip(inlier.tolist(), trial.correct.tolist(), trial.valid.tolist(), strict=True):
            cells[kept, correct] += valid
        assert row["sensitivity"] == cells[False, False] / (cells[False, False] + cells[True, False])
        assert row["specificity"] == cells[True, True] / (cells[True, True] + cells[False, True])
        assert row["num_valid"] == sum(cells.values())


def test_unknown_ground_truth_gives_nan_not_a_rate() -> None:
    pair = SyntheticDataset(1)[0]
    unknown = replace(pair, disparity_gt=torch.full_like(pair.disparity_gt, math.nan))  # type: ignore[arg-type]
    for row in evaluate_pair(unknown, "fast", FAST).rows():
        assert row["num_valid"] == 0
        assert math.isnan(row["sensitivity"])
        assert math.isnan(row["fraction_incorrect"])


def test_missing_ground_truth_is_named() -> None:
    pair = replace(SyntheticDataset(1)[0], disparity_gt=None)
    with pytest.raises(ValueError, match="disparity_gt of 'synthetic-00'"):
        score_dataset([pair], FAST)


@pytest.mark.slow
def test_object_constraint_raises_specificity_and_lowers_sensitivity(data_root: Path) -> None:
    """The paper, section 4: constrained against unconstrained, for both restrictions."""
    dataset = PairDataset(find_pairs(data_root / "middlebury", scenes=EIGHT))
    rows = score_dataset(dataset, replace(PAPER, detectors=("sift", "fast", "gftt")))
    wide = rows.pivot("variant", index=["scene", "detector", "verdict"], values=["sensitivity", "specificity"])
    counts = wide.group_by("detector", "verdict").agg(
        higher=(pl.col("specificity_constrained") > pl.col("specificity_unconstrained")).sum(),
        lower=(pl.col("sensitivity_constrained") < pl.col("sensitivity_unconstrained")).sum(),
        scenes=pl.len(),
    )
    assert len(counts) == 3 * 2
    assert (counts["scenes"] == 8).all()
    assert (counts["higher"] >= 7).all(), counts
    assert (counts["lower"] >= 6).all(), counts
