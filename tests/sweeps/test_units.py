"""What a worker does with its units."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tensor_stereo.configs import SweepConfig
from tensor_stereo.datasets import PairFiles
from tensor_stereo.sweeps import build_plan, expand_grid, units
from tensor_stereo.sweeps.units import FeatureCache, run_tasks
from tests.sweeps.conftest import OF_THE_RUN, write_pairs

CONFIG = SweepConfig(expand_grid([{"detector": ["fast", "gftt"], "verdict": "cardinality", "score": "none"}]))


@pytest.fixture
def sequence(tmp_path: Path) -> list[PairFiles]:
    """Five views in a row, of which each pair takes two neighbours, and the first view against the last."""
    write_pairs(tmp_path / "p", 5)
    views = [tmp_path / "p" / f"synthetic-0{k}-0.png" for k in range(5)]
    pairs = [PairFiles("row", str(k), views[k], views[k + 1]) for k in range(4)]
    return [*pairs, PairFiles("row", "ends", views[0], views[4])]


@pytest.fixture
def detected(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Counts the images that are detected, from an empty cache on."""
    counts: list[int] = []
    detect = units.detect_images

    def counting(images: Any, config: Any) -> Any:
        counts.append(len(images))
        return detect(images, config)

    monkeypatch.setattr(units, "detect_images", counting)
    monkeypatch.setattr(units, "_FEATURES", FeatureCache())
    return counts


def test_an_image_of_several_pairs_is_detected_once(
    sequence: list[PairFiles], detected: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = build_plan(CONFIG, sequence)
    tasks = [plan.task(int(unit)) for unit in plan.shard(1, 1)]
    together = run_tasks(CONFIG, tasks)
    assert sum(detected) == 2 * 5  # by each detector
    alone = []
    for task in tasks:
        monkeypatch.setattr(units, "_FEATURES", FeatureCache())
        alone.append(run_tasks(CONFIG, [task]).metrics.drop(OF_THE_RUN))
    for task, metrics in zip(tasks, alone, strict=True):
        assert together.metrics.filter(unit=task.unit).drop(OF_THE_RUN).equals(metrics)
    assert (together.metrics["seconds"].struct.field("detect") > 0).all()  # also where it was shared


def test_few_images_are_held(sequence: list[PairFiles], detected: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(units, "_IMAGES_HELD", 2)
    config = SweepConfig(CONFIG.trials[:1])
    plan = build_plan(config, sequence)
    run_tasks(config, [plan.task(int(unit)) for unit in plan.shard(1, 1)])
    assert sum(detected) == 5 + 1  # the first view was forgotten, the last one not
    assert len(units._FEATURES._held) == 2
