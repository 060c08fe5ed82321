from __future__ import annotations

import itertools
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo.configs import RESTRICTIONS, SCORES, VERDICTS, ConsensusConfig, TrialConfig
from tensor_stereo.sweeps import expand_grid, read_grid
from tensor_stereo.sweeps.grid import explain_grid, simplify


def _read(tmp_path: Path, text: str):
    path = tmp_path / "sweep.toml"
    path.write_text(text)
    return read_grid(path)


def test_lists_make_a_product_and_tables_a_union(tmp_path: Path) -> None:
    config = _read(
        tmp_path,
        """
        export_matches = true
        [[grid]]
        detector = ["fast", "gftt"]
        fast.window_px = [9, 11]
        [[grid]]
        detector = "sift"
        matching.max_row_offset_px = [1, "none"]
        verdict = "cardinality"
        score = "topology"
        temperature = 2
        """,
    )
    found = [(t.detector, t.fast.window_px, t.matching.max_row_offset_px, t.temperature) for t in config.trials]
    assert found == [
        ("sift", 11, 1.0, 2.0), ("sift", 11, None, 2.0),
        ("fast", 9, None, 1.0), ("fast", 11, None, 1.0),
        ("gftt", 11, None, 1.0),
    ]  # fmt: skip
    assert config.export_matches


def test_an_empty_grid_is_the_default_trial(tmp_path: Path) -> None:
    assert _read(tmp_path, "").trials == (simplify(TrialConfig()),) == (TrialConfig(score="learned"),)


@pytest.mark.parametrize(
    "unused",
    [
        {"seed": [0, 1, 2]},
        {"sift": {"max_keypoints": [5, 6]}},
        {"verdict": "cardinality", "score": "none", "temperature": [0.5, 1.0], "temperature_unit": ["edge", "px"]},
        {"score": ["learned", "auto"], "temperature": [0.5, 1.0]},
        {"score": "consensus", "temperature": [0.5, 1.0]},
        {"score": "learned", "consensus": {"slope": [0.1, 0.3], "num_rounds": [2, 3]}},
        {"verdict": "adjacency", "score": ["auto", "none"], "consensus": {"slope": [0.1, 0.3]}},
        {"verdict": "adjacency", "score": "topology", "consensus": {"slope": [0.1, 0.3]}},
        {"objects": {"element_px": [3, 5]}},
        {"sgbm": {"window_px": [3, 5], "mode": ["3way", "hh"]}},
        {"matching": {"method": "sgbm", "max_row_offset_px": ["none", 1]}, "fast": {"window_px": [7, 11]}},
        {"matching": {"method": "sgbm"}, "detector": "sift", "sift": {"max_ratio": [0.6, 0.8, "none"]}},
    ],
)
def test_points_that_differ_only_in_unused_settings_are_one(unused: dict[str, object]) -> None:
    assert len(expand_grid([unused])) == 1


def test_a_setting_of_consensus_is_an_axis_where_that_is_the_score() -> None:
    axis = {"consensus": {"slope": [0.1, 0.3]}}
    found = expand_grid([axis | {"score": "consensus"}])
    assert [(trial.score, trial.consensus.slope) for trial in found] == [("consensus", 0.1), ("consensus", 0.3)]
    assert all(trial.consensus == ConsensusConfig(slope=trial.consensus.slope) for trial in found)
    both = expand_grid([axis | {"verdict": "cardinality", "score": ["none", "learned", "consensus", "topology"]}])
    default = ConsensusConfig().slope
    assert [(trial.score, trial.consensus.slope) for trial in both] == [
        ("none", default), ("learned", default), ("consensus", 0.1), ("topology", default), ("consensus", 0.3)
    ]  # fmt: skip


def test_settings_of_semi_global_matching_are_axes_where_that_is_the_method(tmp_path: Path) -> None:
    text = '[grid]\nmatching.method = ["ssd", "sgbm"]\nsgbm.window_px = [3, 5]\nsgbm.mode = "hh"\n'
    found = _read(tmp_path, text).trials
    assert [(trial.matching.method, trial.sgbm.window_px, trial.sgbm.mode) for trial in found] == [
        ("ssd", 5, "3way"), ("sgbm", 3, "hh"), ("sgbm", 5, "hh")
    ]  # fmt: skip
    with pytest.raises(ValueError, match=r"matching.method = sgbm, rectified = auto: rectified must be True where"):
        _read(tmp_path, '[grid]\nmatching.method = ["ssd", "sgbm"]\nrectified = [true, "auto"]\n')
    with pytest.raises(ValueError, match=r"num_disparities_px must be a multiple of 16"):
        _read(tmp_path, "[grid]\nsgbm.num_disparities_px = [64, 100]\n")


