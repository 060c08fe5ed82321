"""Putative matches: nearest neighbours by the sum of squared differences (SSD), with optional gates and tests."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import torch
from kornia.feature import match_nn
from torch import Tensor

from tensor_stereo.configs import Backend, MatchingConfig, PipelineConfig
from tensor_stereo.ops import gated_ssd
from tensor_stereo.ops._gated_ssd import open_gates
from tensor_stereo.ops.reference import NONE, pack, unpack
from tensor_stereo.ops.reference import ssd as ssd_of
from tensor_stereo.types import Features, Matches

_CHUNK_DENSE = 2**20  # entries of a dense SSD matrix that are formed at a time
_MAX_DESCRIPTOR = 2**50  # keeps the SSD finite


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
    batch. For windows of whole grey levels it is exact up to 2**24. The result with gates equals that of a dense cost
    matrix in which all else is masked, but no such matrix is formed: keypoints of view 1 are sorted into cells of one
    pixel, and the cells inside the gate of a keypoint are runs in that order. Without gates the candidates are found
    by a matrix product per pair: directly where its float32 result is exact (whole numbers, 2 D max**2 <= 2**24;
    ``kornia.feature.match_nn`` picks the neighbours), otherwise in float64, and all that could be nearest within
    rounding are compared by their cost. No gradient.

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
    peak = _check_features(features0, features1)
    best = _Best.empty(features0, features1, ratio=matching.max_ratio is not None, mutual=matching.mutual)
    if any(_is_gate(g) for g in (matching.max_row_offset_px, matching.min_disparity_px, matching.max_disparity_px)):
        best.take(*_gated_search(features0, features1, matching, config.backend))
    else:
        _search_dense(features0, features1, best, peak)
    index0, index1, cost = best.select(matching.max_ratio)
    return MatchIndices(index0, index1, cost, torch.searchsorted(index0, features0.ptr))


def _check_features(features0: Features, features1: Features) -> float:
    """Raise unless the features fit each other; the largest magnitude in their descriptors."""
    if features0.num_images != features1.num_images:
        counts = f"{features0.num_images} and {features1.num_images}"
        raise ValueError(f"features0 and features1 must hold the same number of images, got {counts}")
    if features0.descriptors.shape[1:] != features1.descriptors.shape[1:] or features0.descriptors.ndim != 2:
        shapes = f"{tuple(features0.descriptors.shape)} and {tuple(features1.descriptors.shape)}"
        raise ValueError(f"descriptors of features0 and features1 must be (N, D) with one D, got {shapes}")
    peaks = [float(f.descriptors.abs().max()) if f.descriptors.numel() else 0.0 for f in (features0, features1)]
    for name, peak in zip(("features0", "features1"), peaks, strict=True):
        if not peak <= _MAX_DESCRIPTOR:
            raise ValueError(f"descriptors of {name} must be finite and at most 2**50, got {peak:g}")
    return max(peaks)


def _gated_search(
    features0: Features, features1: Features, matching: MatchingConfig, backend: Backend
) -> tuple[Tensor, ...]:
    arguments = ((f.keypoints, f.descriptors, f.ptr) for f in (features0, features1))
    (keypoints0, descriptors0, ptr0), (keypoints1, descriptors1, ptr1) = arguments
    gates = open_gates(matching)
    found: tuple[Tensor, ...] = gated_ssd(
        keypoints0, keypoints1, descriptors0, descriptors1, ptr0, ptr1, *gates, backend
    )
    return found


def _is_gate(bound: float | None) -> bool:
    return bound is not None and math.isfinite(bound)


@dataclass
class _Best:
    """Running minima over candidates, as keys that order by cost and index."""

    nearest: Tensor  # (N0,) key (cost, index1) of the best candidate
    second: Tensor | None  # (N0,) key of the second best
    nearest1: Tensor | None  # (N1,) key (cost, index0) of the best candidate of view 1
    num_keypoints1: int

    @classmethod
    def empty(cls, features0: Features, features1: Features, *, ratio: bool, mutual: bool) -> _Best:
        nearest, nearest1 = (
            torch.full((len(f.keypoints),), NONE, device=f.keypoints.device) for f in (features0, features1)
        )
        return cls(nearest, nearest.clone() if ratio else None, nearest1 if mutual else None, len(nearest1))

    def update(self, index0: Tensor, index1: Tensor, cost: Tensor) -> None:
        """Take in candidates. All those of one keypoint of view 0 must come in the same call."""
        key = pack(cost, index1)
        self.nearest.scatter_reduce_(0, index0, key, "amin")
        if self.second is not None:
            others = torch.where(key == self.nearest[index0], NONE, key)
            self.second.scatter_reduce_(0, index0, others, "amin")
        if self.nearest1 is not None:
            self.nearest1.scatter_reduce_(0, index1, pack(cost, index0), "amin")

    def take(self, cost: Tensor, index1: Tensor, second_cost: Tensor, cost1: Tensor, index0: Tensor) -> None:
        """Take over what :func:`tensor_stereo.ops._gated_ssd` has found."""
        self.nearest = torch.where(index1 < 0, NONE, pack(cost, index1))
        if self.second is not None:
            self.second = torch.where(second_cost.isinf(), NONE, pack(second_cost, torch.zeros_like(index1)))
        if self.nearest1 is not None:
            self.nearest1 = torch.where(index0 < 0, NONE, pack(cost1, index0))

    def select(self, max_ratio: float | None) -> tuple[Tensor, Tensor, Tensor]:
        """index0, index1 and cost of the matches that pass the tests and stay one-to-one."""
        cost, index1 = unpack(self.nearest)
        keep = self.nearest != NONE
        if self.second is not None and max_ratio is not None:
            second, _ = unpack(self.second)
            # the key of no candidate unpacks to NaN, which fails both comparisons
            keep &= (second > 0) & (cost.double() <= max_ratio**2 * second.double())
        index0 = keep.nonzero()[:, 0]
        index1, cost = index1[index0], cost[index0]
        key1 = pack(cost, index0)
        if self.nearest1 is not None:
            keep = self.nearest1[index1] == key1
        else:
            cheapest = torch.full((self.num_keypoints1,), NONE, device=key1.device)
            cheapest.scatter_reduce_(0, index1, key1, "amin")
            keep = cheapest[index1] == key1
        return index0[keep], index1[keep], cost[keep]


def _search_dense(features0: Features, features1: Features, best: _Best, peak: float) -> None:
    """Candidates without gates: one matrix product per pair, in blocks of rows."""
    size = features0.descriptors.shape[1]
    whole = all(bool((f.descriptors == f.descriptors.round()).all()) for f in (features0, features1))
    exact = whole and peak <= 256 and 2 * size * peak**2 <= 2**24  # TF32 and bfloat16 hold whole numbers up to 256
    search = _search_exact if exact else _search_rounded
    bounds0, bounds1 = (pairwise(f.ptr.tolist()) for f in (features0, features1))
    for (start, stop), (first, last) in zip(bounds0, bounds1, strict=True):
        step = max(1, _CHUNK_DENSE // max(1, last - first))
        for row in range(start, stop if first < last else start, step):
            search(features0, features1, slice(row, min(row + step, stop)), slice(first, last), best)


def _expand(descriptors0: Tensor, descriptors1: Tensor) -> Tensor:
    """(N0, N1) |a|**2 + |b|**2 - 2 a.b in the dtype of the descriptors."""
    squares0, squares1 = (d.square().sum(1) for d in (descriptors0, descriptors1))
    return torch.addmm(squares1, descriptors0, descriptors1.T, alpha=-2).add_(squares0[:, None])


def _search_exact(features0: Features, features1: Features, rows: slice, columns: slice, best: _Best) -> None:
    """Whole numbers whose products and sums float32 holds exactly, in any order of summation."""
    descriptors0, descriptors1 = features0.descriptors[rows], features1.descriptors[columns]
    ssd = _expand(descriptors0, descriptors1)
    cost, index = match_nn(descriptors0, descriptors1, dm=ssd)
    best.nearest[rows] = pack(cost[:, 0], index[:, 1] + columns.start)
    if best.nearest1 is not None:
        cost, index = match_nn(descriptors1, descriptors0, dm=ssd.T)
        key1 = pack(cost[:, 0], index[:, 1] + rows.start)
        best.nearest1[columns] = torch.minimum(best.nearest1[columns], key1)
    if best.second is not None and ssd.shape[1] > 1:
        index = best.nearest[rows, None] & (2**32 - 1)
        cost = ssd.scatter_(1, index - columns.start, math.inf).amin(1)
        best.second[rows] = pack(cost, torch.zeros_like(index[:, 0]))


def _search_rounded(features0: Features, features1: Features, rows: slice, columns: slice, best: _Best) -> None:
    """Any descriptors: float64 finds all that may be nearest, and the costs of those decide.

    A cost is off by at most (D + 2) float32 roundings of itself, and D times the smallest normal number if squares
    underflow; the product by at most 2 (D + 4) float64 roundings of (|a| + |b|)**2 (Higham, Accuracy and Stability of
    Numerical Algorithms, section 3.1).
    """
    descriptors0, descriptors1 = features0.descriptors[rows].double(), features1.descriptors[columns].double()
    ssd = _expand(descriptors0, descriptors1)
    size = descriptors0.shape[1]
    relative = 1 + 4 * (size + 2) * torch.finfo(torch.float32).eps
    norm = sum(float(d.norm(dim=1).max()) for d in (descriptors0, descriptors1))
    absolute = 8 * (size + 4) * torch.finfo(torch.float64).eps * norm**2 + 2 * size * torch.finfo(torch.float32).tiny
    bound, index = ssd.min(1, keepdim=True)
    if best.second is not None:
        bound = ssd.scatter(1, index, math.inf).amin(1, keepdim=True)
    candidates = ssd <= bound * relative + absolute
    if best.nearest1 is not None:
        candidates |= ssd <= ssd.amin(0) * relative + absolute
    index0, index1 = candidates.nonzero().unbind(1)
    index0, index1 = index0 + rows.start, index1 + columns.start
    best.update(index0, index1, ssd_of(features0.descriptors, features1.descriptors, index0, index1))
