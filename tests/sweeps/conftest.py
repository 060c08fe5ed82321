from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import polars as pl
import pytest

from tensor_stereo.configs import SweepConfig, SyntheticConfig
from tensor_stereo.datasets import build_manifest, write_manifest, write_synthetic
from tensor_stereo.sweeps import read_grid, read_results

SMALL = SyntheticConfig(width_px=160, height_px=120, min_disparity_px=3, max_disparity_px=20)
OF_THE_RUN = ("seconds", "host", "attempt")  # columns that differ between runs of one sweep

GRID = """
[grid]
detector = ["fast", "gftt"]
verdict = ["adjacency", "cardinality"]
score = "topology"
outlier_rate = [0.0, 0.4]
"""


class Inputs(NamedTuple):
    """A small sweep: rendered pairs on disk, their manifest, and a grid with two detectors."""

    folder: Path
    manifest: Path
    settings: Path
    config: SweepConfig


def write_pairs(folder: Path, num_pairs: int) -> Path:
    """Small rendered pairs, and the list of them."""
    return write_synthetic(folder, num_pairs, seed=7, config=SMALL)


def make_manifest(pairs: Path) -> Path:
    path = pairs.with_suffix(".parquet")
    write_manifest(build_manifest([pairs]), path)
    return path


def stored(run: Path) -> pl.DataFrame:
    """What a run holds, without what differs between runs."""
    return read_results(run).drop(OF_THE_RUN)


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    folder = tmp_path_factory.mktemp("sweep")
    manifest = make_manifest(write_pairs(folder / "pairs", 6))
    settings = folder / "sweep.toml"
    settings.write_text(GRID)
    return Inputs(folder, manifest, settings, read_grid(settings))


@pytest.fixture(scope="session")
def expected(inputs: Inputs) -> pl.DataFrame:
    """The rows of that sweep, computed in this process by :func:`score_dataset`."""
    from tensor_stereo.datasets import PairDataset, read_manifest
    from tensor_stereo.evaluation.dataset import score_dataset

    rows = score_dataset(PairDataset(read_manifest(inputs.manifest)), inputs.config)
    return rows.drop("seconds")


def assert_same(found: pl.DataFrame, expected: pl.DataFrame) -> None:
    """Every row of the sweep once, whatever their order, with the same values bit for bit."""
    keys = ["dataset", "scene", "trial"]
    assert found.drop("unit").sort(keys).equals(expected.sort(keys))