@pytest.mark.parametrize(
    ("text", "expected"),
    [("true", [True]), ("false", [False]), ('"auto"', ["auto"]), ('[true, "auto", false]', [True, "auto", False])],
)
def test_rectified_is_a_boolean_or_auto(tmp_path: Path, text: str, expected: list[object]) -> None:
    config = _read(tmp_path, f"[grid]\nrectified = {text}")
    found = [trial.rectified for trial in config.trials]
    assert found == expected
    assert list(map(type, found)) == list(map(type, expected))


def test_rectified_is_an_axis_where_a_score_asks_for_it() -> None:
    axis = {"rectified": [False, "auto"], "score": ["none", "topology", "consensus", "learned"]}
    found = expand_grid([axis | {"verdict": "adjacency"}])
    assert [(trial.score, trial.rectified) for trial in found] == [
        ("none", True), ("topology", True), ("consensus", False), ("learned", False), ("consensus", "auto"),
        ("learned", "auto"),
    ]  # fmt: skip


@pytest.mark.parametrize("value", ["1", "0", "1.0", '"True"', '"yes"', '"none"', "[]", "[true, [true]]"])
def test_other_values_of_rectified_are_refused_by_name(tmp_path: Path, value: str) -> None:
    with pytest.raises(ValueError, match=r"rectified must (be one of True, False, auto, got|have at least one value)"):
        _read(tmp_path, f"[grid]\nrectified = {value}")


def test_the_tolerance_is_an_axis_whatever_decides(tmp_path: Path) -> None:
    axis = {"max_error_px": [0.5, 1, 3.0], "verdict": "cardinality"}
    found = expand_grid([axis, axis | {"verdict": "score"}])
    assert [(trial.verdict, trial.max_error_px) for trial in found] == [
        (verdict, px) for verdict in ("cardinality", "score") for px in (0.5, 1.0, 3.0)
    ]
    assert _read(tmp_path, "[grid]\nmax_error_px = [2, 5]").trials[1].max_error_px == 5.0
    for bad in ("0.4", "5.5", "nan", '"none"'):
        with pytest.raises(ValueError, match="max_error_px"):
            _read(tmp_path, f"[grid]\nmax_error_px = {bad}")


