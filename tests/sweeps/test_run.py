from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
import torch

import tensor_stereo as ts
from tensor_stereo.cli import main
from tensor_stereo.configs import SweepConfig
from tensor_stereo.ops import backends
from tensor_stereo.sweeps import (
    SweepProgress,
    expand_grid,
    read_config,
    read_errors,
    read_grid,
    read_matches,
    read_results,
    run_sweep,
)
from tensor_stereo.sweeps.units import check_trials
from tests.sweeps.conftest import GRID, Inputs, assert_same, make_manifest, stored, write_pairs


def test_a_sweep_stores_the_rows_of_score_dataset(inputs: Inputs, expected: pl.DataFrame, tmp_path: Path) -> None:
    seen: list[SweepProgress] = []
    summary = run_sweep(inputs.config, inputs.manifest, tmp_path / "run", num_workers=2, on_progress=seen.append)
    assert not summary.interrupted
    assert summary.progress.num_done == summary.progress.num_new == 12
    assert [state.num_done for state in seen] == sorted(state.num_done for state in seen)
    assert_same(stored(tmp_path / "run"), expected)
    again = run_sweep(inputs.config, inputs.manifest, tmp_path / "run", num_workers=2)
    assert (again.progress.num_done, again.progress.num_new) == (12, 0)
    assert read_config(tmp_path / "run") == inputs.config
    environment = json.loads((tmp_path / "run" / "environment.json").read_text())
    assert [record["engine"] for record in environment] == ["local", "local"]
    assert environment[0]["versions"]["torch"] == torch.__version__
    lines = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [line["message"] for line in lines] == ["start", "end", "start", "end"]


@pytest.mark.slow
def test_workers_shards_limits_and_parts_change_nothing(inputs: Inputs, expected: pl.DataFrame, tmp_path: Path) -> None:
    out = tmp_path / "run"
    run_sweep(inputs.config, inputs.manifest, out, num_workers=1, shard=(2, 3), units_per_part=1)
    state = run_sweep(inputs.config, inputs.manifest, out, num_workers=2, shard=(1, 3), limit=2).progress
    assert (state.num_units, state.num_done, state.num_new) == (4, 2, 2)
    assert len(read_results(out)) == len(expected) // 2
    for shard in ((1, 3), (3, 3)):
        run_sweep(inputs.config, inputs.manifest, out, num_workers=1, shard=shard, seconds_per_part=0.0)
    assert_same(stored(out), expected)
    assert run_sweep(inputs.config, inputs.manifest, out).progress.num_new == 0  # whole, after its shards


@pytest.mark.slow
def test_the_manifest_of_a_run_stays(inputs: Inputs, expected: pl.DataFrame, tmp_path: Path) -> None:
    manifest, out = tmp_path / "m.parquet", tmp_path / "run"
    table = pl.read_parquet(inputs.manifest)
    table.write_parquet(manifest)
    run_sweep(inputs.config, manifest, out, num_workers=1, limit=3)
    for edited in (table[:-1], table.with_columns(mask="image0"), table.reverse()):
        edited.write_parquet(manifest)
        with pytest.raises(ValueError, match="manifest"):
            run_sweep(inputs.config, manifest, out, num_workers=1)
    table.write_parquet(manifest)
    run_sweep(inputs.config, manifest, out, num_workers=1)
    assert_same(stored(out), expected)


def test_kept_matches_come_back_for_training(inputs: Inputs, tmp_path: Path) -> None:
    rates = {"detector": "fast", "outlier_rate": [0.0, 0.5]}
    tables = [
        rates | {"verdict": ["adjacency", "cardinality"], "score": ["none", "topology"]},
        rates | {"verdict": "score", "score": "consensus"},
    ]
    config = SweepConfig(expand_grid(tables), export_matches=True)
    out = tmp_path / "run"
    run_sweep(config, inputs.manifest, out, num_workers=1, limit=2)
    rows = read_results(out)
    assert len(rows) == 2 * (8 + 2)
    for row in rows.iter_rows(named=True):
        found = read_matches(out, row["dataset"], row["scene"], trial=row["trial"])
        assert len(found.inlier) == found.matches.num_matches == row["num_matches"]
        by_set = ts.classify_matches(found.matches)
        assert torch.equal(found.relation, by_set.relation)
        assert int((found.inlier & found.correct & found.valid).sum()) == row["true_negative"]
        if row["score"] == "none":
            assert found.score is None
            assert torch.equal(found.inlier, by_set.inlier_of(row["verdict"]))
        else:
            expected = ts.DelaunayFilter(verdict=row["verdict"], score=row["score"])(found.matches)
            assert torch.equal(found.score, expected.score)
            assert torch.equal(found.inlier, expected.inlier)
    with pytest.raises(ValueError, match="trial 10"):
        read_matches(out, "synthetic", "synthetic-00", trial=10)


