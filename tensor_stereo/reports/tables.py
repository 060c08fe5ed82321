"""The paper's tables from the records of an evaluation, in one neutral form.

Source: Bustos, Vargas, Trujillo, CIARP 2016, section 4. Tables 1-4 hold the rates of one detector each, Table 5 the
run-times.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tensor_stereo.configs import DETECTORS, VERDICTS, Restriction, Verdict, describe_verdict

Row = Mapping[str, Any]
Cell = str | int | float
Key = tuple[str, str, str]  # scene, detector, variant

SCENES = ("Art", "Books", "Cones", "Dolls", "Laundry", "Moebius", "Reindeer", "Teddy")  # order of the paper
VARIANTS = ("unconstrained", "constrained")
RATES = {"sensitivity": "sens.", "specificity": "spec.", "ppv": "PPV", "npv": "NPV"}
SCORE_RATES = {"auc": "AUC", "specificity_at_sensitivity_96": "spec. at sens. .96"}
UNDEFINED = "–"


@dataclass(frozen=True)
class Table:
    """Numbers under a heading, for any kind of print.

    Attributes:
        title: one line.
        columns: C headings, the first one of the row labels.
        rows: C cells each; NaN means undefined or not measured.
        decimals: digits after the point of floating point cells.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    decimals: int = 2

    def __post_init__(self) -> None:
        for index, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise ValueError(
                    f"rows must have {len(self.columns)} cells, one per column; row {index} has {len(row)}"
                )

    def text_rows(self) -> list[list[str]]:
        """The rows as they are printed: floating point cells rounded, NaN as an en dash."""
        return [[_text(cell, self.decimals) for cell in row] for row in self.rows]


def paper_tables(rows: Sequence[Row], *, restriction: Restriction = "cardinality") -> list[Table]:
    """All tables for the detectors that the records name.

    Args:
        rows: one record per scene, detector, variant and verdict, as
            :func:`tensor_stereo.evaluation.dataset.score_dataset` documents them; None in place of a number means NaN.
        restriction: The one of the paper whose records are shown, beside those of the score.

    Returns:
        Tables 1-4 as far as there are records, what is kept, how the score ranks matches if there is one, Table 5, the
        run-time by stage, and the putative matches.

    Raises:
        ValueError: if a record lacks a field, repeats another one, or names an unknown detector or variant.

    Example:
        >>> [table.title for table in paper_tables([])]  # doctest: +ELLIPSIS
        ['Table 5. Run-time...', 'Run-time by stage...', 'Putative matches...']
    """
    return [
        *(rates_table(rows, detector, restriction=restriction) for detector in _detectors(_index(rows, restriction))),
        *(table for table in (kept_table(rows, restriction=restriction), score_table(rows)) if table.rows),
        runtime_table(rows, restriction=restriction),
        stage_table(rows, restriction=restriction),
        matches_table(rows, restriction=restriction),
    ]


def rates_table(rows: Sequence[Row], detector: str, *, restriction: Restriction = "cardinality") -> Table:
    """One of Tables 1-4: scenes x (sensitivity, specificity, PPV, NPV), without and with Restriction 3.

    Where there are records of it, the verdict of the score on all matches stands beside them. The last row is the mean
    over the scenes; undefined rates are left out of it.

    Example:
        >>> record = dict(scene="Art", detector="fast", variant="constrained", verdict="cardinality")
        >>> record |= dict(sensitivity=0.875, specificity=0.5, ppv=0.25, npv=float("nan"))
        >>> rates_table([record], "fast").text_rows()[0][5:]
        ['0.88', '0.50', '0.25', '–']
    """
    if detector not in DETECTORS:
        raise ValueError(f"detector must be one of {', '.join(DETECTORS)}, got {detector!r}")
    paper, scored = _index(rows, restriction), _index(rows, "score")
    groups = {"unconstrained (U)": (paper, "unconstrained"), "constrained by objects (C)": (paper, "constrained")}
    by_score = [key for key in scored if key[1:] == (detector, "unconstrained")]
    if by_score:
        groups[f"{describe_verdict(scored[by_score[0]])} (S)"] = (scored, "unconstrained")
    scenes = _scenes(key for records in (paper, scored) for key in records if key[1] == detector)
    keys = [(records, variant, rate) for records, variant in groups.values() for rate in RATES]
    body = [
        (scene, *(_value(records.get((scene, detector, variant)), rate) for records, variant, rate in keys))
        for scene in scenes
    ]
    letters = [title[-2] for title in groups]
    return Table(
        title=f"Table {DETECTORS.index(detector) + 1}. {detector.upper()}, {restriction}{_tolerance(rows)}: "
        f"{', '.join(groups)}",
        columns=("scene", *(f"{letter} {heading}" for letter in letters for heading in RATES.values())),
        rows=_with_mean(body),
    )


