from __future__ import annotations

import itertools
import math
import re
from importlib.resources import files
from xml.etree import ElementTree

import numpy as np
import polars as pl
import pytest

from tensor_stereo.evaluation.rows import STAGES
from tensor_stereo.reports.sweep.curve_figures import curve_figures
from tensor_stereo.reports.sweep.curves import detector_curves
from tensor_stereo.reports.sweep.drawing import MAX_SERIES, PAPER_CLAIM
from tensor_stereo.reports.sweep.figures import perturbation_figures, runtime_figure, scatter_figure
from tensor_stereo.reports.sweep.pooling import pool_trials, stage_times
from tensor_stereo.reports.sweep.svg import NUM_COLORS, Axis, Key, Plot, legend, log_axis, name_axis, rate_axis
from tests.reports.sweep_results import make_grid, make_results, make_run, trials_of

GRID = make_grid(("sift", "fast"), outlier_rates=(0.0, 0.2, 0.4))
Points = list[tuple[float, float]]


@pytest.fixture(scope="module")
def results() -> pl.DataFrame:
    return make_results(GRID, num_pairs=4)


class Drawn:
    """A plot read back: what its ticks say about where everything lies."""

    def __init__(self, svg: ElementTree.Element) -> None:
        self.svg = svg
        self.label = svg.attrib["aria-label"]
        texts = [(item.get("class"), item) for item in svg.iter("text")]
        self.title = next(item.text for name, item in texts if name == "title")
        self.x_ticks = [(item.text, float(item.attrib["x"])) for name, item in texts if name == "tick"]
        self.y_ticks = [(item.text, float(item.attrib["y"]) - 3.5) for name, item in texts if name == "tick y"]

    def values(self, points: Points) -> Points:
        """Data coordinates of points in px, on linear axes."""
        (x0, left), (x1, right) = [(float(text or ""), at) for text, at in (self.x_ticks[0], self.x_ticks[-1])]
        (y0, bottom), (y1, top) = [(float(text or ""), at) for text, at in (self.y_ticks[0], self.y_ticks[-1])]
        return [
            (x0 + (x - left) / (right - left) * (x1 - x0), y0 + (y - bottom) / (top - bottom) * (y1 - y0))
            for x, y in points
        ]

    def paths(self, kind: str) -> list[tuple[set[str], Points, str]]:
        """Classes, points and tip of each path of a class."""
        found = []
        for path in self.svg.iter("path"):
            names = set(path.attrib["class"].split())
            if kind in names:
                start = re.match(r"M[-\d.]+ [-\d.]+", path.attrib["d"]) if kind == "mark" else None
                numbers = re.findall(r"-?[\d.]+", start.group() if start else path.attrib["d"])
                points = [(float(x), float(y)) for x, y in zip(numbers[::2], numbers[1::2], strict=True)]
                found.append((names, points, path.findtext("title") or ""))
        return found


def plots(html: str) -> list[Drawn]:
    return [Drawn(ElementTree.fromstring(svg)) for svg in re.findall(r'<svg class="plot".*?</svg>', html, re.DOTALL)]


def legend_texts(html: str) -> list[str]:
    return ["".join(item.itertext()) for item in ElementTree.fromstring(f"<div>{html}</div>").iter("li")]


def off(points: Points, line: Points) -> float:
    """The largest distance of some points from the nearest of others."""
    return max(min(math.dist(point, corner) for corner in line) for point in points)


def defined(xs: np.ndarray, ys: np.ndarray) -> Points:
    return [(x, y) for x, y in zip(xs, ys, strict=True) if not math.isnan(y)]


