"""Run folders of other releases: what they lack has a default, what they have too much is refused."""

from __future__ import annotations

import hashlib
import io
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from tensor_stereo.cli import main
from tensor_stereo.configs import ConsensusConfig, FASTConfig, SweepConfig
from tensor_stereo.sweeps import (
    expand_grid,
    read_config,
    read_errors,
    read_matches,
    read_results,
    run_sweep,
)
from tensor_stereo.sweeps.batches import METRICS_SCHEMA
from tensor_stereo.sweeps.store import FORMAT, read_config_file
from tests.cli.failing import fails
from tests.sweeps.conftest import Inputs, stored

GRID = """
export_matches = true
[grid]
detector = "fast"
score = "consensus"
consensus.slope = [0.1, 0.3]
"""
CONFIG = SweepConfig(
    expand_grid([{"detector": "fast", "score": "consensus", "consensus": {"slope": [0.1, 0.3]}}]), export_matches=True
)
PAPER = SweepConfig(expand_grid([{"detector": "fast", "verdict": ["adjacency", "cardinality"]}]), export_matches=True)
Edit = Callable[[dict[str, Any]], object]


def _write_settings(folder: Path) -> str:
    path = folder / "sweep.toml"
    path.write_text(GRID)
    return str(path)


def _edit(run: Path, change: Edit) -> str:
    """Change config.json, as another release would have written it; the new text."""
    path = run / "config.json"
    config = json.loads(path.read_text())
    change(config)
    path.write_text(json.dumps(config))
    return path.read_text()


def _without(*names: str) -> Edit:
    """Takes dotted settings out of every trial."""

    def change(config: dict[str, Any]) -> None:
        for trial in config["sweep"]["trials"]:
            for name in names:
                *parents, last = name.split(".")
                place = trial
                for parent in parents:
                    place = place[parent]
                del place[last]

    return change


def _drop_columns(run: Path, *names: str) -> None:
    """Write every finished part again without some columns, and enter it in its journal."""
    for journal in run.glob("journal-*.jsonl"):
        entries = [json.loads(line) for line in journal.read_text().splitlines()]
        for entry in entries:
            for name in entry["files"]:
                buffer = io.BytesIO()
                pl.read_parquet(run / name).drop(names, strict=False).write_parquet(buffer)
                (run / name).write_bytes(buffer.getvalue())
                entry["files"][name] = len(buffer.getvalue()), hashlib.sha256(buffer.getvalue()).hexdigest()
        journal.write_text("".join(f"{json.dumps(entry)}\n" for entry in entries))


