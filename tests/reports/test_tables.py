from __future__ import annotations

import itertools
import math
import random
from typing import Any

import pytest

from tensor_stereo.configs import Restriction
from tensor_stereo.reports.tables import (
    Table,
    kept_table,
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


def records(scenes: tuple[str, ...], detectors: tuple[str, ...], *, seed: int = 0) -> list[dict]:
    """One record per combination of the paper, every number drawn anew."""
    draw = random.Random(seed)
    combinations = itertools.product(scenes, detectors, ("unconstrained", "constrained"), ("adjacency", "cardinality"))
    return [
        {
            "scene": scene,
            "detector": detector,
            "variant": variant,
            "verdict": verdict,
            "num_matches": draw.randint(100, 900),
            "num_valid": 100,
            "num_untested": 3,
            "fraction_incorrect": draw.random(),
            **{rate: draw.random() for rate in RATES},
            "seconds": {stage: draw.random() for stage in STAGES},
        }
        for scene, detector, variant, verdict in combinations
    ]


def by_score(
    scenes: tuple[str, ...], detectors: tuple[str, ...], *, score: str = "learned", **cut: float
) -> list[dict]:
    """Records of the verdict of a score on all matches, with a curve."""
    draw = random.Random(2)
    rows = records(scenes, detectors, seed=3)
    rows = [row for row in rows if (row["variant"], row["verdict"]) == ("unconstrained", "cardinality")]
    decided = {"verdict": "score", "score": score} | cut
    return [row | decided | {"auc": draw.random(), SPECIFICITY: draw.random()} for row in rows]


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
            record = pick(rows, scene=scene, detector="fast", variant=variant, verdict="adjacency")
            expected += [record[rate] for rate in RATES]
        assert list(row[1:]) == expected
    for column in range(1, 9):
        assert table.rows[-1][column] == pytest.approx(sum(row[column] for row in table.rows[:-1]) / 3, rel=1e-15)


def test_rates_of_the_score_stand_beside_those_of_the_paper_and_change_none_of_them() -> None:
    scenes = ("teddy", "Art", "books")
    rows, scored = records(scenes, ("fast", "sift")), by_score(scenes, ("fast",))
    for restriction in ("adjacency", "cardinality"):
        alone = rates_table(rows, "fast", restriction=restriction)
        table = rates_table([*scored, *rows], "fast", restriction=restriction)
        assert table == rates_table([*rows, *scored], "fast", restriction=restriction)
        assert table.columns == (*alone.columns, "S sens.", "S spec.", "S PPV", "S NPV")
        assert [row[:9] for row in table.rows] == list(alone.rows)
        assert table.title == f"{alone.title}, learned, probability 0.5 (S)"
        for row, scene in zip(table.rows, ("Art", "books", "teddy"), strict=False):
            assert list(row[9:]) == [pick(scored, scene=scene)[rate] for rate in RATES]
        for column in range(9, 13):
            assert table.rows[-1][column] == pytest.approx(sum(row[column] for row in table.rows[:-1]) / 3, rel=1e-15)
    assert rates_table([*rows, *scored], "sift") == rates_table(rows, "sift")  # no record of its score


def test_scenes_without_a_record_of_the_score_are_dashes_and_left_out_of_its_mean() -> None:
    rows, scored = records(("Art", "Books"), ("fast",)), by_score(("Books", "Cones"), ("fast",))
    table = rates_table([*rows, *scored], "fast")
    assert [row[0] for row in table.rows] == ["Art", "Books", "Cones", "mean"]
    assert table.text_rows()[0][9:] == ["–"] * 4
    assert table.text_rows()[2][1:9] == ["–"] * 8
    means = [sum(pick(scored, scene=scene)[rate] for scene in ("Books", "Cones")) / 2 for rate in RATES]
    assert table.rows[-1][9:] == pytest.approx(means, rel=1e-15)


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
    for verdict in ("adjacency", "cardinality"):
        pick(rows, scene="Art", detector="sift", variant="constrained", verdict=verdict)["auc"] = None
    table = score_table(rows)
    assert [row[0] for row in table.rows] == [
        f"{detector}, {variant}" for detector in ("SIFT", "FAST") for variant in ("unconstrained", "constrained")
    ]
    of = [r for r in rows if (r["detector"], r["variant"], r["verdict"]) == ("fast", "constrained", "cardinality")]
    assert table.rows[3][1:] == (3, *(math.fsum(r[name] for r in of) / 3 for name in ("auc", SPECIFICITY)))
    assert table.rows[1][1] == 2
    assert "learned" in table.title
    assert any(shown.rows == score_table(rows).rows for shown in paper_tables(rows))


def test_a_score_is_ranked_once_whichever_verdicts_have_it() -> None:
    """Scores do not depend on the verdict; records of the paper without a score add nothing."""
    scored = by_score(("Art", "Books"), ("fast",))
    table = score_table(scored)
    assert table.rows == (
        ("FAST, unconstrained", 2, sum(r["auc"] for r in scored) / 2, sum(r[SPECIFICITY] for r in scored) / 2),
    )
    assert score_table([*scored, *(row | {"verdict": "adjacency"} for row in scored)]) == table
    assert score_table([*records(("Art", "Books"), ("fast", "sift")), *scored]) == table
    (shown,) = [t for t in paper_tables([*records(("Art",), ("fast",)), *scored]) if t.title.startswith("How the")]
    assert shown == table


@pytest.mark.parametrize("restriction", ["adjacency", "cardinality"])
@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"score": "consensus", "threshold": 0.25}, "consensus, threshold 0.25"),
        ({"score": "learned", "min_precision": 0.9}, "learned, min precision 0.9"),
        ({"score": "learned", "target_sensitivity": 0.96}, "learned, target sensitivity 0.96"),
        ({"score": "learned"}, "learned, probability 0.5"),
    ],
)
def test_titles_name_what_decides(restriction: Restriction, settings: dict[str, Any], words: str) -> None:
    rows = records(("Art",), ("fast",))
    both = [*rows, *by_score(("Art",), ("fast",), **settings)]
    title = rates_table(both, "fast", restriction=restriction).title
    assert title.startswith(f"Table 2. FAST, {restriction}: unconstrained (U), constrained by objects (C), ")
    assert title.endswith(f", {words} (S)")
    assert stage_table(rows, restriction=restriction).title.startswith(f"Run-time by stage in ms, {restriction}, ")
    title = stage_table(both, restriction=restriction).title
    assert title.startswith(f"Run-time by stage in ms, {restriction} and by score, ")
    assert restriction in runtime_table(rows, restriction=restriction).title
    assert runtime_table(both, restriction=restriction) == runtime_table(rows, restriction=restriction)  # of the paper
    assert matches_table(both, restriction=restriction) == matches_table(rows, restriction=restriction)


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
            record = pick(rows, scene=scene, detector=detector, variant="constrained", verdict="cardinality")
            assert cell == pytest.approx(1000 * sum(record["seconds"].values()), rel=1e-15)