def test_curves_and_verdicts_lie_where_the_counts_say(results: pl.DataFrame) -> None:
    found = detector_curves(trials_of(results))
    drawn = plots(curve_figures([make_run("run", results)]))
    assert [plot.title for plot in drawn] == [
        f"{name}: {kind}" for name in ("SIFT", "FAST") for kind in ("ROC", "precision-recall")
    ]
    for item, (roc, recall) in zip(found, zip(drawn[::2], drawn[1::2], strict=True), strict=True):
        assert len(item.curves) == 2
        for k, curve in enumerate(item.curves):
            expected = (
                (roc, defined(1 - curve.specificity, curve.sensitivity)),
                (recall, defined(curve.specificity, curve.precision)),
            )
            for plot, points in expected:
                ((_, line, _),) = [path for path in plot.paths("line") if f"c{k}" in path[0]]
                assert off(plot.values(line), points) < 1e-3
                assert off(points, plot.values(line)) < 1e-3
            assert f"AUC {curve.auc:.3f}" in roc.label
            marks = [path for path in roc.paths("mark") if f"c{k}" in path[0]]
            assert len(marks) == len(curve.trials) == 2
            expected_marks = [(1 - row["specificity"], row["sensitivity"]) for row in curve.trials]
            assert off([roc.values(points)[0] for _, points, _ in marks], expected_marks) < 1e-3
            for row, (*_, tip) in zip(curve.trials, marks, strict=True):
                assert f"sensitivity {row['sensitivity']:.3f}" in tip
        ((_, star, _),) = [path for path in roc.paths("mark") if path[2] == PAPER_CLAIM]
        assert off(roc.values(star), [(0.30, 0.96)]) < 1e-3


def test_marks_tell_how_each_verdict_was_reached() -> None:
    """Disc, triangle and diamond, as the legend says; the diamond lies on the curve of its score."""
    grid = make_grid(
        ("fast",), verdicts=("score", "adjacency", "cardinality"), scores=("learned",), outlier_rates=(0.0,)
    )
    results = make_results(grid, num_pairs=3)
    html = curve_figures([make_run("run", results)])
    assert "verdict by score" in legend_texts(html)
    roc, _ = plots(html)
    shapes: dict[str, set[str]] = {}
    for path in roc.svg.iter("path"):
        place = re.match(r"trial (\d+)\n", path.findtext("title") or "")
        if place:
            outline = re.sub(r"^M[-\d.]+ [-\d.]+", "", path.attrib["d"])  # without where it lies
            shapes.setdefault(grid[int(place.group(1))]["verdict"], set()).add(outline)
    assert shapes.keys() == {"score", "adjacency", "cardinality"}
    assert all(len(found) == 1 for found in shapes.values())
    assert len(set.union(*shapes.values())) == 3
    lines = [roc.values(points) for names, points, _ in roc.paths("line") if "chance" not in names]
    for row in pool_trials(trials_of(results)).filter(verdict="score").iter_rows(named=True):
        point = (1 - row["specificity"], row["sensitivity"])
        assert min(off([point], line) for line in lines) < 2e-3


def test_curves_of_two_runs_share_colours_and_differ_in_their_lines(results: pl.DataFrame) -> None:
    html = curve_figures([make_run("a", results), make_run("b", make_results(GRID, num_pairs=3, gain=1.0))])
    for plot in plots(html):
        styles = [names for names, *_ in plot.paths("line") if "chance" not in names]
        assert sorted(map(sorted, styles)) == sorted(
            [["c0", "line"], ["c1", "line"], ["c0", "dashed", "line"], ["c1", "dashed", "line"]]
        )
    assert "A: constrained: AUC" in html
    assert "B: constrained: AUC" in html


def test_what_tells_two_runs_apart_is_left_to_their_letters(results: pl.DataFrame) -> None:
    other = make_results([trial | {"max_disparity_px": None} for trial in GRID], num_pairs=4)
    runs = [make_run("a", results), make_run("b", other)]
    for html in (curve_figures(runs), perturbation_figures(runs, "outlier_rate")):
        assert not any("disparity" in text for text in legend_texts(html))
        assert any(text.startswith("B: constrained") for text in legend_texts(html))


def test_many_scores_show_the_best_and_say_so() -> None:
    scores = [f"score-{k}" for k in range(MAX_SERIES + 2)]
    results = make_results(make_grid(("fast",), outlier_rates=(0.0,), scores=scores), num_pairs=2)
    html = curve_figures([make_run("run", results)])
    (item,) = detector_curves(trials_of(results))
    assert len(item.curves) == 2 * (MAX_SERIES + 2)
    assert f"The {MAX_SERIES} curves with the largest area of {len(item.curves)}." in html
    areas = [float(text.rpartition("AUC ")[2]) for text in legend_texts(html) if "AUC" in text]
    assert areas == [round(curve.auc, 3) for curve in item.curves[:MAX_SERIES]]