@pytest.fixture(scope="module")
def begun(inputs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs that hold two of six units."""
    runs = {}
    for name, config in (("consensus", CONFIG), ("paper", PAPER)):
        runs[name] = tmp_path_factory.mktemp("begun") / name
        run_sweep(config, inputs.manifest, runs[name], num_workers=1, limit=2)
    return runs


@pytest.fixture
def run(begun: dict[str, Path], tmp_path: Path) -> Path:
    """A copy of the run with a consensus score, to change."""
    return Path(shutil.copytree(begun["consensus"], tmp_path / "run"))


@pytest.fixture
def paper(begun: dict[str, Path], tmp_path: Path) -> Path:
    """A copy of the run without a score."""
    return Path(shutil.copytree(begun["paper"], tmp_path / "paper"))


def test_points_of_an_axis_of_consensus_are_told_apart_by_their_column(run: Path) -> None:
    rows = read_results(run)
    assert rows.select("trial", "score", "consensus_slope").unique().sort("trial").rows() == [
        (0, "consensus", 0.1), (1, "consensus", 0.3)
    ]  # fmt: skip
    of_default = {f"consensus_{name}": value for name, value in vars(ConsensusConfig()).items() if name != "slope"}
    assert {name: rows[name].unique().to_list() for name in of_default} == {k: [v] for k, v in of_default.items()}
    first, second = (rows.filter(trial=trial)["score_counts_correct"].to_list() for trial in (0, 1))
    assert first != second


@pytest.mark.parametrize(
    "names",
    [("min_precision",), ("consensus",), ("fast.window_px", "sift"), ("min_precision", "consensus", "backend")],
)
def test_a_run_that_lacks_settings_goes_on_and_is_read_with_their_defaults(
    paper: Path, inputs: Inputs, tmp_path: Path, names: tuple[str, ...]
) -> None:
    written = _edit(paper, _without(*names))
    before = stored(paper)
    assert before["unit"].n_unique() == 2
    assert read_config(paper) == PAPER
    assert read_errors(paper).is_empty()
    progress = run_sweep(PAPER, inputs.manifest, paper, num_workers=1).progress
    assert (progress.num_done, progress.num_new) == (6, 4)
    assert (paper / "config.json").read_text() == written
    run_sweep(PAPER, inputs.manifest, tmp_path / "fresh", num_workers=1)
    assert stored(paper).equals(stored(tmp_path / "fresh"))
    assert stored(paper).filter(pl.col("unit").is_in(before["unit"].implode())).equals(before)


def test_a_setting_within_a_table_that_is_there_has_its_default_too(run: Path, inputs: Inputs) -> None:
    _edit(run, _without("consensus.num_rounds", "consensus.reach", "min_precision"))
    assert read_config(run) == CONFIG
    assert run_sweep(CONFIG, inputs.manifest, run, num_workers=1, limit=0).progress.num_done == 2


@pytest.mark.parametrize(
    ("names", "change", "difference"),
    [
        (["min_precision"], {"verdict": "score", "score": "learned", "min_precision": 0.9}, "min_precision is None"),
        (["consensus"], {"score": "consensus", "consensus": ConsensusConfig(slope=0.3)}, "consensus.slope is 0.2"),
        (["fast.window_px"], {"fast": FASTConfig(window_px=9)}, "fast.window_px is 11 there, 9 here"),
    ],
)
def test_another_value_of_a_setting_that_the_run_lacks_is_refused(
    run: Path, inputs: Inputs, names: list[str], change: dict[str, Any], difference: str
) -> None:
    """The run was made with the default, so a sweep with another value is another one."""
    other = SweepConfig(tuple(replace(trial, **change) for trial in PAPER.trials), export_matches=True)

    def make_older(config: dict[str, Any]) -> None:
        config["sweep"]["trials"] = json.loads(json.dumps([asdict(trial) for trial in other.trials]))
        _without(*names)(config)

    _edit(run, make_older)
    files = sorted(path for path in run.rglob("*.parquet"))
    with pytest.raises(ValueError, match="holds results of other settings") as error:
        run_sweep(other, inputs.manifest, run, num_workers=1)
    assert f"sweep.trials[0].{difference}" in str(error.value)
    assert "\n" not in str(error.value)
    assert sorted(path for path in run.rglob("*.parquet")) == files


def _add(name: str, value: Any) -> Edit:
    """Adds a dotted setting to the last trial."""

    def change(config: dict[str, Any]) -> None:
        *parents, last = name.split(".")
        place = config["sweep"]["trials"][-1]
        for parent in parents:
            place = place[parent]
        place[last] = value

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_add("sharpness", 3), ["setting sharpness is unknown to this release", "a later one has written the run"]),
        (_add("consensus.sharpness", None), ["setting consensus.sharpness is unknown"]),
        (_add("fast.sharpness", [1]), ["setting fast.sharpness is unknown"]),
        (lambda config: config.update(format=1), ["is a run of format 1, this release reads format 3"]),
        (lambda config: config.update(format=FORMAT + 1), ["format 4, this release reads format 3"]),
        (lambda config: config.pop("format"), ["format None, this release reads format 3"]),
    ],
)
def test_a_run_that_this_release_cannot_read_is_refused_in_one_line(
    run: Path, inputs: Inputs, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Edit, words: list[str]
) -> None:
    written = _edit(run, change)
    readers: list[Callable[[], object]] = [
        lambda: run_sweep(CONFIG, inputs.manifest, run, num_workers=1),
        lambda: read_results(run),
        lambda: read_config(run),
        lambda: read_errors(run),
        lambda: read_matches(run, "synthetic", "synthetic-00"),
    ]
    for read in readers:
        with pytest.raises(ValueError, match=words[0]) as error:
            read()
        assert str(run) in str(error.value)
        assert "\n" not in str(error.value)
    sweep = ["sweep", _write_settings(tmp_path), "--manifest", str(inputs.manifest), "--out", str(run)]
    fails([*sweep, "--workers", "1"], capsys, str(run), *words)
    fails(["report", str(run)], capsys, str(run), *words)
    assert (run / "config.json").read_text() == written
    assert not (run / "report.html").exists()
    assert not (run / "log.jsonl").read_text().count("start") > 1


def test_a_run_of_this_release_says_its_format(run: Path) -> None:
    config = read_config_file(run / "config.json")
    assert config["format"] == FORMAT == 3
    assert config == json.loads((run / "config.json").read_text())  # nothing to complete


def test_parts_that_lack_columns_are_read_with_their_settings_and_nulls(run: Path, inputs: Inputs) -> None:
    lacking = ("consensus_slope", "min_precision", "auc", "score_counts_correct", "attempt")
    complete = read_results(run)
    assert complete["consensus_slope"].null_count() == complete["auc"].null_count() == 0
    _drop_columns(run, *lacking)
    found = read_results(run)
    assert found.schema == complete.schema == pl.Schema(METRICS_SCHEMA)
    measured = ("auc", "score_counts_correct", "attempt")
    assert found.drop(measured).equals(complete.drop(measured))  # settings stand in the configuration
    assert all(found[name].null_count() == len(found) == 4 for name in measured)
    run_sweep(CONFIG, inputs.manifest, run, num_workers=1, verify=True)  # the parts are whole
    both = read_results(run)
    assert both.schema == complete.schema
    old, new = both.head(4), both.tail(-4)
    assert old.equals(found)
    assert len(new) == 4 * 2
    assert new["consensus_slope"].to_list() == [0.1, 0.3] * 4
    assert new["auc"].null_count() == new["attempt"].null_count() == 0


def test_parts_of_matches_that_lack_a_column_are_read_with_nulls(run: Path) -> None:
    complete = read_matches(run, "synthetic", "synthetic-00", trial=1)
    assert complete.matches.cost is not None
    _drop_columns(run, "correct")
    found = read_matches(run, "synthetic", "synthetic-00", trial=1)
    assert found.inlier.equal(complete.inlier)
    assert found.matches.keypoints0.equal(complete.matches.keypoints0)
    assert complete.valid.any()
    assert not found.valid.any()  # nothing is known of the truth


@pytest.mark.parametrize("names", [("min_precision",), ("min_precision", "target_sensitivity", "consensus")])
def test_a_run_that_lacks_settings_and_columns_has_its_report(
    paper: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], names: tuple[str, ...]
) -> None:
    main(["report", str(paper), "--out", str(tmp_path / "complete")])
    _edit(paper, _without(*names))
    _drop_columns(paper, *names, *(f"consensus_{name}" for name in vars(ConsensusConfig())))
    main(["report", str(paper), "--out", str(tmp_path / "lacking")])
    complete, lacking = (tmp_path / name / "report.md" for name in ("complete", "lacking"))
    assert lacking.read_text() == complete.read_text()
    assert capsys.readouterr().out.count("report.") == 4
