"""Repair and refinement from images to verdicts, in the pipeline, in trials and on the command line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
import torch

import tensor_stereo as ts
from tensor_stereo.configs import EvaluationConfig, PipelineConfig, TrialConfig
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tensor_stereo.evaluation import errors_against_gt
from tensor_stereo.evaluation.trials import TrialRunner
from tensor_stereo.pipeline import PipelineOutput, run_pipeline
from tensor_stereo.scores import Origin
from tensor_stereo.sweeps.grid import read_grid

BOTH = PipelineConfig(repair=True, refine=True)


def run(seed: int, config: PipelineConfig) -> tuple[PipelineOutput, torch.Tensor, torch.Tensor]:
    """The output, which matches are right within 1 px, and the error of those that are right and kept."""
    pair = render_pair(seed)
    output = run_pipeline([(pair.image0, pair.image1)], config)
    error = errors_against_gt(output.matches, [pair.disparity_gt])
    right = error <= 1
    return output, right, error[right & output.classification.inlier]


@pytest.mark.parametrize("seed", [0, 2])
def test_more_matches_come_out_right_and_nearer_to_the_truth(seed: int) -> None:
    before, right_before, error_before = run(seed, PipelineConfig())
    after, right_after, error_after = run(seed, BOTH)
    kept_before, kept_after = before.classification.inlier, after.classification.inlier
    assert (kept_after & right_after).sum() > 1.5 * (kept_before & right_before).sum()
    assert right_after[kept_after].double().mean() > 0.93
    assert error_after.mean() < error_before.mean()
    assert set(after.origin.tolist()) == {0, 1, 2}
    assert before.origin.eq(int(Origin.GIVEN)).all()


@pytest.mark.parametrize(
    "config",
    [
        replace(BOTH, verdict="cardinality"),
        replace(BOTH, score="consensus"),
        replace(BOTH, constrained=True),
        replace(BOTH, rectified="auto", min_precision=0.9),
        replace(BOTH, detector="sift", refine=False),
    ],
    ids=["cardinality", "consensus", "constrained", "auto", "sift"],
)
def test_every_verdict_can_be_repaired_and_a_batch_equals_the_loop(config: PipelineConfig) -> None:
    pairs = [(pair.image0, pair.image1) for pair in map(render_pair, (0, 2))]
    whole = run_pipeline(pairs, config)
    parts = [run_pipeline([pair], config) for pair in pairs]
    assert torch.equal(whole.matches.keypoints1, torch.cat([part.matches.keypoints1 for part in parts]))
    assert torch.equal(whole.classification.inlier, torch.cat([part.classification.inlier for part in parts]))
    assert torch.equal(whole.origin, torch.cat([part.origin for part in parts]))
    assert (whole.matches.group is not None) == config.constrained
    assert (whole.origin == int(Origin.REPAIRED)).any()


def test_images_without_matches_stay_without() -> None:
    blank = torch.full((1, 60, 80), 100, dtype=torch.uint8)
    output = run_pipeline([(blank, blank)], BOTH)
    assert output.matches.num_matches == 0
    assert output.origin.shape == (0,)


def test_trials_judge_what_they_have_repaired() -> None:
    runner = TrialRunner(render_pair(0))
    plain, repaired, both = (
        runner.run(TrialConfig(repair=repair, refine=refine))
        for repair, refine in ((False, False), (True, False), (True, True))
    )
    rows = [trial.row() for trial in (plain, repaired, both)]
    assert [(row["repair"], row["refine"]) for row in rows] == [(False, False), (True, False), (True, True)]
    assert rows[1]["true_negative"] > 1.5 * rows[0]["true_negative"]  # kept and right, in the paper's words
    assert plain.matches.num_matches < repaired.matches.num_matches == both.matches.num_matches
    again = runner.run(TrialConfig())
    assert torch.equal(again.matches.keypoints1, plain.matches.keypoints1)
    assert rows[0]["seconds"]["improve"] == 0 < rows[1]["seconds"]["improve"]


def test_the_tables_of_the_paper_are_of_the_matches_as_they_come() -> None:
    first, *rest = EvaluationConfig(repair=True, refine=True).trials("fast")
    assert first.repair
    assert first.refine
    assert not any(trial.repair or trial.refine for trial in rest)


def test_both_are_axes_of_a_sweep(tmp_path: Path) -> None:
    path = tmp_path / "grid.toml"
    path.write_text("[grid]\nrepair = [true, false]\nrefine = [true, false]\n")
    assert {(trial.repair, trial.refine) for trial in read_grid(path).trials} == {
        (a, b) for a in (True, False) for b in (True, False)
    }


def test_the_file_of_classify_says_where_matches_come_from(tmp_path: Path) -> None:
    pair = render_pair(0)
    paths = [tmp_path / f"{name}.png" for name in ("left", "right")]
    from cv2 import imwrite

    for path, image in zip(paths, (pair.image0, pair.image1), strict=True):
        assert imwrite(str(path), image.permute(1, 2, 0).flip(2).contiguous().numpy())
    out = tmp_path / "matches.parquet"
    summary = ts.classify_files(*paths, BOTH, out=out)
    table = pl.read_parquet(out)
    assert set(table["origin"]) == {"given", "refined", "repaired"}
    assert table["inlier"].sum() == summary.num_kept
    ts.classify_files(*paths, out=out)
    assert "origin" not in pl.read_parquet(out).columns
