"""The report as one HTML page.

Everything is inside: data as JSON, style, script, figures, pictures. A content security policy names the script and the
style by their hashes and allows nothing else, so the page can load nothing and run nothing that came with the data.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from html import escape
from importlib.resources import files
from string import Template

from tensor_stereo.reports.sweep.compare import LEVEL, NUM_RESAMPLES, SEED, Comparison
from tensor_stereo.reports.sweep.curve_figures import curve_figures
from tensor_stereo.reports.sweep.data_tables import (
    DataTable,
    differences_data,
    failures_data,
    only_data,
    pairs_data,
    script_json,
    trials_data,
)
from tensor_stereo.reports.sweep.drawing import run_prefix
from tensor_stereo.reports.sweep.figures import perturbation_figures, runtime_figure, scatter_figure
from tensor_stereo.reports.sweep.results import RunResults
from tensor_stereo.reports.sweep.settings import PERTURBATIONS
from tensor_stereo.reports.sweep.summary import (
    EXPLANATION,
    best_table,
    changed_table,
    difference_table,
    environment_table,
    failure_kinds_table,
    run_counts,
    runtime_table,
    settings_table,
    worst_table,
)
from tensor_stereo.reports.tables import Table

_NUM_NAMES = 20  # of pairs, written out


def render_page(runs: Sequence[RunResults], comparison: Comparison | None) -> str:
    """The page of one run, or of two with their comparison."""
    tables: list[DataTable] = []
    sections = [_summary(runs)]
    if comparison is not None:
        sections.append(_comparison(runs, comparison, tables))
    if any(len(run.rows) for run in runs):
        sections += _measured(runs, tables)
    sections += [_failures(runs, tables), _provenance(runs)]
    style, script = _asset("page.css"), _asset("page.js")
    title = "Sweep report: " + " and ".join(run.name for run in runs)
    return Template(_asset("page.html")).substitute(
        title=escape(title),
        explanation=EXPLANATION,
        style=style,
        style_hash=_hash(style),
        script=script,
        script_hash=_hash(script),
        data=script_json([table.payload() for table in tables]),
        navigation="".join(f'<li><a href="#{name}">{heading}</a></li>' for name, heading, _ in sections),
        sections="".join(
            f'<section id="{name}"><h2>{heading}</h2>{body}</section>' for name, heading, body in sections
        ),
    )


_Section = tuple[str, str, str]  # id, heading, HTML


def _summary(runs: Sequence[RunResults]) -> _Section:
    cards = []
    for k, run in enumerate(runs):
        items = "".join(
            f'<div class="card{" bad" if name == "failed units" and number else ""}">'
            f"<dt>{name}</dt><dd>{number:,}</dd></div>"
            for name, number in run_counts(run).items()
        )
        heading = f"<h3>{escape(run_prefix(runs, k) + run.name)}</h3>" if len(runs) > 1 else ""
        cards.append(f'{heading}<dl class="cards">{items}</dl>')
    settings = settings_table(runs)
    varying = tuple((name, values) for name, role, values in settings.rows if role == "varies")
    grid = to_html(Table("What varies", ("setting", "values"), varying))
    if not varying:
        grid = "<p>Nothing varies: all rows have the same settings.</p>"
    others = tuple(row for row in settings.rows if row[1] != "varies")
    rest = _details("Other settings", to_html(replace(settings, rows=others)))
    return "summary", "Summary", "".join(cards) + grid + rest


def _comparison(runs: Sequence[RunResults], comparison: Comparison, tables: list[DataTable]) -> _Section:
    parts = [f"<p>Pairs in both runs: {comparison.num_common_pairs}.{_only_pairs(comparison)}</p>"]
    if comparison.changed:
        parts.append(to_html(changed_table(comparison)))
    if len(comparison.trials):
        parts.append(to_html(difference_table(comparison)))
        parts.append(
            "<p class=note>Each pair counts once: its differences are averaged over the common settings first. "
            f"Intervals are {LEVEL:.0%} percentiles of {NUM_RESAMPLES} resamples of the pairs, seed {SEED}. The rows "
            "of the table below are not independent of one another, and some intervals miss 0 by chance.</p>"
        )
        parts.append(_mount(differences_data(runs, comparison), tables))
    else:
        parts.append("<p>The runs have no point of settings in common.</p>")
    if len(comparison.only):
        parts.append("<h3>Settings of one run alone</h3>" + _mount(only_data(runs, comparison), tables))
    return "comparison", "Comparison", "".join(parts)


def _only_pairs(comparison: Comparison) -> str:
    parts = []
    for letter, names in zip("AB", comparison.only_pairs, strict=True):
        if names:
            more = f" and {len(names) - _NUM_NAMES} more" if len(names) > _NUM_NAMES else ""
            parts.append(f" Only in {letter}: {escape(', '.join(names[:_NUM_NAMES]))}{more}.")
    return "".join(parts)


def _measured(runs: Sequence[RunResults], tables: list[DataTable]) -> list[_Section]:
    """What needs results."""
    best = "".join(to_html(best_table(run)) for run in runs)
    overview = f'<div class="beside">{scatter_figure(runs)}<div>{best}</div></div>'
    sections = [
        ("trials", "Trials", overview + _mount(trials_data(runs), tables)),
        ("curves", "ROC and precision-recall", curve_figures(runs)),
    ]
    headings = {"outlier_rate": "Added outliers", "noise_px": "Added noise"}
    sections += [(name, headings[name], perturbation_figures(runs, name)) for name in PERTURBATIONS]
    hosts = sorted({host for run in runs for names in run.rows.trials["hosts"] for host in names})
    mixed = (
        f"<p class=note>Times of {len(hosts)} hosts are mixed: {escape(', '.join(hosts))}.</p>"
        if len(hosts) > 1
        else ""
    )
    times = f'<div class="beside">{runtime_figure(runs)}<div>{to_html(runtime_table(runs))}{mixed}</div></div>'
    worst = "".join(to_html(worst_table(run)) + _overlays(run) for run in runs)
    sections += [
        ("runtime", "Run-time", times),
        ("worst", "Worst pairs", worst),
        ("pairs", "Pairs", _pairs(runs, tables)),
    ]
    return [section for section in sections if section[2]]


def _pairs(runs: Sequence[RunResults], tables: list[DataTable]) -> str:
    table = pairs_data(runs)
    total, shown = sum(len(run.rows) for run in runs), len(table.columns[0].values)
    return _excerpt(shown, total) + _mount(table, tables)


def _excerpt(shown: int, total: int) -> str:
    """What a table leaves out, in words."""
    if shown == total:
        return ""
    return f"<p class=note>The first {shown:,} of {total:,} rows; the tables of the run have all.</p>"


def _failures(runs: Sequence[RunResults], tables: list[DataTable]) -> _Section:
    if any(len(run.errors) for run in runs):
        kinds = "".join(to_html(failure_kinds_table(run)) for run in runs if len(run.errors))
        table = failures_data(runs)
        total, shown = sum(len(run.errors) for run in runs), len(table.columns[0].values)
        return "failures", "Failed units", kinds + _excerpt(shown, total) + _mount(table, tables)
    return "failures", "Failed units", "<p>None.</p>"


def _provenance(runs: Sequence[RunResults]) -> _Section:
    parts = []
    for run in runs:
        table = environment_table(run)
        if table.rows:
            parts.append(to_html(table))
        config = escape(json.dumps(run.config, indent=2, ensure_ascii=False, default=str))
        parts.append(_details(f"Configuration of {escape(run.name)}", f"<pre>{config}</pre>"))
    return "environment", "Environment", "".join(parts)


def _overlays(run: RunResults) -> str:
    """Pictures with captions, which a click enlarges."""
    pictures = []
    for overlay in run.overlays:
        source = f"data:image/png;base64,{base64.b64encode(overlay.png).decode()}"
        caption = escape(overlay.caption)
        button = f'<button type="button" aria-pressed="false"><img src="{source}" alt="{caption}"></button>'
        pictures.append(f"<figure>{button}<figcaption>{caption}</figcaption></figure>")
    return f'<div class="overlays">{"".join(pictures)}</div>' if pictures else ""


def to_html(table: Table) -> str:
    """A table of the report, labels to the left and numbers to the right.

    >>> to_html(Table("Rates", ("scene", "sens."), (("<b>", 0.5),))).count("&lt;b&gt;")
    1
    """
    numeric = [all(not isinstance(row[k], str) for row in table.rows) for k in range(len(table.columns))]
    head = "".join(f"<th scope=col{_align(n)}>{escape(c)}</th>" for c, n in zip(table.columns, numeric, strict=True))
    rows = (
        "<tr>" + "".join(f"<td{_align(n)}>{escape(cell)}</td>" for cell, n in zip(row, numeric, strict=True)) + "</tr>"
        for row in table.text_rows()
    )
    body = f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f'<div class="wide"><table><caption>{escape(table.title)}</caption>{body}</table></div>'


def _align(numeric: bool) -> str:
    return " class=number" if numeric else ""


def _mount(table: DataTable, tables: list[DataTable]) -> str:
    """Where the script builds a table."""
    tables.append(table)
    fallback = "<p>This table needs JavaScript; report.md has the pooled ones.</p>"
    return f'<div class="data" id="table-{table.id}">{fallback}</div>'


def _details(summary: str, body: str) -> str:
    return f"<details><summary>{summary}</summary>{body}</details>"


def _asset(name: str) -> str:
    return (files("tensor_stereo.reports.sweep") / "assets" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """As a content security policy names an inline element."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