def test_seeds_count_where_something_is_random() -> None:
    assert len(expand_grid([{"seed": [0, 1], "outlier_rate": 0.1}])) == 2
    assert len(expand_grid([{"seed": [0, 1], "noise_px": 0.1}])) == 2


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[grid]\ncolour = 1", ["colour is no setting", "detector"]),
        ("[grid]\nfast.colour = 1", ["fast.colour", "window_px"]),
        ("[grid]\ndetector = 'orb'", ["detector", "sift, fast, surf, gftt", "'orb'"]),
        ("[grid]\nfast.window_px = 11.5", ["fast.window_px", "int", "11.5"]),
        ("[grid]\nconstrained = 1", ["constrained", "bool"]),
        ("[grid]\nseed = true", ["seed", "int"]),
        ("[grid]\nseed = []", ["seed", "at least one value"]),
        ("[grid]\nfast = 3", ["fast must be a table"]),
        ("[grid]\noutlier_rate = 1.5", ["outlier_rate", "1.5"]),
        ("[grid]\nnoise_px = nan", ["noise_px", "nan"]),
        ("[grid]\nthreshold = nan", ["threshold", "nan"]),
        ("[grid]\nmin_group_size = 3000000000", ["min_group_size", "32 bits"]),
        ("detector = 'fast'", ["detector", "above the tables"]),
        ("export_matches = 1", ["export_matches"]),
        ("[[grid]]\n[[grid]]\nseed = -1", ["grid 2", "seed", "-1"]),
        ("[grid", ["no TOML"]),
        ("[grid]\nrestriction = ['adjacency', 'cardinality']", ["restriction is verdict now"]),
        ("[[grid]]\n[[grid]]\nrestriction = 'adjacency'", ["grid 2: restriction is verdict now"]),
        ("[grid]\nverdict = 'set'", ["verdict", "score, adjacency, cardinality", "'set'"]),
        ("[grid]\nscore = 'best'", ["score", "auto, none, topology, consensus, learned", "'best'"]),
        ("[grid]\nconsensus = 0.2", ["consensus must be a table"]),
        ("[grid]\nconsensus.colour = 1", ["consensus.colour is no setting", "slope"]),
        ("[grid]\nconsensus.slope = 'steep'", ["consensus.slope", "float", "'steep'"]),
        ("[grid]\nscore = 'consensus'\nconsensus.slope = 0", ["ConsensusConfig.slope", "got 0"]),
    ],
)
def test_errors_name_file_and_setting(tmp_path: Path, text: str, words: list[str]) -> None:
    with pytest.raises(ValueError, match=r"sweep\.toml") as error:
        _read(tmp_path, text)
    for word in words:
        assert word in str(error.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.toml"):
        read_grid(tmp_path / "none.toml")


def test_a_trial_needs_the_verdict_of_a_score_for_a_threshold() -> None:
    for verdict in RESTRICTIONS:
        for score in ("auto", "none", "learned"):
            with pytest.raises(ValueError, match=f"threshold needs the verdict 'score', got '{verdict}'"):
                replace(TrialConfig(), verdict=verdict, score=score, threshold=0.5)
    with pytest.raises(ValueError, match="score must not be 'none' where the verdict is 'score'"):
        replace(TrialConfig(), score="none", threshold=0.5)


def test_points_that_contradict_themselves_are_listed_together(tmp_path: Path) -> None:
    text = """
    [grid]
    detector = "fast"
    verdict = ["score", "adjacency", "cardinality"]
    threshold = [0.3, 0.5, "none"]
    """
    with pytest.raises(ValueError, match=r"sweep\.toml") as error:
        _read(tmp_path, text)
    message = str(error.value)
    assert "\n" not in message
    assert "4 of 9 points contradict themselves, put them in tables [[grid]] of their own: " in message
    points = message.split(" of their own: ")[1].split("; ")
    assert [point.split(": ")[0] for point in points] == [
        f"verdict = {verdict}, threshold = {threshold}" for verdict in RESTRICTIONS for threshold in (0.3, 0.5)
    ]
    assert all("threshold needs the verdict 'score'" in point for point in points)
    tables = """
    [[grid]]
    detector = "fast"
    threshold = [0.3, 0.5, "none"]
    [[grid]]
    detector = "fast"
    verdict = ["adjacency", "cardinality"]
    """
    assert [(trial.verdict, trial.score, trial.threshold) for trial in _read(tmp_path, tables).trials] == [
        *(("score", "learned", threshold) for threshold in (0.3, 0.5, None)),
        *((verdict, "none", None) for verdict in RESTRICTIONS),
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("score = ['topology', 'learned']", ["1 of 2 points", "score = topology: threshold must be given"]),
        ("verdict = ['score', 'adjacency']\nscore = 'none'", ["1 of 2 points", "verdict = score: score must not be"]),
        ("threshold = [0.1, 'none']\nmin_precision = [0.9, 'none']",
         ["1 of 4 points", "threshold = 0.1, min_precision = 0.9: min_precision must be None beside threshold"]),
        ("verdict = ['score', 'adjacency']\nscore = ['none', 'topology']\nthreshold = 0.5",
         ["3 of 4 points", "verdict = score, score = none", "verdict = adjacency, score = none",
          "verdict = adjacency, score = topology"]),
        ("verdict = 'adjacency'\nthreshold = 0.3", ["sweep.toml: threshold needs the verdict 'score'"]),
        ("score = 'topology'\nmin_precision = 0.9", ["sweep.toml: threshold must be given", "min_precision needs a"]),
    ],
)  # fmt: skip
def test_what_contradicts_itself_is_named_with_its_reason(tmp_path: Path, text: str, words: list[str]) -> None:
    with pytest.raises(ValueError, match=r"sweep\.toml") as error:
        _read(tmp_path, f"[grid]\n{text}")
    for word in words:
        assert word in str(error.value)
    assert ("points" in str(error.value)) == ("[" in text)


