"""Stored matches in a DataLoader."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch.utils.data import DataLoader

from tensor_stereo.configs import SweepConfig
from tensor_stereo.sweeps import MatchDataset, StoredMatches, expand_grid, read_matches, read_results, run_sweep
from tests.sweeps.conftest import Inputs


@pytest.fixture(scope="module")
def run(inputs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six pairs in three parts, under two points, one without a score."""
    grid = [{"detector": "fast", "verdict": "cardinality", "score": ["none", "topology"]}]
    out = tmp_path_factory.mktemp("matches") / "run"
    config = SweepConfig(expand_grid(grid), export_matches=True)
    for limit in (2, 4, 6):
        run_sweep(config, inputs.manifest, out, num_workers=1, limit=limit - len(_units(out)))
    return out


def _units(out: Path) -> set[int]:
    return set(read_results(out)["unit"]) if out.exists() else set()


def _same(found: StoredMatches, expected: StoredMatches) -> bool:
    tensors = ("inlier", "relation", "correct", "valid")
    same = all(torch.equal(getattr(found, name), getattr(expected, name)) for name in tensors)
    return same and torch.equal(found.matches.keypoints1, expected.matches.keypoints1)


@pytest.mark.parametrize("trial", [0, 1])
def test_it_gives_what_read_matches_gives(run: Path, trial: int) -> None:
    found = list(MatchDataset(run, trial=trial))
    assert sorted(one.scene for one in found) == [f"synthetic-0{k}" for k in range(6)]
    for one in found:
        assert _same(one, read_matches(run, one.dataset, one.scene, trial=trial))
        assert (one.score is None) == (trial == 0)
        assert one.matches.num_matches > 0


@pytest.mark.slow
def test_workers_share_the_parts(run: Path) -> None:
    data = MatchDataset(run, shuffle=True)
    loader = DataLoader(data, batch_size=None, num_workers=2, multiprocessing_context="spawn")
    assert sorted(one.scene for one in loader) == [f"synthetic-0{k}" for k in range(6)]


def test_shards_are_a_partition_and_epochs_differ(run: Path) -> None:
    for count in (2, 5):  # by parts, and where these are too few by pairs
        shards = [[one.scene for one in MatchDataset(run, shard=(k, count), shuffle=True)] for k in range(1, count + 1)]
        assert sorted(scene for shard in shards for scene in shard) == [f"synthetic-0{k}" for k in range(6)]
    dataset = MatchDataset(run, shuffle=True)
    orders = [tuple(one.scene for one in dataset) for _ in range(8)]
    assert len(set(orders)) > 1
    assert orders[0] == tuple(one.scene for one in MatchDataset(run, shuffle=True))


def test_bad_input_is_named(run: Path, inputs: Inputs, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="shard"):
        MatchDataset(run, shard=(3, 2))
    with pytest.raises(ValueError, match="trial must be one of the 2 points"):
        MatchDataset(run, trial=2)
    with pytest.raises(FileNotFoundError, match="no run"):
        MatchDataset(tmp_path)
    config = SweepConfig(expand_grid([{"detector": "fast", "verdict": "cardinality", "score": "none"}]))
    run_sweep(config, inputs.manifest, tmp_path / "run", num_workers=1, limit=1)
    with pytest.raises(ValueError, match="export_matches"):
        MatchDataset(tmp_path / "run")
