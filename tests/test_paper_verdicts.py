"""The verdicts of the paper stay what they were, bit for bit, on its eight scenes."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from tensor_stereo.configs import Detector, GFTTConfig, PipelineConfig, SIFTConfig
from tensor_stereo.datasets import PairDataset, find_pairs
from tensor_stereo.pipeline import run_pipeline
from tests.test_pipeline import EIGHT

RECORD = Path(__file__).with_name("paper_digests.json")


@pytest.mark.parametrize("detector", ["sift", "fast", "gftt"])
def test_relations_and_verdicts_are_those_before_the_score_decided(detector: Detector, data_root: Path) -> None:
    known = json.loads(RECORD.read_text())["digests"]
    found: dict[str, dict[str, dict[str, str]]] = {}
    for pair in PairDataset(find_pairs(data_root / "middlebury", scenes=EIGHT)):
        for constrained in (False, True):
            column = f"{detector}, {'constrained' if constrained else 'unconstrained'}"
            digests = found.setdefault(pair.name.lower(), {}).setdefault(column, {})
            for size in (1, 4):
                for restriction in ("adjacency", "cardinality"):
                    config = PipelineConfig(
                        detector=detector,
                        constrained=constrained,
                        verdict=restriction,
                        min_group_size=size,
                        sift=SIFTConfig(backend="opencv"),
                        gftt=GFTTConfig(backend="opencv"),
                    )
                    verdict = run_pipeline([(pair.image0, pair.image1)], config).classification
                    data = verdict.relation.numpy().tobytes() + verdict.inlier.numpy().tobytes()
                    digests[f"{restriction}, {size}"] = hashlib.sha256(data).hexdigest()[:16]
    assert len(found) == len(EIGHT)
    for scene, columns in found.items():
        for column, digests in columns.items():
            assert digests == known[scene][column], f"{scene}, {column}"