def test_scatter_has_every_trial_and_the_claim_of_the_paper(results: pl.DataFrame) -> None:
    html = scatter_figure([make_run("run", results)])
    (plot,) = plots(html)
    pooled = pool_trials(trials_of(results))
    *marks, star = plot.paths("mark")
    assert off(plot.values(star[1]), [(0.96, 0.70)]) < 1e-3
    assert star[2] == PAPER_CLAIM
    assert PAPER_CLAIM in legend_texts(html)
    assert len(marks) == len(pooled)
    for row, (names, points, tip) in zip(pooled.iter_rows(named=True), marks, strict=True):
        assert off(plot.values(points), [(row["sensitivity"], row["specificity"])]) < 1e-3
        assert ("full" in names) == (row["variant"] == "constrained")
        assert tip.startswith(f"trial {row['trial']}: {row['detector']}, ")


def test_run_times_lie_on_a_logarithmic_axis(results: pl.DataFrame) -> None:
    (plot,) = plots(runtime_figure([make_run("run", results)]))
    times = stage_times(trials_of(results))
    stages = [text for text, _ in plot.y_ticks]
    assert stages == times.columns[1:]
    ((low, left), *_, (high, right)) = [(math.log10(float(text or "")), at) for text, at in plot.x_ticks]
    marks = plot.paths("mark")
    expected = [(stage, row[stage]) for row in times.iter_rows(named=True) for stage in stages]
    assert len(marks) == len(expected)
    for (stage, value), (_, ((x, y),), _) in zip(expected, marks, strict=True):
        assert low + (x - left) / (right - left) * (high - low) == pytest.approx(math.log10(value), abs=3e-3)
        assert min(plot.y_ticks, key=lambda tick: abs(tick[1] - y))[0] == stage
    never = results.with_columns(pl.struct(pl.lit(0.0).alias(name) for name in STAGES).alias("seconds"))
    assert runtime_figure([make_run("run", never)]) == ""


def test_rates_follow_the_outliers(results: pl.DataFrame) -> None:
    drawn = plots(perturbation_figures([make_run("run", results)], "outlier_rate"))
    assert len(drawn) == 2 * 4
    pooled = pool_trials(trials_of(results))
    for plot in drawn:
        assert [text for text, _ in plot.x_ticks] == ["0", "0.2", "0.4"]
        detector, _, heading = (plot.title or "").partition(": ")
        name = {"AUC": "auc", "specificity at sensitivity .96": "specificity_at_sensitivity_96"}.get(heading, heading)
        rows = pooled.filter(pl.col("detector") == detector.lower())
        points = [plot.values(points)[0] for _, points, _ in plot.paths("mark")]
        expected = list(rows.select("outlier_rate", name).iter_rows())
        assert off(points, expected) < 2e-3
        assert off(expected, points) < 2e-3
        assert len(plot.paths("line")) == 4
    assert perturbation_figures([make_run("run", results)], "noise_px") == ""


def test_noise_has_figures_of_its_own() -> None:
    grid = [trial | {"noise_px": noise} for trial in make_grid(("gftt",), outlier_rates=(0.0,)) for noise in (0.0, 0.5)]
    html = perturbation_figures([make_run("run", make_results(grid, num_pairs=2))], "noise_px")
    assert "noise of the keypoints in px" in html


def test_every_plot_has_a_text_alternative_and_every_figure_a_caption(results: pl.DataFrame) -> None:
    run = make_run("run", results)
    parts = (
        curve_figures([run]),
        scatter_figure([run]),
        runtime_figure([run]),
        perturbation_figures([run], "outlier_rate"),
    )
    for html in parts:
        assert html.count("<figure>") == html.count("<figcaption>") > 0
        for plot in plots(html):
            assert plot.svg.attrib["role"] == "img"
            assert len(plot.label) > 40


def test_text_from_data_is_escaped() -> None:
    grid = make_grid(("fast",), scores=('<b>&"x"', "plain"))
    run = make_run("run", make_results(grid, num_pairs=2))
    for html in (curve_figures([run]), scatter_figure([run]), perturbation_figures([run], "outlier_rate")):
        assert "<b>" not in html
        assert "&lt;b&gt;" in html
        ElementTree.fromstring(f"<div>{html}</div>")