def kept_table(rows: Sequence[Row], *, restriction: Restriction = "cardinality") -> Table:
    """What a user of the kept matches gets: how many there are, how many of them are correct, and how many of these.

    One row per detector and verdict, as means over the scenes. Precision is the paper's NPV, recall its specificity.

    Example:
        >>> record = dict(scene="Art", detector="fast", variant="constrained", verdict="cardinality")
        >>> record |= dict(true_negative=40, false_negative=10, precision=0.8, recall=0.5)
        >>> kept_table([record]).text_rows()
        [['FAST, cardinality, constrained', '50.00', '0.80', '0.50']]
    """
    body: list[tuple[Cell, ...]] = []
    indexed = {verdict: _index(rows, verdict) for verdict in (restriction, "score")}
    for detector in _detectors(key for records in indexed.values() for key in records):
        for verdict, records in indexed.items():
            for variant in VARIANTS:
                found = [row for key, row in records.items() if key[1:] == (detector, variant) and "precision" in row]
                if not found:
                    continue
                name = describe_verdict(found[0]) if verdict == "score" else f"{verdict}, {variant}"
                kept = _mean([float(_field(row, "true_negative")) + _field(row, "false_negative") for row in found])
                rates = (_mean([_value(row, rate) for row in found]) for rate in ("precision", "recall"))
                body.append((f"{detector.upper()}, {name}", kept, *rates))
    columns = ("kept by", "matches", "precision", "recall")
    return Table(f"Kept matches with known ground truth{_tolerance(rows)}, mean over the scenes", columns, tuple(body))


def score_table(rows: Sequence[Row]) -> Table:
    """How the score ranks matches: area under the ROC curve, and specificity where the paper reads it.

    One row per detector and variant with a score, as means over the scenes.

    Example:
        >>> record = dict(scene="Art", detector="fast", variant="unconstrained", verdict="score")
        >>> record |= dict(score="consensus", auc=0.9, specificity_at_sensitivity_96=0.5)
        >>> score_table([record]).text_rows()
        [['FAST, unconstrained', '1', '0.900', '0.500']]
    """
    records: dict[Key, Row] = {}  # the score is the same under every verdict
    for verdict in VERDICTS:
        records |= {key: row for key, row in _index(rows, verdict).items() if row.get("auc") is not None}
    body: list[tuple[Cell, ...]] = []
    for detector in _detectors(records):
        for variant in VARIANTS:
            found = [row for key, row in records.items() if key[1:] == (detector, variant)]
            means = (_mean([_value(row, name) for row in found]) for name in SCORE_RATES)
            if found:
                body.append((f"{detector.upper()}, {variant}", len(found), *means))
    names = ", ".join(dict.fromkeys(row["score"] for row in records.values()))
    title = f"How the score ranks matches ({names or 'none'}){_tolerance(rows)}, mean over the scenes"
    return Table(title, ("matches", "scenes", *SCORE_RATES.values()), tuple(body), decimals=3)


