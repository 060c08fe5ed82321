from __future__ import annotations

import math

import numpy as np
import polars as pl
import pytest

from tensor_stereo.configs import ConsensusConfig
from tensor_stereo.reports.sweep.compare import METRICS, NUM_RESAMPLES, SEED, Comparison, bootstrap_means, compare_runs
from tensor_stereo.reports.sweep.rows import RunRows
from tensor_stereo.reports.sweep.settings import setting_text
from tests.reports.sweep_results import consensus_columns, make_grid, make_results

GRID = make_grid(("sift", "fast"), outlier_rates=(0.0, 0.3))


def compare(a: pl.DataFrame, b: pl.DataFrame) -> Comparison:
    return compare_runs(RunRows.of(a), RunRows.of(b))


@pytest.fixture(scope="module")
def runs() -> tuple[pl.DataFrame, pl.DataFrame]:
    """Run B lacks two points, has the others in another order, and lacks the last pair."""
    return make_results(GRID, num_pairs=6), make_results(GRID[:1:-1], num_pairs=5, seed=1, gain=0.5)


def test_differences_are_means_over_the_common_pairs(runs: tuple[pl.DataFrame, pl.DataFrame]) -> None:
    a, b = runs
    comparison = compare(a, b)
    assert comparison.num_common_pairs == 5
    assert comparison.only_pairs == (["middlebury-2005/Moebius"], [])
    assert comparison.trials["trial"].to_list() == list(range(2, len(GRID)))
    for row in comparison.trials.iter_rows(named=True):
        assert GRID[row["trial"]] == GRID[:1:-1][row["trial_b"]] == {name: row[name] for name in GRID[0]}
        assert row["num_pairs"] == 5
        for name in METRICS:
            rows_a = a.filter(pl.col("trial") == row["trial"]).sort("scene").filter(pl.col("scene") != "Moebius")
            rows_b = b.filter(pl.col("trial") == row["trial_b"]).sort("scene")
            difference = np.mean(rows_b[name].to_numpy() - rows_a[name].to_numpy())
            assert row[f"{name}_mean"] == pytest.approx(difference, abs=1e-12)
            assert row[f"{name}_low"] <= row[f"{name}_mean"] <= row[f"{name}_high"]
    assert comparison.only["run"].to_list() == ["A", "A"]
    assert comparison.only["trial"].to_list() == [0, 1]


def test_detectors_weigh_every_pair_once(runs: tuple[pl.DataFrame, pl.DataFrame]) -> None:
    comparison = compare(*runs)
    assert comparison.detectors["detector"].to_list() == ["sift", "fast", "all"]
    assert comparison.detectors["num_settings"].to_list() == [6, 8, 14]
    trials = comparison.trials
    for row in comparison.detectors.iter_rows(named=True):
        of_detector = trials if row["detector"] == "all" else trials.filter(pl.col("detector") == row["detector"])
        # every pair has every point here
        assert row["auc_mean"] == pytest.approx(of_detector["auc_mean"].mean(), abs=1e-12)
        assert row["auc_mean"] > 0  # scores of B were made better
        assert row["auc_low"] > 0


def test_exchanged_runs_exchange_signs(runs: tuple[pl.DataFrame, pl.DataFrame]) -> None:
    forth, back = compare(*runs), compare(*runs[::-1])
    trials = back.trials.sort("trial_b")
    for name in METRICS:
        for end, other in (("mean", "mean"), ("low", "high"), ("high", "low")):
            np.testing.assert_allclose(forth.trials[f"{name}_{end}"], -trials[f"{name}_{other}"], atol=1e-12)
    assert back.only_pairs == ([], ["middlebury-2005/Moebius"])


def test_run_equals_itself(runs: tuple[pl.DataFrame, pl.DataFrame]) -> None:
    comparison = compare(runs[0], runs[0])
    ends = [f"{name}_{end}" for name in METRICS for end in ("mean", "low", "high")]
    assert (comparison.trials.select(ends) == 0).to_numpy().all()
    assert comparison.only.is_empty()


def test_interval_is_that_of_resampled_pairs() -> None:
    values = np.random.default_rng(5).normal(0.1, 1, (7, 3))
    values[2, 1] = math.nan
    mean, low, high = bootstrap_means(values)
    draw = np.random.default_rng(SEED)
    picks = draw.integers(0, 7, (NUM_RESAMPLES, 7))
    for column in range(3):
        means = [np.nanmean(values[pick, column]) for pick in picks]
        assert mean[column] == pytest.approx(np.nanmean(values[:, column]))
        np.testing.assert_allclose((low[column], high[column]), np.quantile(means, [0.025, 0.975]), atol=1e-12)


def test_all_points_see_the_same_draws_of_the_pairs(runs: tuple[pl.DataFrame, pl.DataFrame]) -> None:
    """Also those that lack a pair, as in a run that is not finished."""
    a, b = runs
    a = a.filter(~((pl.col("trial") == 3) & (pl.col("scene") == "Art")))
    comparison = compare(a, b)
    assert comparison.trials["num_pairs"].to_list() == [5 - (trial == 3) for trial in comparison.trials["trial"]]
    scenes = sorted(set(b["scene"]))
    values = np.full((len(scenes), len(comparison.trials)), math.nan)
    for k, row in enumerate(comparison.trials.iter_rows(named=True)):
        for p, scene in enumerate(scenes):
            found = [
                run.filter(trial=row[t], scene=scene)["auc"].to_list() for run, t in ((a, "trial"), (b, "trial_b"))
            ]
            if all(found):
                values[p, k] = found[1][0] - found[0][0]
    for end, expected in zip(("mean", "low", "high"), bootstrap_means(values), strict=True):
        np.testing.assert_allclose(comparison.trials[f"auc_{end}"], expected, atol=1e-12)


