from __future__ import annotations

import itertools
import math
import random

import pytest

from tensor_stereo.reports.tables import (
    Table,
    matches_table,
    paper_tables,
    rates_table,
    runtime_table,
    score_table,
    stage_table,
    to_markdown,
)

RATES = ("sensitivity", "specificity", "ppv", "npv")
SPECIFICITY = "specificity_at_sensitivity_96"
STAGES = ("detect", "match", "group", "graph", "relate")


def records(scenes: tuple[str, ...], detectors: tuple[str, ...]) -> list[dict]:
    """One record per combination, every number drawn anew."""
    draw = random.Random(0)
    combinations = itertools.product(scenes, detectors, ("unconstrained", "constrained"), ("adjacency", "cardinality"))
    return [
        {
            "scene": scene,
            "detector": detector,
            "variant": variant,
            "restriction": restriction,
            "num_matches": draw.randint(100, 900),
            "num_valid": 100,
            "num_untested": 3,
            "fraction_incorrect": draw.random(),
            **{rate: draw.random() for rate in RATES},
            "seconds": {stage: draw.random() for stage in STAGES},
        }
        for scene, detector, variant, restriction in combinations
    ]


def pick(rows: list[dict], **fields: str) -> dict:
    (found,) = [row for row in rows if all(row[name] == value for name, value in fields.items())]
    return found


def test_rates_stand_side_by_side_in_the_order_of_the_paper() -> None:
    rows = records(("teddy", "Art", "books"), ("fast", "sift"))
    table = rates_table(rows, "fast", restriction="adjacency")
    assert table.title.startswith("Table 2. FAST, adjacency")
    assert [row[0] for row in table.rows] == ["Art", "Books", "Teddy", "mean"]
    assert len(table.columns) == 9
    for row, scene in zip(table.rows, ("Art", "books", "teddy"), strict=False):
        expected = []
        for variant in ("unconstrained", "constrained"):
            record = pick(rows, scene=scene, detector="fast", variant=variant, restriction="adjacency")
            expected += [record[rate] for rate in RATES]
        assert list(row[1:]) == expected
    for column in range(1, 9):
        assert table.rows[-1][column] == pytest.approx(sum(row[column] for row in table.rows[:-1]) / 3, rel=1e-15)


def test_tables_are_numbered_as_in_the_paper_whatever_is_there() -> None:
    rows = records(("Art",), ("gftt", "surf", "fast", "sift"))
    titles = [table.title for table in paper_tables(rows)]
    starts = ["Table 1. SIFT", "Table 2. FAST", "Table 3. SURF", "Table 4. GFTT", "Table 5. Run-time"]
    assert all(title.startswith(start) for title, start in zip(titles, starts, strict=False))
    assert paper_tables(rows[::-1]) == paper_tables(rows)
    assert paper_tables(records(("Art",), ("gftt",)))[0].title.startswith("Table 4. GFTT")


def test_other_scenes_follow_by_name() -> None:
    rows = records(("venus", "Reindeer", "Aloe"), ("sift",))
    assert [row[0] for row in rates_table(rows, "sift").rows] == ["Reindeer", "Aloe", "venus", "mean"]


def test_undefined_rate_prints_as_dash_and_is_left_out_of_the_mean() -> None:
    rows = records(("Art", "Books"), ("sift",))
    for row in rows:
        row["npv"] = math.nan
        row["ppv"] = 0.25 if row["scene"] == "Art" else None  # as read back from JSON, which has no NaN
    table = rates_table(rows, "sift")
    assert [row[3:5] for row in table.text_rows()] == [["0.25", "–"], ["–", "–"], ["0.25", "–"]]


def test_scores_are_means_over_the_scenes_and_left_out_without_score() -> None:
    rows = records(("Art", "Books", "Cones"), ("fast", "sift"))
    assert "How the score" not in " ".join(table.title for table in paper_tables(rows))
    draw = random.Random(1)
    for row in rows:
        row |= {"score": "learned", "auc": draw.random(), "specificity_at_sensitivity_96": draw.random()}
    pick(rows, scene="Art", detector="sift", variant="constrained", restriction="adjacency")["auc"] = None
    table = score_table(rows, restriction="adjacency")
    assert [row[0] for row in table.rows] == [
        f"{detector}, {variant}" for detector in ("SIFT", "FAST") for variant in ("unconstrained", "constrained")
    ]
    of = [r for r in rows if (r["detector"], r["variant"], r["restriction"]) == ("fast", "constrained", "adjacency")]
    assert table.rows[3][1:] == (3, sum(r["auc"] for r in of) / 3, sum(r[SPECIFICITY] for r in of) / 3)
    assert table.rows[1][1] == 2
    assert "learned" in table.title
    assert any(shown.rows == score_table(rows).rows for shown in paper_tables(rows))