def runtime_table(rows: Sequence[Row], *, restriction: Restriction = "cardinality") -> Table:
    """Table 5: run-time of the constrained variant, all stages together, in ms per scene and detector.

    Example:
        >>> record = dict(scene="Art", detector="fast", variant="constrained", verdict="cardinality")
        >>> runtime_table([record | {"seconds": {"detect": 0.01, "match": 0.02}}]).text_rows()[0]
        ['Art', '30.0']
    """
    records = _index_variant(rows, restriction, "constrained")
    title = f"Table 5. Run-time of the constrained variant in ms, {restriction}"
    milliseconds = {key: 1000 * sum(_field(record, "seconds").values()) for key, record in records.items()}
    detectors = _detectors(records)
    body = [
        (scene, *(milliseconds.get((scene, detector, "constrained"), math.nan) for detector in detectors))
        for scene in _scenes(records)
    ]
    return Table(title, ("scene", *(detector.upper() for detector in detectors)), _with_mean(body), decimals=1)


def stage_table(rows: Sequence[Row], *, restriction: Restriction = "cardinality") -> Table:
    """Run-time by stage, in ms, as the mean over the scenes: the constrained variant, and the verdict of the score.

    Example:
        >>> record = dict(scene="Art", detector="fast", variant="constrained", verdict="cardinality")
        >>> stage_table([record | {"seconds": {"detect": 0.01, "match": 0.02}}]).text_rows()
        [['FAST, constrained', '10.0', '20.0', '30.0']]
    """
    kinds = {
        "constrained": _index_variant(rows, restriction, "constrained"),
        "by score": _index_variant(rows, "score", "unconstrained"),
    }
    records = [record for found in kinds.values() for record in found.values()]
    spent = [item for record in records for item in _field(record, "seconds").items()]
    stages = list(dict.fromkeys(stage for stage, value in spent if value != 0))  # those that ran
    body: list[tuple[Cell, ...]] = []
    for detector in _detectors(key for found in kinds.values() for key in found):
        for kind, found in kinds.items():
            seconds = [_field(record, "seconds") for key, record in found.items() if key[1] == detector]
            if seconds:
                means = [1000 * _mean([scene.get(stage, math.nan) for scene in seconds]) for stage in stages]
                total = 1000 * _mean([sum(scene.values()) for scene in seconds])
                body.append((f"{detector.upper()}, {kind}", *means, total))
    kind = f"{restriction} and by score" if kinds["by score"] else restriction
    title = f"Run-time by stage in ms, {kind}, mean over the scenes"
    return Table(title, ("detector", *stages, "total"), tuple(body), decimals=1)


def matches_table(rows: Sequence[Row], *, restriction: Restriction = "cardinality") -> Table:
    """What the detectors offer: putative matches, and the fraction of them that is estimated incorrectly.

    Example:
        >>> record = dict(scene="Art", detector="fast", variant="unconstrained", verdict="cardinality")
        >>> matches_table([record | dict(num_matches=700, num_valid=690, fraction_incorrect=0.55)]).text_rows()[0]
        ['Art', '700', '0.55']
    """
    records = _index_variant(rows, restriction, "unconstrained")
    detectors = _detectors(records)
    body: list[tuple[Cell, ...]] = []
    for scene in _scenes(records):
        found = [records.get((scene, detector, "unconstrained")) for detector in detectors]
        body.append((scene, *(_value(r, name) for r in found for name in ("num_matches", "fraction_incorrect"))))
    headings = [f"{detector.upper()} {what}" for detector in detectors for what in ("matches", "incorrect")]
    title = f"Putative matches and the fraction of those with known ground truth that is incorrect{_tolerance(rows)}"
    return Table(title, ("scene", *headings), tuple(body))