def test_points_that_are_errors_or_equal_are_explained_one_by_one(tmp_path: Path) -> None:
    path = tmp_path / "sweep.toml"
    path.write_text(
        'grid = [{verdict = ["cardinality", "score"], threshold = ["none", 0.3], seed = [0, 1]}, {seed = 2}]'
    )
    lines = explain_grid(path)
    errors = [line for line in lines if "an error" in line]
    assert len(errors) == 2
    assert errors[0].startswith("grid 1: verdict = cardinality, threshold = 0.3, seed = 0: an error: ")
    assert "threshold" in errors[0].split("an error: ")[1]
    assert [line for line in lines if line not in errors] == [
        f"grid 1: verdict = {verdict}, threshold = {threshold}, seed = 1: the same as grid 1: verdict = {verdict}, "
        f"threshold = {threshold}, seed = 0; what tells them apart is not used"
        for verdict, threshold in (("cardinality", "none"), ("score", "none"), ("score", 0.3))
    ] + [
        "grid 2: the only point: the same as grid 1: verdict = score, threshold = none, seed = 0; what tells them "
        "apart is not used"
    ]
    path.write_text('[grid]\ndetector = ["fast", "sift"]\n')
    assert explain_grid(path) == []


def test_of_many_contradictions_the_first_are_listed_and_all_are_counted() -> None:
    seeds = {"seed": list(range(50)), "outlier_rate": 0.1}
    with pytest.raises(ValueError, match=r"^grid 2: 50 of 50 points") as error:
        expand_grid([seeds, seeds | {"verdict": "adjacency", "min_precision": 0.9}])
    assert re.findall(r"seed = (\d+): min_precision needs", str(error.value)) == [str(seed) for seed in range(20)]
    assert str(error.value).endswith("; ...")


AXES = {
    "verdict": VERDICTS,
    "score": ("auto", "none", *SCORES),
    "threshold": (None, 0.5),
    "min_precision": (None, 0.9),
    "temperature": (1.0, 2.0),
    "consensus.slope": (0.1, 0.2),
}


@given(st.fixed_dictionaries({name: st.lists(st.sampled_from(some), min_size=1, unique=True)
                              for name, some in AXES.items()}))  # fmt: skip
def test_a_grid_is_all_of_its_points_or_an_error_that_names_those_without_sense(axes: dict[str, list[Any]]) -> None:
    """Against points that are made one by one: none is dropped, none changes what decides."""
    table = {name: values for name, values in axes.items() if name != "consensus.slope"}
    table["consensus"] = {"slope": axes["consensus.slope"]}
    good, bad = [], []
    for values in itertools.product(*axes.values()):
        settings = dict(zip(axes, values, strict=True))
        slope = settings.pop("consensus.slope")
        try:
            good.append(TrialConfig(**settings, consensus=ConsensusConfig(slope=slope)))
        except ValueError as error:
            bad.append(str(error))
    if not bad:
        found = expand_grid([table])
        assert set(found) == {simplify(trial) for trial in good}
        assert len(set(found)) == len(found)
        decided = {(trial.verdict, trial.resolved_score, trial.threshold, trial.min_precision) for trial in good}
        assert {(trial.verdict, trial.score, trial.threshold, trial.min_precision) for trial in found} == decided
        return
    with pytest.raises(ValueError, match=re.escape(bad[0])) as caught:
        expand_grid([table])
    message = str(caught.value)
    assert all(reason in message for reason in bad[:20])
    assert f"{len(bad)} of {len(bad) + len(good)} points" in message or len(bad) + len(good) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = " + "[" * 5000, "is no TOML file"),
        ("[grid]\nfast.window_px = " + "{a=" * 1000, "is no TOML file"),
        (".".join(["a"] * 60000) + " = 1", "a key must have at most 32 parts"),
        ("x = {" + '."b".'.join(["a"] * 60) + " = 1}", "a key must have at most 32 parts"),
        ("# " + "x" * (1 << 20), "must have at most 1048576 bytes"),
        (
            "[grid]\nseed = " + str(list(range(400))) + "\noutlier_rate = " + str([k / 1000 for k in range(400)]),
            "points",
        ),
        ("[grid]\nfast.window_px = 2147483647", "FASTConfig.window_px must be odd and lie in"),
    ],
)
def test_a_file_that_would_take_gigabytes_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "sweep.toml").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_grid(tmp_path / "sweep.toml")


def test_many_floats_are_no_long_key(tmp_path: Path) -> None:
    (tmp_path / "sweep.toml").write_text("[grid]\noutlier_rate = [" + ", ".join(f"0.{k:03}" for k in range(60)) + "]\n")
    assert len(read_grid(tmp_path / "sweep.toml").trials) == 60
