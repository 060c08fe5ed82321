"""Batches of putative matches for the tests of file formats, and the verdicts that they must get."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from tensor_stereo import DelaunayFilter, FilterConfig, Matches, classify_matches
from tensor_stereo.batching import collate_matches
from tensor_stereo.interop.glue_factory import two_view_filter
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


def expected(matches: Matches, **settings: object) -> Verdicts:
    """Relation, and the verdicts of the paper, by classify_matches; scores and verdicts by them by DelaunayFilter."""
    config = FilterConfig(**settings)  # type: ignore[arg-type]
    set_test = classify_matches(
        matches,
        restriction="cardinality" if config.verdict == "score" else config.verdict,
        min_group_size=config.min_group_size,
        tie_tolerance=config.tie_tolerance,
        backend=config.backend,
    )
    inlier, score = set_test.inlier, None
    if config.resolved_score != "none":
        output = DelaunayFilter(config)(matches)
        score = output.score.double().numpy()
        inlier = output.inlier if config.verdict == "score" else inlier
    return Verdicts(inlier.numpy(), score, set_test.relation.numpy())


def expected_of_any_views(matches: Matches) -> Verdicts:
    """The default of files and adapters, whose pairs need not be rectified."""
    return expected(matches, rectified="auto")


def exact_filter() -> DelaunayFilter:
    """One for any two views whose bits do not depend on the other pairs of the batch, as those of ``learned`` do."""
    return two_view_filter(score="consensus")


def expected_exactly(matches: Matches) -> Verdicts:
    """What :func:`exact_filter` says."""
    return expected(matches, rectified="auto", score="consensus")