def test_stages_add_up_to_the_mean_total() -> None:
    rows = records(("Art", "cones", "Dolls"), ("fast", "surf"))
    stages, total = stage_table(rows), runtime_table(rows)
    assert stages.columns == ("detector", *STAGES, "total")
    for row, mean in zip(stages.rows, total.rows[-1][1:], strict=True):
        assert row[-1] == pytest.approx(sum(row[1:-1]), rel=1e-14)
        assert row[-1] == pytest.approx(mean, rel=1e-14)


def test_stages_of_the_score_stand_below_those_of_the_paper() -> None:
    scenes = ("Art", "cones")
    rows, scored = records(scenes, ("fast", "surf")), by_score(scenes, ("fast",))
    for row in scored:
        row["seconds"] |= {"score": 0.25}
    paper, table = stage_table(rows), stage_table([*scored, *rows])
    assert [row[0] for row in table.rows] == ["FAST, constrained", "FAST, by score", "SURF, constrained"]
    assert set(table.columns) == {"detector", *STAGES, "score", "total"}
    shown = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    for row, alone in zip((shown[0], shown[2]), paper.rows, strict=True):
        assert tuple(row[name] for name in paper.columns) == alone
        assert math.isnan(row["score"])
    for stage in STAGES:
        assert shown[1][stage] == pytest.approx(500 * sum(row["seconds"][stage] for row in scored), rel=1e-14)
    assert shown[1]["score"] == 250
    assert shown[1]["total"] == pytest.approx(sum(shown[1][stage] for stage in (*STAGES, "score")), rel=1e-14)


def test_putative_matches_are_those_of_the_unconstrained_variant() -> None:
    rows = records(("Art",), ("sift", "gftt"))
    expected = []
    for detector in ("sift", "gftt"):
        record = pick(rows, detector=detector, variant="unconstrained", verdict="cardinality")
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
        paper_tables([*rows, {**pick(rows, variant="unconstrained", verdict="cardinality"), "scene": "art"}])
    with pytest.raises(ValueError, match="must not repeat a record, got 'Art', sift, unconstrained, score twice"):
        paper_tables([*rows, *2 * by_score(("Art",), ("sift",))])
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


def test_titles_name_a_tolerance_other_than_that_of_the_paper() -> None:
    record = {"scene": "Art", "detector": "fast", "variant": "unconstrained", "verdict": "score", "score": "learned"}
    record |= dict.fromkeys(("sensitivity", "specificity", "ppv", "npv", "precision", "recall", "auc"), 0.5)
    record |= {"specificity_at_sensitivity_96": 0.5, "true_negative": 3, "false_negative": 1}
    record |= {"num_matches": 9, "fraction_incorrect": 0.5}
    for max_error_px, words in ((1.0, False), (3.0, True)):
        rows = [record | {"max_error_px": max_error_px}]
        for table in (rates_table(rows, "fast"), kept_table(rows), score_table(rows), matches_table(rows)):
            assert ("correct within 3 px" in table.title) == words
        assert ("learned, probability 0.5 within 3 px (S)" in rates_table(rows, "fast").title) == words
