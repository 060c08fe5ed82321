from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from tensor_stereo.reports.sweep.report import write_report
from tensor_stereo.reports.sweep.results import RunResults
from tests.reports.browser import NAMES, Browser, find_browser
from tests.reports.sweep_results import make_grid, make_results, make_run

pytestmark = pytest.mark.browser

GRID = make_grid(("sift", "fast"), scores=("none", "topology"), outlier_rates=(0.0, 0.3))
ENTER, SPACE = ("Enter", 13, "\r"), (" ", 32, " ")


@pytest.fixture(scope="module")
def results() -> pl.DataFrame:
    """Scenes whose numbers sort as numbers, and some undefined rates."""
    names = {"Art": "frame 10", "Books": "frame 9", "Cones": "frame 100", "Dolls": "Frame 1"}
    undefined = pl.when(pl.col("trial") % 5 == 0).then(float("nan")).otherwise("ppv").alias("ppv")
    return make_results(GRID, num_pairs=4).with_columns(pl.col("scene").replace(names), undefined)


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    path = find_browser()
    if path is None:
        pytest.skip(f"none of {', '.join(NAMES)} is on the PATH")
    browser = Browser(path, tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


class Report:
    """A report in the browser."""

    def __init__(self, browser: Browser, path: Path) -> None:
        self.browser = browser
        self.path = path
        browser.events.clear()
        browser.show(1400)
        browser.open(path)
        (data,) = re.findall(r'id="data">(.*?)</script>', path.read_text(encoding="utf-8"))
        self.tables = {table["id"]: table for table in json.loads(data)}

    def columns(self, table: str) -> dict[str, list[Any]]:
        """What the page was given, by heading."""
        return {
            column["heading"]: [column["texts"][k] for k in column["values"]] if "texts" in column else column["values"]
            for column in self.tables[table]["columns"]
        }

    def head(self, table: str, heading: str) -> str:
        """Selector of a heading."""
        place = [column["heading"] for column in self.tables[table]["columns"]].index(heading)
        return f"#table-{table} thead tr:last-child th:nth-child({place + 1})"

    def sorting(self, table: str) -> dict[str, str]:
        """The headings that say how the table is sorted."""
        heads = f"[...document.querySelectorAll('#table-{table} th[aria-sort]')]"
        found = self.browser.run(f"{heads}.map(h => [h.textContent, h.ariaSort])")
        return {heading: state for heading, state in found if state != "none"}

    def rows(self, table: str) -> list[list[str]]:
        """Texts of the rows that are in the document."""
        rows = f"[...document.querySelectorAll('#table-{table} tbody tr')]"
        found: list[list[str]] = self.browser.run(f"{rows}.map(r => [...r.children].map(c => c.textContent))")
        return found

    def all_rows(self, table: str) -> list[list[str]]:
        """Texts of all rows, page by page."""
        turn = f"#table-{table} .pager button:nth-child(2)"
        rows = self.rows(table)
        while not self.browser.run(f"document.querySelector('{turn}').disabled"):
            self.browser.click(turn)
            rows += self.rows(table)
        return rows

    def column(self, table: str, heading: str, rows: list[list[str]]) -> list[str]:
        place = [column["heading"] for column in self.tables[table]["columns"]].index(heading)
        return [row[place] for row in rows]

    def status(self, table: str) -> str:
        text: str = self.browser.run(f"document.querySelector('#table-{table} [role=status]').textContent")
        return text

    def choose(self, table: str, label: str, option: str) -> None:
        """Pick an entry of a list as a user does: the browser fires the event."""
        labels = f"[...document.querySelectorAll('#table-{table} .controls label')]"
        select = f"{labels}.find(l => l.firstChild.textContent === {json.dumps(label)}).querySelector('select')"
        place = self.browser.run(f"[...{select}.options].findIndex(o => o.text === {json.dumps(option)})")
        assert place >= 0
        self.browser.run(f"({select}.selectedIndex = {place}, {select}.dispatchEvent(new Event('change')))")


@pytest.fixture
def opened(chromium: Browser, tmp_path: Path) -> Callable[..., Report]:
    """Writes the report of some runs and opens it."""
    return lambda *runs: Report(chromium, write_report(runs, tmp_path)[0])


def natural(value: Any) -> Any:
    """Numbers inside names count as numbers, case does not."""
    if not isinstance(value, str):
        return value
    return [
        (0, int(part), "") if part.isdigit() else (1, 0, part.lower()) for part in re.split(r"(\d+)", value) if part
    ]


def in_order(values: list[Any], *, descending: bool) -> list[int]:
    """Rows by value; equal ones as they were, those without a value last."""
    known = [row for row, value in enumerate(values) if value is not None]
    unknown = [row for row, value in enumerate(values) if value is None]
    return sorted(known, key=lambda row: natural(values[row]), reverse=descending) + unknown


@pytest.mark.parametrize("num_runs", [1, 2])
def test_page_works_without_complaint_or_request(
    opened: Callable[..., Report], results: pl.DataFrame, num_runs: int
) -> None:
    report = opened(*[make_run(f"run {k}", results) for k in range(num_runs)])
    for table in report.tables:
        total = len(report.tables[table]["columns"][0]["values"])
        assert len(report.rows(table)) == min(total, 50)
        for column in report.tables[table]["columns"]:
            report.browser.click(f"{report.head(table, column['heading'])} button")
    assert report.browser.complaints() == []
    assert {url for url in report.browser.requests() if not url.startswith("data:")} == {report.path.as_uri()}


def test_click_on_a_heading_sorts_as_python_does(opened: Callable[..., Report], results: pl.DataFrame) -> None:
    report = opened(make_run("run", results))
    columns = report.columns("pairs")
    identity = list(zip(columns["scene"], columns["trial"], strict=True))
    assert None in columns["PPV"]
    assert None in columns["AUC"]
    for heading, values in columns.items():
        for state in ("ascending", "descending"):
            report.browser.click(f"{report.head('pairs', heading)} button")
            assert report.sorting("pairs") == {heading: state}
            rows = report.all_rows("pairs")
            scenes, trials = report.column("pairs", "scene", rows), report.column("pairs", "trial", rows)
            shown = list(zip(scenes, map(int, trials), strict=True))
            assert shown == [identity[row] for row in in_order(values, descending=state == "descending")]


def test_keyboard_sorts_and_keeps_the_focus(opened: Callable[..., Report], results: pl.DataFrame) -> None:
    report = opened(make_run("run", results))
    button = f"{report.head('pairs', 'spec.')} button"
    report.browser.run(f"document.querySelector('{button}').focus()")
    for key, state in ((ENTER, "ascending"), (SPACE, "descending"), (ENTER, "ascending")):
        report.browser.press(*key)
        assert report.sorting("pairs") == {"spec.": state}
        assert report.browser.run(f"document.activeElement === document.querySelector('{button}')")
    report.browser.press("Tab", 9)
    report.browser.press(*ENTER)
    assert report.sorting("pairs") == {"PPV": "ascending"}


def test_words_and_lists_filter(opened: Callable[..., Report], results: pl.DataFrame) -> None:
    report = opened(make_run("run", results))
    columns = report.columns("pairs")
    report.browser.click("#table-pairs input")
    report.browser.type("FRAME 9 sift")
    rows = report.all_rows("pairs")
    expected = [
        (scene, str(trial))
        for scene, trial, detector in zip(columns["scene"], columns["trial"], columns["detector"], strict=True)
        if "9" in scene and detector == "sift"
    ]
    found = zip(report.column("pairs", "scene", rows), report.column("pairs", "trial", rows), strict=True)
    assert list(found) == expected
    report.choose("pairs", "outliers", "0.3")
    report.choose("pairs", "score", "none")
    rows = report.all_rows("pairs")
    assert set(report.column("pairs", "outliers", rows)) == {"0.3"}
    assert set(report.column("pairs", "score", rows)) == {"none"}
    assert len(rows) == len(expected) // 4
    assert report.status("pairs") == f"Rows 1 to {len(rows)} of {len(rows)} ({len(results)} without filter)"
    report.browser.click(f"{report.head('pairs', 'sens.')} button")
    shown = report.column("pairs", "sens.", report.rows("pairs"))
    assert shown == sorted(shown)
    assert len(shown) == len(rows)
    report.browser.click("#table-pairs input")
    report.browser.type(" nowhere")
    assert report.rows("pairs") == []
    assert report.status("pairs") == f"Rows 0 ({len(results)} without filter)"


def test_lists_offer_every_value_in_order(opened: Callable[..., Report], results: pl.DataFrame) -> None:
    frame = results.with_columns(threshold=pl.when(pl.col("trial") % 3 > 0).then(pl.col("trial") % 3 * 5.0))
    report = opened(make_run("run", frame))
    options = "[...document.querySelectorAll('#table-trials .controls label')].map(l => [l.firstChild.textContent, "
    found = dict(report.browser.run(f"{options}[...l.querySelectorAll('option')].map(o => o.text)])"))
    assert found["threshold"] == ["all", "5", "10", "–"]
    assert found["outliers"] == ["all", "0", "0.3"]
    assert found["detector"] == ["all", "fast", "sift"]


def test_ten_thousand_rows_are_paged(opened: Callable[..., Report], results: pl.DataFrame) -> None:
    copies = 10_000 // len(results) + 1
    many = pl.concat(
        results.with_columns(unit=pl.col("unit") + 1000 * k, scene=pl.format("{} copy {}", "scene", pl.lit(k)))
        for k in range(copies)
    )
    report = opened(make_run("run", many))
    assert report.browser.run("document.querySelectorAll('tbody tr').length") < 300
    report.browser.click(f"{report.head('pairs', 'AUC')} button")
    report.browser.click(f"{report.head('pairs', 'AUC')} button")
    values = report.columns("pairs")["AUC"]
    order = in_order(values, descending=True)[:50]
    assert report.column("pairs", "AUC", report.rows("pairs")) == [f"{values[row] + 1e-9:.3f}" for row in order]
    assert report.status("pairs") == f"Rows 1 to 50 of {len(many):,}"


def test_names_of_scenes_run_nothing(opened: Callable[..., Report], results: pl.DataFrame) -> None:
    hostile = "</script><script>window.broken = 1</script><img src=x onerror='window.broken = 1'>"
    run = make_run(hostile, results.with_columns(scene=pl.lit(hostile)))
    report = opened(RunResults(run.name, run.rows, run.errors.with_columns(message=pl.lit(hostile)), {}, []))
    assert report.browser.run("typeof window.broken") == "undefined"
    assert set(report.column("pairs", "scene", report.rows("pairs"))) == {hostile}
    assert report.browser.complaints() == []
    assert report.browser.requests() == [report.path.as_uri()]


def test_policy_stops_scripts_and_requests(opened: Callable[..., Report], results: pl.DataFrame) -> None:
    report = opened(make_run("run", results))
    browser = report.browser
    assert browser.run("fetch('http://127.0.0.1:9/').then(() => 'sent', e => e.name)") == "TypeError"
    add = "(s => (s.textContent = 'window.broken = 1', document.body.append(s)))(document.createElement('script'))"
    browser.run(add)
    browser.run("document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=\"window.broken = 1\">')")
    assert browser.run("typeof window.broken") == "undefined"
    assert any("Content Security Policy" in text for text in browser.complaints())
    assert not any(url.startswith("http") for url in browser.requests())


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_page_fits_narrow_windows_in_both_schemes(
    opened: Callable[..., Report], results: pl.DataFrame, scheme: str
) -> None:
    report = opened(make_run("a run with a rather long name", results), make_run("b", results))
    for width in (360, 800, 1400):
        report.browser.show(width, scheme=scheme)
        assert report.browser.run("document.documentElement.scrollWidth") <= width
    background = report.browser.run("getComputedStyle(document.body).backgroundColor")
    assert background == {"light": "rgb(255, 255, 255)", "dark": "rgb(13, 17, 23)"}[scheme]
    assert report.browser.picture().startswith(b"\x89PNG")


def test_click_enlarges_a_picture(opened: Callable[..., Report], results: pl.DataFrame) -> None:
    report = opened(make_run("run", results))
    width = "document.querySelector('.overlays img').getBoundingClientRect().width"
    small = report.browser.run(width)
    report.browser.click(".overlays button")
    assert report.browser.run(width) > 1.8 * small
    report.browser.click(".overlays button")
    assert report.browser.run(width) == small
