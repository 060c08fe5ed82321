"""Batches of putative matches for the tests of file formats, and the verdicts that they must get."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from tensor_stereo import DelaunayFilter, Matches, classify_matches
from tensor_stereo.batching import collate_matches
from tensor_stereo.configs import ConsensusConfig
from tensor_stereo.interop.verdicts import Verdicts
from tests.interop.matchers import scene


def batch(seed: int, sizes: Sequence[int] = (60, 0, 1, 3, 45), *, has_group: bool = False) -> Matches:
    """Pairs of the given sizes in float64, with wrong matches, costs and keypoints that occur twice."""
    items = []
    for b, n in enumerate(sizes):
        left, right = (points.double() for points in scene(seed + b, n))
        rng = np.random.default_rng([seed, b])
        if n > 10:
            left[3], right[7] = left[0], right[1]
        cost = torch.from_numpy(rng.random(n))
        group = torch.from_numpy(rng.integers(-1, 2, n)) if has_group else None
        items.append(Matches(left, right, torch.tensor([0, n]), cost, group))
    return collate_matches(items)


def expected(
    matches: Matches, threshold: float | None = None, consensus: ConsensusConfig | None = None, **settings: object
) -> Verdicts:
    """Inlier and relation by classify_matches, the score by DelaunayFilter."""
    verdict = classify_matches(matches, **settings)  # type: ignore[arg-type]
    output = DelaunayFilter(threshold=threshold, consensus=consensus, **settings)(matches)  # type: ignore[arg-type]
    inlier = verdict.inlier if threshold is None else output.inlier
    return Verdicts(inlier.numpy(), output.score.numpy(), verdict.relation.numpy())
