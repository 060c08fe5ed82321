from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
import torch

from tensor_stereo.configs import EvaluationConfig
from tensor_stereo.datasets import PairDataset, find_pairs
from tensor_stereo.datasets.synthetic import SyntheticDataset
from tensor_stereo.evaluation import ROW_SCHEMA, evaluate_pair, score_dataset
from tensor_stereo.trials import STAGES
from tests.test_pipeline import EIGHT

FAST = EvaluationConfig(detectors=("fast",))


@pytest.fixture(scope="module")
def table() -> pl.DataFrame:
    return score_dataset(SyntheticDataset(2), FAST)


def test_one_row_per_scene_detector_variant_and_restriction(table: pl.DataFrame) -> None:
    keys = table.select("scene", "detector", "variant", "restriction")
    assert keys.height == keys.unique().height == 2 * 1 * 2 * 2
    assert table.schema == pl.Schema(ROW_SCHEMA)
    assert [f.name for f in table.schema["seconds"].fields] == list(STAGES)  # type: ignore[attr-defined]


def test_restriction_1_rejects_all_that_restriction_2_rejects(table: pl.DataFrame) -> None:
    wide = table.pivot("restriction", index=["scene", "variant"], values=["sensitivity", "specificity"])
    assert (wide["sensitivity_adjacency"] >= wide["sensitivity_cardinality"]).all()
    assert (wide["specificity_adjacency"] <= wide["specificity_cardinality"]).all()


def test_rates_follow_from_the_verdicts() -> None:
    pair = SyntheticDataset(1)[0]
    result = evaluate_pair(pair, "fast", FAST)
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
    rows = score_dataset(dataset, EvaluationConfig(detectors=("sift", "fast", "gftt")))
    wide = rows.pivot("variant", index=["scene", "detector", "restriction"], values=["sensitivity", "specificity"])
    counts = wide.group_by("detector", "restriction").agg(
        higher=(pl.col("specificity_constrained") > pl.col("specificity_unconstrained")).sum(),
        lower=(pl.col("sensitivity_constrained") < pl.col("sensitivity_unconstrained")).sum(),
        scenes=pl.len(),
    )
    assert (counts["scenes"] == 8).all()
    assert (counts["higher"] >= 7).all(), counts
    assert (counts["lower"] >= 6).all(), counts