def test_interval_narrows_with_more_pairs_as_theory_says() -> None:
    values = np.random.default_rng(0).normal(0, 1, (400, 1))
    _, low, high = bootstrap_means(values)
    assert high[0] - low[0] == pytest.approx(2 * 1.96 / math.sqrt(400), rel=0.15)  # of a normal mean


def test_one_pair_has_a_mean_and_no_interval(runs: tuple[pl.DataFrame, pl.DataFrame]) -> None:
    a, b = (frame.filter(pl.col("scene") == "Art") for frame in runs)
    comparison = compare(a, b)
    assert comparison.trials["auc_mean"].is_not_nan().all()
    assert comparison.trials["auc_low"].is_nan().all()
    assert comparison.trials["auc_high"].is_nan().all()


def test_undefined_rates_are_left_out(runs: tuple[pl.DataFrame, pl.DataFrame]) -> None:
    a, b = runs
    known = compare(a.filter(pl.col("scene") != "Art"), b)
    undefined = pl.when(pl.col("scene") == "Art").then(math.nan).otherwise("specificity").alias("specificity")
    without = compare(a.with_columns(undefined), b)
    np.testing.assert_allclose(without.trials["specificity_mean"], known.trials["specificity_mean"], atol=1e-12)
    no_score = compare(a.with_columns(auc=pl.lit(None, pl.Float64)), b)
    assert no_score.trials["auc_mean"].is_nan().all()


def test_points_that_agree_in_all_columns_are_paired_in_order() -> None:
    twice = make_results([*GRID[:2], *GRID[:2]], num_pairs=2)
    comparison = compare(twice, twice)
    assert comparison.trials["trial_b"].to_list() == comparison.trials["trial"].to_list() == [0, 1, 2, 3]


def test_what_the_runs_as_a_whole_differ_in_does_not_part_them() -> None:
    gates = {"max_row_offset_px": None, "max_disparity_px": None}
    grid = make_grid(("sift", "fast"), scores=("none", "topology"))
    other = [trial | gates | {"feature_backend": "opencv"} for trial in grid if trial["detector"] == "sift"]
    other = [trial | {"temperature": 2.0 if trial["temperature"] else None} for trial in other]
    comparison = compare(make_results(grid, num_pairs=2), make_results(other, num_pairs=2))
    assert comparison.changed == {
        "feature_backend": ("kornia, –", "opencv"),
        "max_row_offset_px": ("1", "off"),
        "max_disparity_px": ("128", "off"),
        "temperature": ("1, –", "2, –"),
    }
    assert comparison.trials["trial"].to_list() == comparison.trials["trial_b"].to_list() == list(range(len(other)))
    assert set(comparison.only["detector"]) == {"fast"}
    scores = [make_results(make_grid(("sift",), scores=(score,)), num_pairs=2) for score in ("learned", "none")]
    assert compare(*scores).changed == {"score": ("learned", "none"), "rectified": ("yes", "–")}
    assert len(compare(*scores).trials) == scores[0]["trial"].n_unique()


def test_runs_of_two_scores_differ_in_the_settings_of_both() -> None:
    names = ("topology", "consensus")
    scores = [make_results(make_grid(("sift",), scores=(score,)), num_pairs=2) for score in names]
    own = {name: ("–", setting_text(name, value)) for name, value in consensus_columns(ConsensusConfig()).items()}
    assert len(own) == 9
    changed = {"score": names, "rectified": ("–", "yes")}
    changed |= {"temperature": ("1", "–"), "temperature_unit": ("edge", "–")} | own
    assert compare(*scores).changed == changed
    assert len(compare(*scores).trials) == scores[0]["trial"].n_unique()


def test_the_same_points_decided_in_another_way_are_paired() -> None:
    runs = [make_grid(("sift", "fast"), verdicts=(name,), scores=("learned",)) for name in ("cardinality", "score")]
    comparison = compare(*(make_results(grid, num_pairs=3) for grid in runs))
    assert comparison.changed == {"verdict": ("cardinality", "score")}
    assert comparison.trials["trial"].to_list() == comparison.trials["trial_b"].to_list() == list(range(len(runs[0])))
    assert comparison.only.is_empty()
    assert (comparison.trials["auc_mean"] == 0).all()  # one score, two verdicts
    assert (comparison.trials["sensitivity_mean"] != 0).all()


def test_a_setting_of_consensus_parts_points_only_where_both_runs_have_several_values() -> None:
    def run(*slopes: float) -> pl.DataFrame:
        grid = make_grid(("fast",), outlier_rates=(0.0,), scores=("consensus",), slopes=slopes)
        return make_results(grid, num_pairs=2)

    assert compare(run(0.1), run(0.3)).changed == {"consensus_slope": ("0.1", "0.3")}
    both = compare(run(0.1, 0.3), run(0.3, 0.5))
    assert both.changed == {}
    assert both.trials["consensus_slope"].to_list() == [0.3] * 4
    assert sorted(both.only.select("run", "consensus_slope").unique().rows()) == [("A", 0.1), ("B", 0.5)]


def test_runs_without_common_settings_have_no_differences() -> None:
    a = make_results(make_grid(("sift",)), num_pairs=2)
    b = make_results(make_grid(("fast",)), num_pairs=2)
    for other, num_pairs in ((b, 2), (b.clear(), 0)):
        comparison = compare(a, other)
        assert comparison.trials.is_empty()
        assert comparison.detectors.is_empty()
        assert comparison.num_common_pairs == num_pairs
        assert set(comparison.only["run"]) == set("AB"[: 1 + (num_pairs > 0)])
