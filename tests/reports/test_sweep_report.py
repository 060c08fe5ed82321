from __future__ import annotations

import base64
import hashlib
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import polars as pl
import pytest
import torch

from tensor_stereo.reports.figures import draw_matches
from tensor_stereo.reports.sweep import data_tables, summary
from tensor_stereo.reports.sweep.data_tables import Column, script_json
from tensor_stereo.reports.sweep.overlays import draw_overlay
from tensor_stereo.reports.sweep.pooling import pool_trials
from tensor_stereo.reports.sweep.report import write_report
from tensor_stereo.reports.sweep.results import ERROR_COLUMNS, Overlay, RunResults
from tensor_stereo.reports.sweep.rows import RESULT_COLUMNS, RunRows
from tensor_stereo.types import Matches, StereoPair
from tests.reports.sweep_results import make_errors, make_grid, make_png, make_results, make_run, trials_of

HOSTILE = "</script><script>window.broken = 1</script><img src=x onerror='window.broken = 1'>\u2028&amp;"
GRID = make_grid(("sift", "fast"))


class Page(HTMLParser):
    """Elements, attributes and text of a page, as a browser splits it."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.texts: list[tuple[str, str]] = []
        self._open: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        self._open.append(tag)

    def handle_data(self, data: str) -> None:
        self.texts.append((self._open[-1] if self._open else "", data))

    def handle_endtag(self, tag: str) -> None:
        while self._open and self._open.pop() != tag:
            pass

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.tags if name == tag]

    def inside(self, tag: str) -> list[str]:
        return [text for name, text in self.texts if name == tag]

    def data(self) -> dict[str, Any]:
        """The tables that the script reads, by id."""
        return {table["id"]: table for table in json.loads(self.inside("script")[0])}


def render(runs: list[RunResults], folder: Path) -> tuple[Page, str]:
    html, markdown = (path.read_text(encoding="utf-8") for path in write_report(runs, folder))
    return Page(html), markdown


def cells(table: dict[str, Any]) -> list[list[Any]]:
    """Columns of a table as they were before they were packed."""
    return [
        [column["texts"][k] for k in column["values"]] if "texts" in column else column["values"]
        for column in table["columns"]
    ]


@pytest.fixture(scope="module")
def results() -> pl.DataFrame:
    return make_results(GRID, num_pairs=4)


def test_page_is_one_file_that_allows_itself_alone(results: pl.DataFrame, tmp_path: Path) -> None:
    page, _ = render([make_run("run", results)], tmp_path)
    assert not page.all("link")[1:]
    assert page.all("link")[0]["href"] == "data:,"
    assert all(image["src"].startswith("data:image/png;base64,") for image in page.all("img"))
    assert all(link["href"].startswith("#") for link in page.all("a"))
    assert {link["href"][1:] for link in page.all("a")} == {section["id"] for section in page.all("section")}
    policy = next(meta["content"] for meta in page.all("meta") if "http-equiv" in meta)
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    for name, text in (("style-src", page.inside("style")[0]), ("script-src", page.inside("script")[1])):
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert rules[name] == f"'sha256-{digest}'"
    assert not any(name.startswith("on") or name == "style" for _, attributes in page.tags for name in attributes)


def test_page_of_2000_rows_stays_below_2_mb(tmp_path: Path) -> None:
    grid = make_grid(outlier_rates=(0.0, 0.1, 0.2, 0.4), scores=("none", "topology"))
    run = make_run("run", make_results(grid, num_pairs=16))
    assert len(run.rows) >= 2000
    (page, _) = write_report([replace(run, overlays=())], tmp_path)
    assert page.stat().st_size < 2e6


def test_tables_of_the_page_hold_every_row(results: pl.DataFrame, tmp_path: Path) -> None:
    page, _ = render([make_run("run", results)], tmp_path)
    tables = page.data()
    headings = [column["heading"] for column in tables["pairs"]["columns"]]
    shown = dict(zip(headings, cells(tables["pairs"]), strict=True))
    assert shown["scene"] == results["scene"].to_list()
    assert shown["trial"] == results["trial"].to_list()
    assert shown["outliers"] == results["outlier_rate"].to_list()
    assert shown["sens."] == pytest.approx(results["sensitivity"].to_list(), abs=6e-5)
    assert shown["AUC"] == pytest.approx(results["auc"].to_list(), abs=6e-5)
    assert "window px" not in headings  # follows from the detector
    pooled = pool_trials(trials_of(results))
    trials = cells(tables["trials"])
    groups = [(column["group"], column["heading"]) for column in tables["trials"]["columns"]]
    for group, prefix in (("pairs pooled", ""), ("mean over pairs", "mean_")):
        for heading, name in (("spec.", "specificity"), ("spec.@.96", "specificity_at_sensitivity_96")):
            assert trials[groups.index((group, heading))] == pytest.approx(pooled[prefix + name].to_list(), abs=6e-5)
    failures = cells(tables["failures"])
    assert failures[-2] == make_errors()["message"].to_list()


def test_undefined_numbers_are_null(results: pl.DataFrame, tmp_path: Path) -> None:
    page, _ = render([make_run("run", results.with_columns(ppv=pl.lit(math.nan)))], tmp_path)
    column = next(column for column in page.data()["pairs"]["columns"] if column["heading"] == "PPV")
    assert set(column["values"]) == {None}


def test_a_page_of_too_many_rows_says_so(
    results: pl.DataFrame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(data_tables, "MAX_ROWS", 20)
    run = make_run("run", results)
    page, _ = render([run], tmp_path)
    assert len(page.data()["pairs"]["columns"][0]["values"]) == 20
    assert f"The first 20 of {len(results)} rows" in "".join(page.inside("p"))
    both, _ = render([run, run], tmp_path)
    assert cells(both.data()["pairs"])[0] == ["A"] * 10 + ["B"] * 10


def test_of_many_failures_the_first_are_shown_and_all_are_counted(
    results: pl.DataFrame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (data_tables, summary):
        monkeypatch.setattr(module, "MAX_FAILURES", 3)
    run = make_run("run", results, num_errors=7)
    page, markdown = render([replace(run, errors=run.errors.reverse())], tmp_path)
    assert cells(page.data()["failures"])[1] == ["frame_9000", "frame_9001", "frame_9002"]
    assert "The first 3 of 7 rows" in "".join(page.inside("p"))
    assert "the first 3 of 7 failed units" in markdown
    counted = [re.sub(r"\s+", " ", line) for line in markdown.splitlines()]
    assert {"| read | ValueError | 4 |", "| detect | MemoryError | 3 |"} <= set(counted)


def test_nothing_in_the_data_becomes_markup(results: pl.DataFrame, tmp_path: Path) -> None:
    evil = pl.lit(HOSTILE).alias
    run = RunResults(
        name=HOSTILE,
        rows=RunRows.of(
            results.with_columns(evil("scene"), evil("dataset"), evil("score"), host=pl.col("host") + HOSTILE)
        ),
        errors=make_errors().with_columns(evil("scene"), evil("message"), evil("stage"), evil("error")),
        config={HOSTILE: HOSTILE},
        environment=[{HOSTILE: HOSTILE}],
        overlays=(Overlay(HOSTILE, make_png()),),
    )
    other = replace(run, rows=RunRows.of(results.with_columns(scene=pl.lit("one more"))))
    for runs in ([run], [run, run], [run, other]):
        page, markdown = render(runs, tmp_path)
        assert len(page.all("script")) == 2
        assert all(image["src"].startswith("data:") for image in page.all("img"))
        assert not any("onerror" in attributes for _, attributes in page.tags)
        assert page.inside("title")[0] == f"Sweep report: {' and '.join(run.name for run in runs)}"
        assert HOSTILE in cells(page.data()["failures"])[-2]
        assert HOSTILE in (page.all("img")[0]["alt"])
        assert any(HOSTILE in json.loads(text) for text in page.inside("pre"))
        assert not re.search(r"(?<!\\)<", markdown)


def test_json_reads_back_and_holds_no_markup() -> None:
    value = {"a": [HOSTILE, 1.5, None], "b": "<!-- -->"}
    text = script_json(value)
    assert json.loads(text) == value
    assert not re.search("[<>&\u2028\u2029]", text)
    with pytest.raises(ValueError, match="not JSON compliant"):
        script_json(math.nan)


def test_texts_are_packed_and_mixed_columns_stay_texts() -> None:
    payload = Column("scene", ["b", "a", "b"]).payload()
    assert payload["texts"] == ["b", "a"]
    assert payload["values"] == [0, 1, 0]
    assert Column("x", [0.123456, None, math.nan, 7], decimals=2).payload()["values"] == [0.123, None, None, 7]


def test_two_runs_are_compared(results: pl.DataFrame, tmp_path: Path) -> None:
    better = make_results([*GRID[4:], GRID[0] | {"noise_px": 1.0}], num_pairs=3, gain=1.0)
    page, markdown = render([make_run("old", results), make_run("new", better)], tmp_path)
    tables = page.data()
    assert tables["differences"]["columns"][0]["values"] == list(range(4, len(GRID)))
    assert tables["differences"]["columns"][1]["values"] == list(range(len(GRID) - 4))
    runs, trials = cells(tables["only"])[:2]
    assert list(zip(runs, trials, strict=True)) == [*(("A", k) for k in range(4)), ("B", len(GRID) - 4)]
    text = " ".join(page.inside("p"))
    assert "Pairs in both runs: 3. Only in A: middlebury-2005/Dolls." in text
    assert "**B \\- A" in markdown or "**B - A" in markdown
    assert "A: old" in markdown


def test_runs_without_common_settings_say_so(results: pl.DataFrame, tmp_path: Path) -> None:
    other = make_results(make_grid(("gftt",)), num_pairs=4)
    page, _ = render([make_run("a", results), make_run("b", other)], tmp_path)
    assert "The runs have no point of settings in common." in page.inside("p")
    assert "differences" not in page.data()


def test_markdown_has_summary_and_pooled_tables(results: pl.DataFrame, tmp_path: Path) -> None:
    _, markdown = render([make_run("base_line", results)], tmp_path)
    assert markdown.startswith("# Sweep report: base\\_line\n")
    titles = re.findall(r"^\*\*(.*)\*\*$", markdown, re.MULTILINE)
    assert [title.removeprefix("base\\_line: ") for title in titles] == [
        "Runs",
        "Settings",
        "highest mean of sensitivity and specificity on the mildest perturbation, pairs pooled",
        "trials, pairs pooled",
        "trials, mean over the pairs",
        "Run-time in ms per pair, mean over the trials in which a stage ran",
        "pairs on which even the best trial does badly",
        "failed units by error",
        "failed units",
        "environment",
    ]
    pooled = markdown.split("trials, pairs pooled**\n\n")[1].split("\n\n")[0].splitlines()
    assert len(pooled) == 2 + len(GRID)
    row = pool_trials(trials_of(results)).row(0, named=True)
    assert f"| {row['sensitivity']:.3f} | {row['specificity']:.3f} |" in re.sub(" +", " ", pooled[2])


def test_line_breaks_of_messages_do_not_break_markdown_tables(results: pl.DataFrame, tmp_path: Path) -> None:
    errors = make_errors(1).with_columns(message=pl.lit("first\nsecond | third"))
    _, markdown = render([replace(make_run("run", results), errors=errors)], tmp_path)
    assert "first second \\| third" in markdown


@pytest.mark.parametrize("num_errors", [0, 3])
def test_run_without_results_has_a_report(tmp_path: Path, num_errors: int, results: pl.DataFrame) -> None:
    run = make_run("empty", results.clear(), num_errors=num_errors)
    page, markdown = render([run], tmp_path)
    assert set(page.data()) == ({"failures"} if num_errors else set())
    assert "pairs pooled" not in markdown
    both, _ = render([make_run("full", results), run], tmp_path)
    assert "Pairs in both runs: 0." in "".join(both.inside("p"))
    render([run, make_run("full", results)], tmp_path)
    render([run, run], tmp_path)


def test_run_without_ground_truth_has_a_report(tmp_path: Path, results: pl.DataFrame) -> None:
    rates = ("fraction_incorrect", "sensitivity", "specificity", "ppv", "npv", "auc", "specificity_at_sensitivity_96")
    counts = ("num_valid", "true_positive", "false_positive", "true_negative", "false_negative")
    unknown = results.with_columns(
        *(pl.lit(math.nan).alias(name) for name in rates),
        *(pl.lit(0, pl.Int64).alias(name) for name in counts),
        *(pl.col(f"score_counts_{name}").list.eval(pl.element() * 0) for name in ("correct", "incorrect")),
    )
    page, _ = render([make_run("run", unknown)], tmp_path)
    assert len(page.data()["pairs"]["columns"][0]["values"]) == len(results)


def test_equal_runs_give_equal_files(results: pl.DataFrame, tmp_path: Path) -> None:
    shuffled = results.sample(fraction=1, shuffle=True, seed=0)  # as parts of other shards would lie
    reports = [write_report([make_run("run", rows)], tmp_path / f"{k}") for k, rows in enumerate((results, shuffled))]
    first, second = ([path.read_bytes() for path in paths] for paths in reports)
    assert first == second


def test_hosts_whose_times_are_mixed_are_named(results: pl.DataFrame, tmp_path: Path) -> None:
    page, _ = render([make_run("run", results)], tmp_path)
    assert "Times of 2 hosts are mixed: node-0, node-1." in page.inside("p")
    page, _ = render([make_run("run", results.with_columns(host=pl.lit("here")))], tmp_path)
    assert "mixed" not in "".join(page.inside("p"))


def test_overlay_is_the_picture_of_the_matches() -> None:
    points = torch.tensor([[3.0, 4.0], [9.0, 2.0], [15.0, 8.0]])
    image = torch.zeros(1, 20, 30, dtype=torch.uint8)
    kept, right, known = torch.tensor([[True, False, True], [True, True, False], [True, True, False]])
    matches = Matches(points, points, torch.tensor([0, 3]))
    figure = draw_matches(image, image, matches, kept, correct=right, valid=known, title="A pair")
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[:4] == ["kept, incorrect: 0", "kept, correct: 1", "rejected, incorrect: 0", "rejected, correct: 1"]
    assert labels[4:] == ["kept, unknown: 1"]
    overlay = draw_overlay(StereoPair("Art", image, image), matches, kept, right, known, caption="Art")
    assert overlay == draw_overlay(StereoPair("Art", image, image), matches, kept, right, known, caption="Art")
    with pytest.raises(ValueError, match=r"inlier must have shape \(3,\)"):
        draw_matches(image, image, matches, kept[:2], correct=right, valid=known)
    with pytest.raises(TypeError, match="image1 must be uint8"):
        draw_matches(image, image.float(), matches, kept, correct=right, valid=known)


def test_wrong_input_is_named(results: pl.DataFrame, tmp_path: Path) -> None:
    run = make_run("run", results)
    for runs in ([], [run] * 3):
        with pytest.raises(ValueError, match="runs must hold one or two runs, got"):
            write_report(runs, tmp_path)
    with pytest.raises(ValueError, match="results must have the columns auc, host, got unit, "):
        RunRows.of(results.drop("auc", "host"))
    with pytest.raises(ValueError, match="errors must have the columns message, got unit, "):
        replace(run, errors=run.errors.drop("message"))
    with pytest.raises(ValueError, match="one row per unit and trial, got unit 0, trial 0 twice"):
        RunRows.of(pl.concat([results, results.head(1)]))
    short = results.with_columns(pl.col("score_counts_correct").list.head(5))
    with pytest.raises(ValueError, match="128 bins in score_counts_correct, got 5"):
        RunRows.of(short)
    with pytest.raises(ValueError, match="png of 'Art' must be a PNG file, got b'GIF89a'"):
        Overlay("Art", b"GIF89a")
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        write_report([run], tmp_path / "file")
    assert set(RESULT_COLUMNS) <= set(results.columns)
    assert set(ERROR_COLUMNS) == set(run.errors.columns)
