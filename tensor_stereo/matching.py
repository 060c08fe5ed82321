"""Putative matches: nearest neighbours by the sum of squared differences (SSD), with optional gates and tests."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from tensor_stereo.configs import MatchingConfig, PipelineConfig
from tensor_stereo.ops import nearest_ssd
from tensor_stereo.ops.reference_ssd import NONE, open_gates, pack
from tensor_stereo.types import Features, Matches


class MatchIndices(NamedTuple):
    """Putative matches of B pairs as rows of the two :class:`Features`.

    Attributes:
        index0: (M,) int64 rows of ``features0``, increasing.
        index1: (M,) int64 rows of ``features1``.
        cost: (M,) float32 SSD.
        ptr: (B + 1,) int64 offsets of the pairs.
    """

    index0: Tensor
    index1: Tensor
    cost: Tensor
    ptr: Tensor


def match_features(features0: Features, features1: Features, config: PipelineConfig | None = None) -> Matches:
    """Match image b of ``features0`` with image b of ``features1``, for all b.

    See :func:`match_indices`, which returns the same matches as indices. Gradients flow from the matched keypoints to
    those of the features; none flow from ``cost``.

    Args:
        features0: keypoints and descriptors of B images, view 0 (left).
        features1: those of the B partners, view 1 (right).
        config: gates and tests in ``config.matching``, whose ratio can come from the detector, and the back end; None
            means the defaults: the nearest neighbour, one-to-one.

    Returns:
        One-to-one matches in the order of the keypoints of view 0, with their SSD as ``cost``.

    Raises:
        ValueError: as :func:`match_indices`.

    >>> points, ptr = torch.tensor([[9.0, 4.0], [5.0, 4.0]]), torch.tensor([0, 2])
    >>> features0 = Features(points, ptr, torch.tensor([[1.0], [7.0]]), torch.ones(2))
    >>> features1 = Features(points - torch.tensor([2.0, 0.0]), ptr, torch.tensor([[2.0], [7.0]]), torch.ones(2))
    >>> matches = match_features(features0, features1)
    >>> matches.disparity, matches.cost
    (tensor([2., 2.]), tensor([1., 0.]))
    """
    found = match_indices(features0, features1, config)
    keypoints0, keypoints1 = features0.keypoints[found.index0], features1.keypoints[found.index1]
    return Matches(keypoints0, keypoints1, found.ptr, cost=found.cost)


@torch.no_grad()
def match_indices(features0: Features, features1: Features, config: PipelineConfig | None = None) -> MatchIndices:
    """Nearest neighbours of the keypoints of view 0 among those of view 1, for every pair of a ragged batch.

    In this order:

    1. A candidate is a pair of keypoints inside the gates: y1 within y0 +- ``max_row_offset_px``, x1 between x0 -
       ``max_disparity_px`` and x0 - ``min_disparity_px``, bounds included. Without gates every pair is one.
    2. A keypoint of view 0 takes its candidate of lowest cost, of equal ones that of the lowest index.
    3. ``max_ratio`` r (Lowe, IJCV 60(2), 2004, section 7.1) keeps it iff the distance, the root of the cost, is at
       most r times that of the second-best candidate. Without a second candidate, or with both distances zero, there
       is no evidence and no match, as in ``kornia.feature.match_snn`` (with gates of 1 row and 128 px, 55 % of SIFT's
       lone candidates in the paper's scenes are correct, against 79 % of those that pass at 0.8).
    4. ``mutual`` keeps it iff view 1's keypoint has no cheaper candidate, and no equal one of a lower index.
    5. Of the matches that share a keypoint of view 1 the cheapest stays, of equal ones that of the lowest index.

    The cost is the SSD, the float32 sum of (a - b)**2 over the descriptor. It does not depend on the rest of the
    batch. For windows of whole grey levels it is exact up to 2**24. No matrix of all costs is
    formed: :func:`tensor_stereo.ops.nearest_ssd` finds the neighbours. No gradient.

    Args:
        features0: keypoints and descriptors of B images, view 0 (left).
        features1: those of the B partners, view 1 (right).
        config: gates and tests in ``config.matching``, whose ratio can come from the detector, and the back end; None
            means the defaults: the nearest neighbour, one-to-one.

    Returns:
        Rows of both features and the cost of each match. Images without keypoints have no match.

    Raises:
        ValueError: if the features differ in the number of images or in descriptor length, or hold values that are not
            finite (descriptors; with gates, keypoints beyond 2**24 px); if the settings ask for another method.

    >>> ptr = torch.tensor([0, 2])
    >>> features = Features(torch.zeros(2, 2), ptr, torch.tensor([[3.0], [5.0]]), torch.ones(2))
    >>> match_indices(features, features).index1
    tensor([0, 1])
    """
    config = config or PipelineConfig()
    matching = config.resolved_matching
    if matching.method != "ssd":
        raise ValueError(f"MatchingConfig.method must be 'ssd' where descriptors are matched, got {matching.method!r}")
    features0, features1 = (replace(f, descriptors=f.descriptors.float()) for f in (features0, features1))
    _check_features(features0, features1)
    found = nearest_ssd(
        features0.keypoints,
        features1.keypoints,
        features0.descriptors,
        features1.descriptors,
        features0.ptr,
        features1.ptr,
        *open_gates(matching),
        config.backend,
    )
    index0, index1, cost = _select(*found, matching)
    return MatchIndices(index0, index1, cost, torch.searchsorted(index0, features0.ptr))


def _check_features(features0: Features, features1: Features) -> None:
    """Raise unless the features fit each other."""
    if features0.num_images != features1.num_images:
        counts = f"{features0.num_images} and {features1.num_images}"
        raise ValueError(f"features0 and features1 must hold the same number of images, got {counts}")
    if features0.descriptors.shape[1:] != features1.descriptors.shape[1:] or features0.descriptors.ndim != 2:
        shapes = f"{tuple(features0.descriptors.shape)} and {tuple(features1.descriptors.shape)}"
        raise ValueError(f"descriptors of features0 and features1 must be (N, D) with one D, got {shapes}")


def _select(
    cost: Tensor, index1: Tensor, second_cost: Tensor, cost1: Tensor, best0: Tensor, matching: MatchingConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """index0, index1 and cost of the nearest neighbours that pass the tests and stay one-to-one."""
    keep = index1 >= 0
    if matching.max_ratio is not None:
        is_distinct = cost.double() <= matching.max_ratio**2 * second_cost.double()
        keep &= is_distinct & (second_cost > 0) & second_cost.isfinite()
    index0 = keep.nonzero()[:, 0]
    index1, cost = index1[index0], cost[index0]
    if matching.mutual:
        keep = best0[index1] == index0
    else:
        key = pack(cost, index0)
        cheapest = torch.full_like(cost1, NONE, dtype=torch.int64).scatter_reduce_(0, index1, key, "amin")
        keep = cheapest[index1] == key
    return index0[keep], index1[keep], cost[keep]