def test_undefined_points_break_lines_and_leave_no_mark() -> None:
    plot = Plot(rate_axis("x"), rate_axis("y"), title="t", description="d")
    plot.line([0, 0.2, 0.4, 0.6], [0.1, math.nan, 0.3, 0.5], Key("", "c0"))
    plot.mark(math.nan, 0.5, Key("", "c0"))
    (drawn,) = plots(plot.render())
    ((_, points, _),) = drawn.paths("line")
    assert off(drawn.values(points), [(0, 0.1), (0.4, 0.3), (0.6, 0.5)]) < 1e-3
    assert drawn.paths("mark") == []
    (path,) = (path.attrib["d"] for path in drawn.svg.iter("path") if "line" in path.attrib["class"])
    assert path.count("M") == 2


def test_axes_cover_their_values() -> None:
    assert [text for _, text in log_axis("ms", [0.02, 3.0]).ticks] == ["0.01", "0.1", "1", "10"]
    assert log_axis("ms", [1.0]).place([1.0, 10.0], 0, 100) == [0.0, 100.0]
    assert [value for value, _ in rate_axis("x", [0.83, 0.96, math.nan]).ticks] == pytest.approx([0.8, 0.9, 1.0])
    assert rate_axis("x", [1.0]).low == 0.9
    assert rate_axis("x", [0.3]).low == 0.2
    assert name_axis(["a", "b"]).place([0, 1], 100, 0) == [25.0, 75.0]  # px grow downwards
    assert Axis("x", 2.0, 4.0, ()).place(3.0, 10, 20) == [15.0]


def test_legend_lists_its_keys_and_nothing_without() -> None:
    assert legend([]) == ""
    tree = ElementTree.fromstring(legend([Key("a & b", "c0", line=True), Key("c", "c1", shape="star")]))
    assert ["".join(item.itertext()) for item in tree] == ["a & b", "c"]


# linear RGB as people see it who lack one kind of cone (Machado, Oliveira & Fernandes 2009, severity 1)
DEFICIENCIES = {
    "none": np.eye(3),
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritan": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def linear(color: str) -> np.ndarray:
    """Linear sRGB of #rrggbb (IEC 61966-2-1)."""
    levels = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)


def contrast(color: str, other: str) -> float:
    """WCAG 2.2 contrast ratio."""
    high, low = sorted((float(linear(each) @ LUMINANCE) for each in (color, other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def lab(rgb: np.ndarray) -> np.ndarray:
    """CIE L*a*b* of linear sRGB under D65."""
    xyz = np.array([[0.4124, 0.3576, 0.1805], LUMINANCE, [0.0193, 0.1192, 0.9505]]) @ rgb.clip(0, 1)
    f = np.where(xyz / [0.9505, 1, 1.089] > 0.008856, np.cbrt(xyz / [0.9505, 1, 1.089]), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.fixture(scope="module", params=[0, 1], ids=["light", "dark"])
def colors(request: pytest.FixtureRequest) -> dict[str, str]:
    style = (files("tensor_stereo.reports.sweep") / "assets" / "page.css").read_text()
    blocks = re.findall(r":root \{(.*?)\}", style, re.DOTALL)
    return dict(re.findall(r"--(\w+): (#\w{6})", blocks[request.param]))


def test_text_and_lines_stand_out(colors: dict[str, str]) -> None:
    for name in ("text", "soft", "accent", "bad"):
        assert contrast(colors[name], colors["page"]) >= 4.5
        assert contrast(colors[name], colors["raised"]) >= 4.5
    assert contrast(colors["text"], colors["bar"]) >= 7
    for k in range(NUM_COLORS):
        assert contrast(colors[f"c{k}"], colors["panel"]) >= 3


@pytest.mark.parametrize("deficiency", DEFICIENCIES)
def test_series_are_told_apart_by_every_eye(colors: dict[str, str], deficiency: str) -> None:
    seen = [lab(np.array(DEFICIENCIES[deficiency]) @ linear(colors[f"c{k}"])) for k in range(NUM_COLORS)]
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)) >= 15  # one is just noticeable
