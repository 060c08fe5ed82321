from __future__ import annotations

import math
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from tensor_stereo.configs import TrialConfig
from tensor_stereo.evaluation.rows import ROW_SCHEMA, SCORE_BINS, STAGES, setting_columns
from tensor_stereo.reports.sweep import rows as rows_module
from tensor_stereo.reports.sweep.curves import detector_curves
from tensor_stereo.reports.sweep.pooling import (
    best_trials,
    decided_by_score,
    mildest,
    pool_trials,
    stage_times,
    worst_pairs,
)
from tensor_stereo.reports.sweep.rows import CELLS, RATE_UNIT, SCORE_RATES, SECONDS_UNIT, VERDICT_RATES, RunRows
from tensor_stereo.reports.sweep.settings import SETTINGS, order_detectors, settings_label, varying_settings
from tests.reports.sweep_results import make_grid, make_results, trials_of

SMALL = make_grid(("fast", "sift"), outlier_rates=(0.0, 0.3), scores=("none", "topology"))


@pytest.fixture(scope="module")
def results() -> pl.DataFrame:
    return make_results(SMALL, num_pairs=5)


def samples(rows: pl.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """The bin of every correct and of every incorrect match of some rows."""
    return tuple(
        np.concatenate([np.repeat(np.arange(SCORE_BINS), counts) for counts in rows[f"score_counts_{name}"]])
        for name in ("correct", "incorrect")
    )


def test_rates_of_a_trial_are_those_of_all_its_matches(results: pl.DataFrame) -> None:
    pooled = pool_trials(trials_of(results))
    assert pooled["trial"].to_list() == list(range(len(SMALL)))
    for row in pooled.iter_rows(named=True):
        rows = results.filter(pl.col("trial") == row["trial"])
        tp, fp, tn, fn = (rows[name].sum() for name in CELLS)
        expected = ((tp + fn) / (tp + fp + tn + fn), tp / (tp + fn), tn / (tn + fp), tp / (tp + fp), tn / (tn + fn))
        expected += (tn / (tn + fn), tn / (tn + fp))  # precision and recall of the kept correct matches
        assert tuple(row[name] for name in VERDICT_RATES) == expected
        assert row["num_pairs"] == 5
        assert row["num_matches"] == rows["num_matches"].sum()
        assert {name: row[name] for name in SETTINGS} == SMALL[row["trial"]]
        assert row["mean_npv"] == pytest.approx(np.mean(rows["npv"].to_list()), abs=RATE_UNIT)
        totals = [sum(stages.values()) for stages in rows["seconds"]]
        assert row["seconds"] == pytest.approx(np.mean(totals), abs=SECONDS_UNIT)  # to which each row is rounded


def test_auc_and_specificity_are_those_of_every_pair_of_matches(results: pl.DataFrame) -> None:
    for row in pool_trials(trials_of(results)).iter_rows(named=True):
        if row["score"] == "none":
            assert row["auc"] is row["mean_auc"] is row["specificity_at_sensitivity_96"] is None
            assert row["score_counts_correct"] is None
            continue
        correct, incorrect = samples(results.filter(pl.col("trial") == row["trial"]))
        wins = (correct[:, None] > incorrect).mean() + (correct[:, None] == incorrect).mean() / 2
        assert row["auc"] == pytest.approx(wins, rel=1e-12)
        threshold = min(t for t in range(SCORE_BINS) if (incorrect <= t).mean() >= 0.96)
        assert row["specificity_at_sensitivity_96"] == pytest.approx((correct > threshold).mean(), rel=1e-12)


def test_seeds_are_pooled_on_request() -> None:
    seeds = make_results(make_grid(("fast",), outlier_rates=(0.2,), seeds=(3, 4)), num_pairs=2)
    pooled = pool_trials(trials_of(seeds), over=("seed",))
    assert "seed" not in pooled.columns
    assert pooled["trial"].to_list() == [0, 2, 4, 6]
    assert pooled["num_pairs"].to_list() == [2] * 4
    assert (
        pooled["num_matches"].to_list()
        == pool_trials(trials_of(seeds))["num_matches"].reshape((4, 2)).arr.sum().to_list()
    )


def test_trials_that_differ_in_no_column_stay_apart() -> None:
    grid = make_grid(("fast",), outlier_rates=(0.0,))
    twice = make_results([*grid, *grid], num_pairs=2)
    assert len(pool_trials(trials_of(twice))) == len(pool_trials(trials_of(twice), over=("seed",))) == 2 * len(grid)


def test_undefined_rates_leave_the_mean_and_stay_undefined(results: pl.DataFrame) -> None:
    nothing = {name: pl.lit(0, pl.Int64) for name in CELLS} | {name: pl.lit(math.nan) for name in VERDICT_RATES}
    where = pl.col("scene") == "Art"
    some = results.with_columns(
        pl.when(where).then(value).otherwise(name).alias(name) for name, value in nothing.items()
    )
    others = pool_trials(trials_of(results.filter(~where)))
    assert pool_trials(trials_of(some))["mean_ppv"].to_list() == others["mean_ppv"].to_list()
    none = pool_trials(trials_of(results.with_columns(**nothing)))
    assert none["sensitivity"].is_nan().all()
    assert none["mean_sensitivity"].is_null().all()


def test_what_varies_tells_trials_apart_and_does_not_follow_from_the_detector() -> None:
    frames = [make_results(make_grid(("fast", "sift")), num_pairs=1), make_results(make_grid(("surf",)), num_pairs=1)]
    assert varying_settings([trials_of(each) for each in frames]) == ["detector", "variant", "verdict", "outlier_rate"]
    windows = [
        make_results([trial | {"window_px": size} for trial in make_grid(("fast",))], num_pairs=1) for size in (7, 9)
    ]
    assert varying_settings([trials_of(each) for each in windows]) == [
        "window_px",
        "variant",
        "verdict",
        "outlier_rate",
    ]
    assert varying_settings([trials_of(frames[0].clear())]) == []


def test_settings_of_consensus_tell_trials_apart_where_they_do_not_follow_from_the_score() -> None:
    one_slope = make_grid(("fast",), outlier_rates=(0.0,), scores=("none", "learned", "topology", "consensus"))
    assert varying_settings([trials_of(make_results(one_slope, num_pairs=1))]) == ["variant", "verdict", "score"]
    slopes = make_grid(("fast",), outlier_rates=(0.0,), scores=("learned", "consensus"), slopes=(0.1, 0.3))
    results = make_results(slopes, num_pairs=1)
    assert varying_settings([trials_of(results)]) == ["variant", "verdict", "score", "consensus_slope"]
    pooled = pool_trials(trials_of(results))
    assert len(pooled) == len(slopes) == 2 * 2 * 3
    assert pooled["consensus_slope"].to_list() == [row["consensus_slope"] for row in slopes]
    labels = [settings_label(row, ["score", "consensus_slope"]) for row in pooled[:3].iter_rows(named=True)]
    assert labels == ["learned", "consensus, consensus slope 0.1", "consensus, consensus slope 0.3"]


def test_labels_name_words_and_numbers() -> None:
    row: dict[str, Any] = make_grid(("sift",))[0] | {"max_ratio": None, "score": "none"}
    assert settings_label(row, ["detector", "window_px", "max_ratio", "noise_px", "score", "threshold"]) == (
        "sift, max. ratio off, noise px 0, no score"
    )
    assert settings_label(row, ["verdict", "score"]) == "adjacency, no score"
    assert settings_label(row, []) == "all settings alike"
    aimed = row | {"verdict": "score", "score": "learned", "threshold": None, "min_precision": 0.9}
    assert settings_label(aimed, ["threshold", "score", "min_precision"]) == "learned, min. precision 0.9"
    names = ["verdict", "score", "threshold", "target_sensitivity", "min_precision"]
    assert settings_label(aimed, names) == "by score, learned, min. precision 0.9"
    cut = aimed | {"min_precision": None, "threshold": 0.25}
    assert settings_label(cut, names) == "by score, learned, threshold 0.25"


def test_mildest_perturbation_is_found_per_detector() -> None:
    sift, fast = make_grid(("sift",), outlier_rates=(0.2, 0.4)), make_grid(("fast",), outlier_rates=(0.0, 0.4))
    noisy = [trial | {"noise_px": 0.5 if trial["outlier_rate"] == 0.2 else 0.0} for trial in sift]
    found = mildest(trials_of(make_results([*noisy, *fast], num_pairs=1)))
    assert set(found.select("detector", "outlier_rate", "noise_px").rows()) == {("sift", 0.2, 0.5), ("fast", 0.0, 0.0)}


def test_worst_pairs_are_bad_at_their_best_trial(results: pl.DataFrame) -> None:
    best: dict[tuple[str, str], float] = {}
    for row in results.filter(pl.col("outlier_rate") == 0).iter_rows(named=True):
        key = row["detector"], row["scene"]
        best[key] = max(best.get(key, 0.0), (row["sensitivity"] + row["specificity"]) / 2)
    worst = worst_pairs(RunRows.of(results), 2)
    expected = [sorted((best[d, s], d, s) for name, s in best if name == d)[:2] for d in ("sift", "fast")]
    rows = list(worst.select("balanced_accuracy", "detector", "scene").iter_rows())
    assert rows == [*expected[0], *expected[1]]
    none = pl.lit(0, pl.Int64)
    undefined = results.with_columns(specificity=pl.lit(math.nan), false_positive=none, true_negative=none)
    assert worst_pairs(RunRows.of(undefined)).is_empty()
    assert best_trials(trials_of(undefined)).is_empty()


def test_best_trial_of_each_detector_has_the_highest_mean(results: pl.DataFrame) -> None:
    pooled = pool_trials(trials_of(results.filter(pl.col("outlier_rate") == 0)))
    for row in best_trials(trials_of(results)).iter_rows(named=True):
        rivals = pooled.filter(pl.col("detector") == row["detector"])
        assert row["sensitivity"] + row["specificity"] == (rivals["sensitivity"] + rivals["specificity"]).max()
        assert row["score"] == "topology"  # equal without a score


def test_stage_times_are_means_over_the_rows_in_which_a_stage_ran(results: pl.DataFrame) -> None:
    times = stage_times(trials_of(results))
    assert times.columns == ["detector", *STAGES[:-1], "total"]  # nothing was repaired or refined
    assert times["detector"].to_list() == ["sift", "fast"]
    for (k, detector), stage in product(enumerate(times["detector"]), STAGES[:-1]):
        spent = [row[stage] for row in results.filter(pl.col("detector") == detector)["seconds"]]
        mean = np.mean([value for value in spent if value > 0])
        assert times[stage][k] == pytest.approx(1000 * mean, abs=1000 * SECONDS_UNIT)
    plain = results.filter(pl.col("variant") == "unconstrained")
    assert "group" not in stage_times(trials_of(plain)).columns


def test_curves_hold_every_threshold_and_the_trials_that_share_them(results: pl.DataFrame) -> None:
    found = detector_curves(trials_of(results))
    assert [item.detector for item in found] == ["sift", "fast"]
    for item in found:
        assert len(item.curves) == 2  # with and without objects
        assert {row["score"] for row in item.verdicts} == {"none"}
        assert item.curves[0].auc >= item.curves[1].auc
        for curve in item.curves:
            assert {row["verdict"] for row in curve.trials} == {"adjacency", "cardinality"}
            assert set(curve.fixed_settings()) == set(SETTINGS) - {"verdict", "seed"}
            correct, incorrect = samples(results.filter(pl.col("trial") == curve.trials[0]["trial"]))
            for k, threshold in enumerate(range(-1, SCORE_BINS)):
                rejected, lost = (incorrect <= threshold).sum(), (correct <= threshold).sum()
                assert curve.sensitivity[k] == pytest.approx(rejected / len(incorrect), abs=1e-12)
                assert curve.specificity[k] == pytest.approx(1 - lost / len(correct), abs=1e-12)
                kept, wrong = len(correct) - lost, len(incorrect) - rejected
                if kept + wrong:
                    assert curve.precision[k] == pytest.approx(kept / (kept + wrong), abs=1e-12)
                else:
                    assert math.isnan(curve.precision[k])


def test_a_verdict_by_score_is_a_point_of_the_curve_that_it_shares_with_the_others() -> None:
    grid = make_grid(("fast",), verdicts=("score", "adjacency", "cardinality"), scores=("consensus", "learned"))
    (found,) = detector_curves(trials_of(make_results(grid, num_pairs=3)))
    assert len(found.curves) == 2 * 2  # of two scores, with and without objects
    assert found.verdicts == ()
    for curve in found.curves:
        assert [row["verdict"] for row in curve.trials] == ["score", "adjacency", "cardinality"]
        assert [decided_by_score(row) for row in curve.trials] == [True, False, False]
        at = SCORE_BINS // 2  # what lies below .5 is rejected
        by_score, *others = [(row["sensitivity"], row["specificity"], row["precision"]) for row in curve.trials]
        assert by_score == pytest.approx((curve.sensitivity[at], curve.specificity[at], curve.precision[at]), rel=1e-12)
        for other in others:
            assert other[:2] != pytest.approx(by_score[:2], rel=1e-3)


def test_score_without_incorrect_matches_has_no_curve(results: pl.DataFrame) -> None:
    none = results["score_counts_incorrect"].list.eval(pl.element() * 0)
    (first, *_) = detector_curves(trials_of(results.with_columns(score_counts_incorrect=none)))
    assert first.curves == ()
    assert len(first.verdicts) == 8


def test_empty_results_pool_to_nothing(results: pl.DataFrame) -> None:
    empty = results.clear()
    pooled = pool_trials(trials_of(empty))
    assert pooled.is_empty()
    assert set(SCORE_RATES + VERDICT_RATES) <= set(pooled.columns)
    assert detector_curves(trials_of(empty)) == []
    assert stage_times(trials_of(empty)).is_empty()


def test_detectors_come_in_the_order_of_the_paper() -> None:
    assert order_detectors({"gftt", "surf", "sift", "fast", "orb"}) == ["sift", "fast", "surf", "gftt", "orb"]


def test_every_column_of_settings_has_a_heading() -> None:
    assert set(SETTINGS) == set(setting_columns(TrialConfig()))
    assert set(SETTINGS) <= set(ROW_SCHEMA)


def test_rectified_tells_trials_apart() -> None:
    kinds = ("true", "false", "auto")
    grid = make_grid(("fast",), verdicts=("score",), scores=("learned", "none"), outlier_rates=(0.0,), rectified=kinds)
    grid = [point for point in grid if point["score"] == "learned" and point["variant"] == "unconstrained"]
    results = make_results(grid, num_pairs=2)
    assert varying_settings([trials_of(results)]) == ["rectified"]
    assert pool_trials(trials_of(results))["rectified"].to_list() == list(kinds)
    rows = results.unique("trial", maintain_order=True).rows(named=True)
    labels = [settings_label(row, ["score", "rectified"]) for row in rows]
    assert labels == ["learned, rectified yes", "learned, rectified no", "learned, rectified auto"]
    (curve,) = detector_curves(trials_of(results))[0].curves  # the made-up scores are those of one draw
    assert [row["rectified"] for row in curve.trials] == list(kinds)
    assert "rectified" not in curve.fixed_settings()


def test_rectified_follows_from_a_score_that_does_not_ask() -> None:
    results = make_results(make_grid(("fast",), scores=("learned", "topology"), outlier_rates=(0.0,)), num_pairs=1)
    assert "rectified" not in varying_settings([trials_of(results)])


def test_sums_do_not_depend_on_how_the_rows_lie(
    results: pl.DataFrame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In one frame, or in files of a few rows in another order that are read a few rows at a time."""
    settings = results.select("trial", *SETTINGS).unique()
    rows = results.drop(SETTINGS).sample(fraction=1, shuffle=True, seed=1)
    for k, part in enumerate(rows.iter_slices(37)):
        part.write_parquet(tmp_path / f"part-{k}.parquet")
    monkeypatch.setattr(rows_module, "_BATCH", 5)
    whole, parts = RunRows.of(results), RunRows.of(pl.scan_parquet(tmp_path / "*.parquet"), settings)
    hosts = pl.col("hosts").list.sort()
    assert_frame_equal(parts.trials.with_columns(hosts), whole.trials.with_columns(hosts), check_exact=True)
    assert len(parts) == len(whole) == len(results)
    assert_frame_equal(parts.head(50), whole.head(50), check_column_order=False)
    assert worst_pairs(parts, 2).select("unit", "trial").equals(worst_pairs(whole, 2).select("unit", "trial"))


def test_rows_that_cannot_be_read_are_an_error(results: pl.DataFrame, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader that ends early must not go for a shorter run."""
    some = results.select("trial", "score_counts_correct", "score_counts_incorrect").head(7)
    monkeypatch.setattr(pl.LazyFrame, "collect_batches", lambda *_, **__: iter([some]))
    with pytest.raises(OSError, match=f"only 7 of {len(results)} rows can be decoded"):
        RunRows.of(results)