def test_titles_name_the_score_that_decides() -> None:
    rows = [row | {"score": "consensus", "threshold": 0.25} for row in records(("Art",), ("fast",))]
    for table in (rates_table(rows, "fast"), runtime_table(rows), stage_table(rows)):
        assert "consensus, threshold 0.25" in table.title
        assert "cardinality" not in table.title


def test_missing_scene_is_a_dash() -> None:
    rows = [
        row for row in records(("Art", "Books"), ("sift", "fast")) if (row["scene"], row["detector"]) != ("Art", "fast")
    ]
    assert runtime_table(rows).text_rows()[0][2] == "–"
    assert matches_table(rows).text_rows()[0][3:] == ["–", "–"]


def test_runtime_is_the_constrained_total_in_ms() -> None:
    rows = records(("Art", "cones"), ("fast", "sift"))
    table = runtime_table(rows)
    assert table.columns == ("scene", "SIFT", "FAST")
    for row, scene in zip(table.rows, ("Art", "cones"), strict=False):
        for cell, detector in zip(row[1:], ("sift", "fast"), strict=True):
            record = pick(rows, scene=scene, detector=detector, variant="constrained", restriction="cardinality")
            assert cell == pytest.approx(1000 * sum(record["seconds"].values()), rel=1e-15)


def test_stages_add_up_to_the_mean_total() -> None:
    rows = records(("Art", "cones", "Dolls"), ("fast", "surf"))
    stages, total = stage_table(rows), runtime_table(rows)
    assert stages.columns == ("detector", *STAGES, "total")
    for row, mean in zip(stages.rows, total.rows[-1][1:], strict=True):
        assert row[-1] == pytest.approx(sum(row[1:-1]), rel=1e-14)
        assert row[-1] == pytest.approx(mean, rel=1e-14)


def test_putative_matches_are_those_of_the_unconstrained_variant() -> None:
    rows = records(("Art",), ("sift", "gftt"))
    expected = []
    for detector in ("sift", "gftt"):
        record = pick(rows, detector=detector, variant="unconstrained", restriction="cardinality")
        expected += [record["num_matches"], record["fraction_incorrect"]]
    assert list(matches_table(rows).rows[0][1:]) == expected


def test_markdown_is_aligned_and_escaped() -> None:
    table = Table("Title", ("a|b", "n", "rate"), (("x", 12, 0.5), ("long name", 3, math.nan)), decimals=1)
    text = to_markdown(table)
    assert text == (
        "**Title**\n\n"
        "| a\\|b      |  n | rate |\n"
        "|:----------|---:|-----:|\n"
        "| x         | 12 |  0.5 |\n"
        "| long name |  3 |    – |\n"
    )


def test_no_records_give_empty_tables() -> None:
    for table in paper_tables([]):
        assert table.rows == ()
        assert to_markdown(table).endswith("|\n")


def test_tables_name_what_is_wrong() -> None:
    rows = records(("Art",), ("sift",))
    with pytest.raises(ValueError, match="must not repeat a record, got 'art', sift, unconstrained"):
        paper_tables([*rows, {**pick(rows, variant="unconstrained", restriction="cardinality"), "scene": "art"}])
    with pytest.raises(ValueError, match=r"detector must be one of .* got 'orb'"):
        paper_tables([{**rows[0], "detector": "orb"}])
    with pytest.raises(ValueError, match=r"detector must be one of .* got 'orb'"):
        rates_table(rows, "orb")
    with pytest.raises(ValueError, match=r"variant must be one of .* got 'both'"):
        paper_tables([{**rows[0], "variant": "both"}])
    with pytest.raises(ValueError, match="the field 'npv'"):
        rates_table([{name: value for name, value in row.items() if name != "npv"} for row in rows], "sift")
    with pytest.raises(ValueError, match="rows must have 2 cells"):
        Table("", ("a", "b"), (("x",),))