def to_markdown(table: Table) -> str:
    """A Markdown table under its title, columns aligned in plain text too, with a line break at the end.

    Example:
        >>> print(to_markdown(Table("Rates", ("scene", "sens."), (("Art", 0.875),))), end="")
        **Rates**
        <BLANKLINE>
        | scene | sens. |
        |:------|------:|
        | Art   |  0.88 |
    """
    lines = [[cell.replace("|", "\\|") for cell in line] for line in (table.columns, *table.text_rows())]
    widths = [max(len(line[column]) for line in lines) for column in range(len(table.columns))]
    # labels to the left, numbers to the right
    aligns = ["<", *">" * (len(widths) - 1)]
    styles = list(zip(aligns, widths, strict=True))
    rule = "|".join(":" + "-" * (width + 1) if align == "<" else "-" * (width + 1) + ":" for align, width in styles)
    header, *body = (
        "| " + " | ".join(f"{cell:{align}{width}}" for cell, (align, width) in zip(line, styles, strict=True)) + " |"
        for line in lines
    )
    return "\n".join([f"**{table.title}**", "", header, f"|{rule}|", *body]) + "\n"


def _index(rows: Sequence[Row], verdict: Verdict) -> dict[Key, Row]:
    """Records of one verdict by (scene, detector, variant)."""
    index: dict[Key, Row] = {}
    for row in rows:
        scene, detector, variant = (_field(row, name) for name in ("scene", "detector", "variant"))
        if detector not in DETECTORS:
            raise ValueError(f"detector must be one of {', '.join(DETECTORS)}, got {detector!r}")
        if variant not in VARIANTS:
            raise ValueError(f"variant must be one of {', '.join(VARIANTS)}, got {variant!r}")
        if _field(row, "verdict") != verdict:
            continue
        key = _display_name(scene), detector, variant
        if key in index:
            raise ValueError(f"rows must not repeat a record, got {scene!r}, {detector}, {variant}, {verdict} twice")
        index[key] = row
    return index


def _index_variant(rows: Sequence[Row], verdict: Verdict, variant: str) -> dict[Key, Row]:
    return {key: record for key, record in _index(rows, verdict).items() if key[2] == variant}


def _tolerance(rows: Sequence[Row]) -> str:
    """What counts as correct, for a title; nothing at the paper's 1 px."""
    found = sorted({row.get("max_error_px", 1.0) for row in rows})
    return "" if found in ([], [1.0]) else f", correct within {' or '.join(f'{value:g}' for value in found)} px"


def _with_mean(body: Sequence[tuple[Cell, ...]]) -> tuple[tuple[Cell, ...], ...]:
    if not body:
        return ()
    return (*body, ("mean", *(_mean(column) for column in list(zip(*body, strict=True))[1:])))


def _mean(values: Iterable[Cell]) -> float:
    known = [float(value) for value in values if not math.isnan(float(value))]
    return math.fsum(known) / len(known) if known else math.nan


def _detectors(records: Iterable[Key]) -> list[str]:
    """Detectors of the records in the order of the paper's tables."""
    present = {key[1] for key in records}
    return [detector for detector in DETECTORS if detector in present]


def _scenes(records: Iterable[Key]) -> list[str]:
    """Scenes of the records, those of the paper first and in its order, then the others by name."""
    present = {key[0] for key in records}
    return [scene for scene in SCENES if scene in present] + sorted(present - set(SCENES))


def _display_name(scene: str) -> str:
    """The paper writes its scenes with a capital; other names stay as they are."""
    return next((name for name in SCENES if name.casefold() == scene.casefold()), scene)


def _value(record: Row | None, name: str) -> Cell:
    value = None if record is None else _field(record, name)
    return math.nan if value is None else value


def _field(row: Row, name: str) -> Any:
    if name not in row:
        raise ValueError(f"rows must have the field {name!r}, got {', '.join(map(str, row))}")
    return row[name]


def _text(cell: Cell, decimals: int) -> str:
    if isinstance(cell, float):
        return UNDEFINED if math.isnan(cell) else f"{cell:.{decimals}f}"
    return str(cell)