def test_scenes_that_look_like_paths_keep_their_matches_apart(tmp_path: Path) -> None:
    write_pairs(tmp_path / "pairs", 2)
    listed = tmp_path / "pairs" / "ds.csv"
    files = [f"synthetic-0{k}-0.png,synthetic-0{k}-1.png,synthetic-0{k}.pfm" for k in range(2)]
    listed.write_text(f"scene,image0,image1,disparity_gt\nx,{files[0]}\nds/x,{files[1]}\n")
    config = SweepConfig(expand_grid([{"detector": "fast", "verdict": "cardinality"}]), export_matches=True)
    run_sweep(config, make_manifest(listed), tmp_path / "run", num_workers=1)
    counts = {row["scene"]: row["num_matches"] for row in read_results(tmp_path / "run").iter_rows(named=True)}
    assert counts.keys() == {"x", "ds/x"}
    for scene, count in counts.items():
        assert read_matches(tmp_path / "run", "ds", scene).matches.num_matches == count


def test_a_run_without_matches_says_so(inputs: Inputs, tmp_path: Path) -> None:
    run_sweep(inputs.config, inputs.manifest, tmp_path / "run", num_workers=1, limit=1)
    with pytest.raises(ValueError, match="export_matches"):
        read_matches(tmp_path / "run", "synthetic", "synthetic-00")


def test_a_bad_setting_is_told_before_anything_runs(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ValueError, match="window_px"):
        expand_grid([{"detector": ["gftt", "fast"], "fast": {"window_px": 10}}])
    config = SweepConfig(expand_grid([{"detector": ["fast", "gftt"], "verdict": "cardinality"}]))
    trials = replace(config.trials[0], backend="scipy"), replace(config.trials[1], backend="native")
    monkeypatch.setattr(backends, "kernels", None)  # what this machine lacks is known when a point runs
    monkeypatch.setattr("tensor_stereo.sweeps.run.check_points", check_trials)  # here, where it lacks them
    with pytest.raises(ValueError, match=r"point 1 of the grid \(gftt\): backend 'native'"):
        run_sweep(SweepConfig(trials), inputs.manifest, tmp_path / "run")
    monkeypatch.undo()
    assert not (tmp_path / "run").exists()
    with pytest.raises(ValueError, match="limit"):
        run_sweep(inputs.config, inputs.manifest, tmp_path / "run", limit=-1)
    with pytest.raises(ValueError, match="num_workers"):
        run_sweep(inputs.config, inputs.manifest, tmp_path / "run", num_workers=0)


