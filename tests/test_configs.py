"""Settings: every one is checked when it is made, and contradictions are named."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tensor_stereo as ts
from tensor_stereo import configs, step_configs
from tensor_stereo.configs import (
    CUTS,
    RESTRICTIONS,
    SCORES,
    EvaluationConfig,
    FASTConfig,
    FilterConfig,
    GFTTConfig,
    MatchingConfig,
    ObjectsConfig,
    PipelineConfig,
    SGBMConfig,
    SIFTConfig,
    SURFConfig,
    SyntheticConfig,
    TrialConfig,
)

WRONG: list[tuple[type, str, object]] = [
    (FilterConfig, "verdict", "nonsense"),
    (FilterConfig, "verdict", None),
    (FilterConfig, "score", "best"),
    (FilterConfig, "threshold", 7.0),
    (FilterConfig, "threshold", math.nan),
    (FilterConfig, "min_precision", -0.1),
    (FilterConfig, "target_sensitivity", "0.9"),
    (FilterConfig, "min_group_size", 0),
    (FilterConfig, "min_group_size", -5),
    (FilterConfig, "min_group_size", 4.5),
    (FilterConfig, "tie_tolerance", 1.0),
    (FilterConfig, "tie_tolerance", -1e-9),
    (FilterConfig, "temperature", -1.0),
    (FilterConfig, "temperature", 0.0),
    (FilterConfig, "temperature", math.nan),
    (FilterConfig, "temperature_unit", "cm"),
    (FilterConfig, "backend", "gpu"),
    (FilterConfig, "consensus", 3),
    *((ts.ConsensusConfig, name, value) for name in ("slope", "reach", "doubt") for value in (0, -1.0, math.inf, "1")),
    (ts.ConsensusConfig, "tolerance_px", math.nan),
    (ts.ConsensusConfig, "whole_row_tolerance_px", None),
    (ts.ConsensusConfig, "row_tolerance_px", 0.0),
    (ts.ConsensusConfig, "cost_weight", -1.0),
    *((ts.ConsensusConfig, "num_rounds", value) for value in (0, 1.5, 1001, True)),
    (SIFTConfig, "backend", "x"),
    (SIFTConfig, "max_ratio", 0.0),
    (SIFTConfig, "upright", 1),
    (FASTConfig, "threshold", 256),
    (FASTConfig, "max_keypoints", 0),
    (FASTConfig, "window_px", 4),
    (SURFConfig, "num_octaves", 0),
    (SURFConfig, "num_octaves", 9),
    (SURFConfig, "num_scales", 2),
    (SURFConfig, "initial_step_px", 0),
    (SURFConfig, "threshold", -1.0),
    (GFTTConfig, "quality_level", 0.0),
    (GFTTConfig, "quality_level", 1.1),
    (GFTTConfig, "min_distance_px", -1),
    (MatchingConfig, "max_ratio", 0.0),
    (MatchingConfig, "max_ratio", 1.1),
    (MatchingConfig, "max_ratio", math.nan),
    (MatchingConfig, "max_row_offset_px", -1.0),
    (MatchingConfig, "max_row_offset_px", math.nan),
    (MatchingConfig, "min_disparity_px", math.inf),
    (MatchingConfig, "max_disparity_px", -math.inf),
    (MatchingConfig, "max_disparity_px", math.nan),
    (MatchingConfig, "mutual", "yes"),
    (MatchingConfig, "method", "bm"),
    *((SGBMConfig, "window_px", value) for value in (0, 4, 13, 5.0)),
    *((SGBMConfig, "num_disparities_px", value) for value in (0, 100, -16, 1040, 16.0)),
    (SGBMConfig, "min_disparity_px", 0.5),
    (SGBMConfig, "min_disparity_px", -1001),
    (SGBMConfig, "step_penalty_levels", 0.0),
    (SGBMConfig, "step_penalty_levels", 32.0),  # not less than the other
    (SGBMConfig, "jump_penalty_levels", math.inf),
    (SGBMConfig, "mode", "hh4"),
    (SGBMConfig, "left_right", 1),
    (ObjectsConfig, "element_px", 4),
    (ObjectsConfig, "min_area_px", -1.0),
    (PipelineConfig, "detector", "orb"),
    (PipelineConfig, "fast", SIFTConfig()),
    (TrialConfig, "outlier_rate", 1.5),
    (TrialConfig, "noise_px", math.inf),
    (TrialConfig, "seed", -1),
    (EvaluationConfig, "detectors", ("fast", "orb")),
    (EvaluationConfig, "max_error_px", 0.0),
    (SyntheticConfig, "width_px", 0),
    (SyntheticConfig, "gain", -1.0),
]


@pytest.mark.parametrize(("kind", "name", "value"), WRONG)
def test_a_wrong_value_is_named_with_its_setting(kind: type, name: str, value: object) -> None:
    with pytest.raises((ValueError, TypeError), match=rf"{name}.* must .*, got "):
        kind(**{name: value})


@pytest.mark.parametrize("kind", [k for k in vars(configs).values() if isinstance(k, type) and k.__name__ != "Within"])
def test_every_settings_object_checks_itself(kind: type) -> None:
    if kind.__module__ in (configs.__name__, step_configs.__name__):
        assert "__post_init__" in {name for base in kind.__mro__ for name in vars(base)}
        for field in fields(kind):
            with pytest.raises((ValueError, TypeError), match=field.name):
                kind(**{field.name: object()})


def test_numbers_of_numpy_are_numbers() -> None:
    config = FilterConfig(threshold=np.float32(0.5), min_group_size=np.int64(3))  # type: ignore[arg-type]
    assert (config.threshold, config.min_group_size) == (0.5, 3)


def test_bounds_of_the_gates_must_be_in_order() -> None:
    with pytest.raises(ValueError, match=r"must be at most MatchingConfig\.max_disparity_px, got 5\.0 > 4\.0"):
        MatchingConfig(min_disparity_px=5.0, max_disparity_px=4.0)


@pytest.mark.parametrize(("name", "value", "off"), [("max_ratio", 0.8, "None"), ("mutual", True, "False")])
def test_semi_global_matching_compares_no_neighbours(name: str, value: Any, off: str) -> None:
    words = rf"MatchingConfig\.{name} must be {off} where MatchingConfig\.method is 'sgbm', got {value}"
    with pytest.raises(ValueError, match=words):
        MatchingConfig(method="sgbm", **{name: value})
    sift = PipelineConfig(detector="sift", matching=MatchingConfig(method="sgbm"))
    assert sift.resolved_matching.max_ratio is None


@pytest.mark.parametrize("kind", [PipelineConfig, TrialConfig, EvaluationConfig])
def test_semi_global_matching_is_for_rectified_pairs(kind: type) -> None:
    matching = MatchingConfig(method="sgbm")
    assert kind(matching=matching).rectified is True
    for rectified in (False, "auto"):
        with pytest.raises(ValueError, match=r"^rectified must be True where MatchingConfig\.method is 'sgbm'"):
            kind(matching=matching, rectified=rectified)


def is_contradiction(settings: dict[str, Any]) -> bool:
    """The rules of the verdict, said once more."""
    given = [name for name in CUTS if settings[name] is not None]
    if settings["verdict"] in RESTRICTIONS:
        return bool(given)
    if len(given) > 1 or settings["score"] == "none":
        return True
    return settings["score"] == "topology" and given != ["threshold"]


@given(
    st.fixed_dictionaries(
        {
            "verdict": st.sampled_from(["score", *RESTRICTIONS]),
            "score": st.sampled_from(["auto", "none", *SCORES]),
            **{name: st.sampled_from([None, 0.5]) for name in CUTS},
        }
    ),
    st.sampled_from([FilterConfig, PipelineConfig, TrialConfig, EvaluationConfig, ts.DelaunayFilter]),
)
def test_contradictions_are_refused_in_every_entry_point(settings: dict[str, Any], kind: type) -> None:
    if is_contradiction(settings):
        with pytest.raises(ValueError, match=r"threshold|target_sensitivity|min_precision|score"):
            kind(**settings)
    else:
        kind(**settings)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"threshold": 0.5, "min_precision": 0.5}, "min_precision must be None beside threshold, got 0.5"),
        ({"verdict": "adjacency", "threshold": 0.3}, "threshold needs the verdict 'score', got 'adjacency' with 0.3"),
        ({"score": "none"}, "score must not be 'none' where the verdict is 'score'"),
        ({"score": "topology"}, "threshold must be given where the score is 'topology', which is no probability"),
        ({"score": "topology", "min_precision": 0.5}, "topology', which is no probability; min_precision needs"),
    ],
)
def test_a_contradiction_says_what_to_set(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        FilterConfig(**settings)


def test_auto_stands_for_the_best_score_that_is_asked_for() -> None:
    assert FilterConfig().resolved_score == "learned"
    for restriction in RESTRICTIONS:
        assert FilterConfig(verdict=restriction).resolved_score == "none"
        assert ts.DelaunayFilter(verdict=restriction).config.resolved_score == "topology"
    assert ts.DelaunayFilter().config.resolved_score == "learned"


def test_old_names_fail_with_the_new_one() -> None:
    with pytest.raises(TypeError, match="has no setting 'restriction'; it is 'verdict' now"):
        ts.DelaunayFilter(restriction="adjacency")
    with pytest.raises(TypeError, match="has no setting 'unit'; it is 'temperature_unit' now"):
        ts.DelaunayFilter(unit="px")
    with pytest.raises(TypeError, match="has no setting 'treshold'; known are verdict, score, threshold"):
        ts.DelaunayFilter(treshold=0.5)
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        _ = configs.Nothing


def test_files_differ_in_one_default_alone() -> None:
    loose, default = vars(configs.FileFilterConfig()), vars(FilterConfig())
    assert loose == default | {"rectified": "auto"}
    assert default["rectified"] is True
    for kind in (PipelineConfig, TrialConfig, EvaluationConfig):
        assert kind().rectified is True


@pytest.mark.parametrize("value", [1, 0, 1.0, "yes", "True", "AUTO", None, np.True_, np.array([True]), ("auto",)])
@pytest.mark.parametrize("kind", [FilterConfig, configs.FileFilterConfig, PipelineConfig, EvaluationConfig])
def test_rectified_is_a_boolean_or_auto(kind: type, value: object) -> None:
    for known in (True, False, "auto"):
        assert kind(rectified=known).rectified is known
    with pytest.raises((ValueError, TypeError), match=r"^rectified must be one of True, False, auto, got"):
        kind(rectified=value)
    with pytest.raises((ValueError, TypeError), match=r"^rectified must be one of True, False, auto, got"):
        ts.DelaunayFilter(rectified=value)


def test_settings_of_another_kind_are_not_those_of_the_module() -> None:
    for config in ("cardinality", {"verdict": "cardinality"}):
        with pytest.raises(TypeError, match="config must be a FilterConfig"):
            ts.DelaunayFilter(config)  # type: ignore[arg-type]
    assert ts.DelaunayFilter(configs.FileFilterConfig()).config.rectified == "auto"
    with pytest.raises(ValueError, match="min_precision must be None beside threshold"):
        configs.FileFilterConfig(threshold=0.3, min_precision=0.9)


@pytest.mark.parametrize("name", ["row_tolerance_px", "whole_row_tolerance_px"])
def test_consensus_always_looks_at_rows(name: str) -> None:
    with pytest.raises(TypeError, match=rf"ConsensusConfig\.{name} must be a number, got None"):
        ts.ConsensusConfig(**{name: None})


@pytest.mark.parametrize("detectors", [(), ("fast", "fast")])
def test_an_evaluation_needs_each_detector_once(detectors: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="detectors must"):
        EvaluationConfig(detectors=detectors)


def test_numbers_of_numpy_become_those_of_python() -> None:
    config = FilterConfig(tie_tolerance=np.float32(0.25), min_group_size=np.int64(3))  # type: ignore[arg-type]
    assert type(config.tie_tolerance) is float
    assert type(config.min_group_size) is int
    module = ts.DelaunayFilter(config)
    module.load_state_dict(module.state_dict())  # the fingerprint is JSON
