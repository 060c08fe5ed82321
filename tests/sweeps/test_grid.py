from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tensor_stereo.configs import TrialConfig
from tensor_stereo.sweeps import expand_grid, read_grid


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
    assert _read(tmp_path, "").trials == (TrialConfig(),)


@pytest.mark.parametrize(
    "unused",
    [
        {"seed": [0, 1, 2]},
        {"sift": {"max_keypoints": [5, 6]}},
        {"score": "none", "temperature": [0.5, 1.0], "temperature_unit": ["edge", "px"]},
        {"threshold": 0.5, "restriction": ["adjacency", "cardinality"]},
        {"min_precision": 0.5, "restriction": ["adjacency", "cardinality"]},
        {"objects": {"element_px": [3, 5]}},
    ],
)
def test_points_that_differ_only_in_unused_settings_are_one(unused: dict[str, object]) -> None:
    assert len(expand_grid([unused])) == 1


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


def test_a_trial_needs_a_score_for_a_threshold() -> None:
    with pytest.raises(ValueError, match="threshold"):
        replace(TrialConfig(), score="none", threshold=0.5)
