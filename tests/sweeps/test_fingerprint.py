from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tensor_stereo.datasets import PairFiles
from tensor_stereo.sweeps.run import _fingerprint

PATHS = ("image0", "image1", "disparity_gt")
FIELDS = ("dataset", "scene", *PATHS, "gt_scale", "mask", "disparity_noc_gt", "calibration", "gt_encoding")


def _of(*pairs: PairFiles) -> str:
    plan: Any = SimpleNamespace(pairs=pairs)
    return _fingerprint(plan)


def test_pairs_without_bits_have_the_fingerprint_of_earlier_releases() -> None:
    """So that a run that began before PairFiles had the field goes on."""
    pair = PairFiles("mine", "a", Path("a.png"), Path("b.png"), Path("d.pfm"), 1.0)
    rows = [[str(getattr(pair, name)) for name in FIELDS]]
    assert _of(pair) == hashlib.sha256(json.dumps(rows).encode()).hexdigest()
    assert _of(replace(pair, sample_bits=12)) != _of(pair)
    assert _of(replace(pair, sample_bits=12)) != _of(replace(pair, sample_bits=10))