def test_the_command_runs_resumes_and_tells_failures_by_its_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "sweep.toml").write_text(GRID)
    manifest = make_manifest(write_pairs(tmp_path / "pairs", 2))
    out = tmp_path / "run"
    command = ["sweep", str(tmp_path / "sweep.toml"), "--manifest", str(manifest), "--out", str(out), "--workers", "1"]
    main([*command, "--dry-run"])
    printed = capsys.readouterr().out
    assert "2 pairs x 8 points of the grid = 4 units" in printed
    assert "about 0:00:0" in printed
    assert not out.exists()
    (tmp_path / "pairs" / "synthetic-01-1.png").rename(tmp_path / "hidden.png")
    with pytest.raises(SystemExit) as stop:
        main(command)
    assert stop.value.code == 1
    assert "2 failed" in capsys.readouterr().out
    assert read_errors(out)["error"].to_list() == ["FileNotFoundError"] * 2
    (tmp_path / "hidden.png").rename(tmp_path / "pairs" / "synthetic-01-1.png")
    with pytest.raises(SystemExit):
        main(command)  # a failed unit is done
    main([*command, "--retry-errors"])
    assert read_errors(out).is_empty()
    assert len(read_results(out)) == 2 * 8
    for arguments, word in (
        ([*command, "--shard", "5"], "shard"),
        ([*command, "--engine", "ray", "--workers", "0"], "--workers"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 2
        assert word in capsys.readouterr().err


@pytest.mark.slow
def test_ten_thousand_finished_units_are_found_at_once(tmp_path: Path) -> None:
    """The journal alone says what is done: no part is read, no worker starts."""
    from tensor_stereo.datasets import write_manifest
    from tensor_stereo.datasets.manifest import SCHEMA
    from tensor_stereo.datasets.pair_table import PairTable
    from tensor_stereo.sweeps.batches import METRICS_SCHEMA, make_batch
    from tensor_stereo.sweeps.store import RunStore

    count = 10_000
    table = pl.DataFrame(
        dict.fromkeys(SCHEMA)
        | {
            "dataset": ["many"] * count,
            "scene": [str(k) for k in range(count)],
            "image0": ["a.png"] * count,
            "image1": ["b.png"] * count,
            "gt_encoding": ["scaled"] * count,
            "width_px": [1] * count,
            "height_px": [1] * count,
        },
        {name: SCHEMA[name] for name in SCHEMA},
    )
    write_manifest(table, tmp_path / "m.parquet")
    (tmp_path / "sweep.toml").write_text("")
    out = tmp_path / "run"
    run_sweep(read_grid(tmp_path / "sweep.toml"), tmp_path / "m.parquet", out, limit=0)
    known = json.loads((out / "config.json").read_text())
    row = dict.fromkeys(METRICS_SCHEMA) | {"trial": 0, "num_valid": 1}
    with RunStore(out, known, PairTable(tmp_path / "m.parquet", check_files=False)) as store:
        for first in range(0, count, 100):
            store.add(make_batch([row | {"unit": unit} for unit in range(first, first + 100)]))
    command = [sys.executable, "-m", "tensor_stereo", "sweep", str(tmp_path / "sweep.toml")]
    command += ["--manifest", str(tmp_path / "m.parquet"), "--out", str(out)]
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ)
    assert result.returncode == 0, result.stderr
    assert "10000 of 10000 units done, 0 now" in result.stdout


def test_pairs_outside_of_the_domain_are_marked_in_the_rows_and_in_the_log(inputs: Inputs, tmp_path: Path) -> None:
    """Without a warning on the screen of whoever runs many pairs."""
    grid = {"detector": "fast", "score": "consensus", "outlier_rate": [0.0, 1.0], "max_error_px": [1.0, 3.0]}
    run_sweep(SweepConfig(expand_grid([grid])), inputs.manifest, tmp_path / "run", num_workers=1, limit=1)
    rows = read_results(tmp_path / "run").select("outlier_rate", "max_error_px", "domain").rows()
    assert sorted(rows) == [(0, 1, ""), (0, 3, ""), (1, 1, "agreement"), (1, 3, "agreement")]
    lines = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    (marked,) = [line for line in lines if line["message"] == "outside of the domain"]
    assert (marked["unit"], marked["scene"], marked["domain"]) == (0, "synthetic-00", ["agreement"])


def test_rectified_is_a_setting_and_what_a_pair_was_taken_for_a_result(inputs: Inputs, tmp_path: Path) -> None:
    settings = tmp_path / "sweep.toml"
    settings.write_text('[grid]\nscore = ["learned", "consensus"]\nrectified = [true, false, "auto"]\n')
    config, run = read_grid(settings), tmp_path / "run"
    assert len(config.trials) == 6
    assert run_sweep(config, inputs.manifest, run, num_workers=1, limit=1).progress.num_done == 1
    summary = run_sweep(config, inputs.manifest, run, num_workers=1, limit=1)  # goes on
    assert (summary.progress.num_done, summary.progress.num_new) == (2, 1)
    assert read_config(run) == config
    found = read_results(run)
    assert len(found) == 2 * 6
    for row in found.iter_rows(named=True):
        trial = config.trials[row["trial"]]
        assert row["rectified"] == str(trial.rectified).lower()
        assert row["is_rectified"] is (trial.rectified is not False)
    by_setting = found.group_by("score", "rectified").agg(pl.col("score_counts_correct", "score_counts_incorrect"))
    for score in ("learned", "consensus"):
        kinds = ("true", "false", "auto")
        true, false, auto = (by_setting.filter(score=score, rectified=kind).drop("rectified").rows() for kind in kinds)
        assert true == auto != false
    with pytest.raises(ValueError, match=r"rectified is True there, False here"):
        run_sweep(SweepConfig(tuple(replace(trial, rectified=False) for trial in config.trials)), inputs.manifest, run)
