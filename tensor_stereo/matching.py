"""Putative matches: nearest neighbours by the sum of squared differences (SSD), with optional gates and tests."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import torch
from kornia.feature import match_nn
from torch import Tensor

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.configs import MatchingConfig
from tensor_stereo.types import Features, Matches

_NONE = torch.iinfo(torch.int64).max  # key of "no candidate", larger than that of any candidate
_INDEX_BITS = 32
_CHUNK_VALUES = 2**17  # descriptor values that are compared at a time: 512 kB, which stay in the cache
_CHUNK_CANDIDATES = 2**18  # candidate pairs that are listed at a time
_CHUNK_DENSE = 2**20  # entries of a dense SSD matrix that are formed at a time
_MAX_COORDINATE_PX = 2**24
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


def match_features(features0: Features, features1: Features, config: MatchingConfig | None = None) -> Matches:
    """Match image b of ``features0`` with image b of ``features1``, for all b.

    See :func:`match_indices`, which returns the same matches as indices. Gradients flow from the matched keypoints to
    those of the features; none flow from ``cost``.

    Args:
        features0: keypoints and descriptors of B images, view 0 (left).
        features1: those of the B partners, view 1 (right).
        config: gates and tests; None means the defaults: the nearest neighbour, one-to-one.

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
def match_indices(features0: Features, features1: Features, config: MatchingConfig | None = None) -> MatchIndices:
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
        config: gates and tests; None means the defaults: the nearest neighbour, one-to-one.

    Returns:
        Rows of both features and the cost of each match. Images without keypoints have no match.

    Raises:
        ValueError: if the features differ in the number of images or in descriptor length, hold values that are not
            finite (descriptors; with gates, keypoints beyond 2**24 px), or a setting does not fit.

    >>> ptr = torch.tensor([0, 2])
    >>> features = Features(torch.zeros(2, 2), ptr, torch.tensor([[3.0], [5.0]]), torch.ones(2))
    >>> match_indices(features, features).index1
    tensor([0, 1])
    """
    config = config or MatchingConfig()
    check_config(config)
    features0, features1 = (replace(f, descriptors=f.descriptors.float()) for f in (features0, features1))
    peak = _check_features(features0, features1)
    best = _Best.empty(features0, features1, ratio=config.max_ratio is not None, mutual=config.mutual)
    if any(_is_gate(g) for g in (config.max_row_offset_px, config.min_disparity_px, config.max_disparity_px)):
        for index0, index1 in gated_candidates(features0, features1, config):
            best.update(index0, index1, _ssd(features0, features1, index0, index1))
    else:
        _search_dense(features0, features1, best, peak)
    index0, index1, cost = best.select(config.max_ratio)
    return MatchIndices(index0, index1, cost, torch.searchsorted(index0, features0.ptr))


def check_config(config: MatchingConfig) -> None:
    """Raise unless the settings fit.

    >>> check_config(MatchingConfig(max_ratio=0.8))
    """
    ratio, rows = config.max_ratio, config.max_row_offset_px
    low, high = config.min_disparity_px, config.max_disparity_px
    if ratio is not None and not 0 < ratio <= 1:
        raise ValueError(f"MatchingConfig.max_ratio must lie in (0, 1] or be None, got {ratio}")
    if rows is not None and not rows >= 0:
        raise ValueError(f"MatchingConfig.max_row_offset_px must be at least 0 or None, got {rows}")
    if low is not None and not low < math.inf:
        raise ValueError(f"MatchingConfig.min_disparity_px must be a number below infinity or None, got {low}")
    if high is not None and not high > -math.inf:
        raise ValueError(f"MatchingConfig.max_disparity_px must be a number above -infinity or None, got {high}")
    if low is not None and high is not None and low > high:
        raise ValueError(f"MatchingConfig.min_disparity_px must be at most max_disparity_px, got {low} > {high}")


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


def _is_gate(bound: float | None) -> bool:
    return bound is not None and math.isfinite(bound)


@dataclass
class _Best:
    """Running minima over candidates. A key holds the bits of a cost above an index, so that it orders by both.

    The bits of non-negative floats order as the floats do.
    """

    nearest: Tensor  # (N0,) key (cost, index1) of the best candidate
    second: Tensor | None  # (N0,) key of the second best
    nearest1: Tensor | None  # (N1,) key (cost, index0) of the best candidate of view 1
    num_keypoints1: int

    @classmethod
    def empty(cls, features0: Features, features1: Features, *, ratio: bool, mutual: bool) -> _Best:
        nearest, nearest1 = (
            torch.full((len(f.keypoints),), _NONE, device=f.keypoints.device) for f in (features0, features1)
        )
        return cls(nearest, nearest.clone() if ratio else None, nearest1 if mutual else None, len(nearest1))

    def update(self, index0: Tensor, index1: Tensor, cost: Tensor) -> None:
        """Take in candidates. All those of one keypoint of view 0 must come in the same call."""
        key = _pack(cost, index1)
        self.nearest.scatter_reduce_(0, index0, key, "amin")
        if self.second is not None:
            others = torch.where(key == self.nearest[index0], _NONE, key)
            self.second.scatter_reduce_(0, index0, others, "amin")
        if self.nearest1 is not None:
            self.nearest1.scatter_reduce_(0, index1, _pack(cost, index0), "amin")

    def select(self, max_ratio: float | None) -> tuple[Tensor, Tensor, Tensor]:
        """index0, index1 and cost of the matches that pass the tests and stay one-to-one."""
        cost, index1 = _unpack(self.nearest)
        keep = self.nearest != _NONE
        if self.second is not None and max_ratio is not None:
            second, _ = _unpack(self.second)
            # the key of no candidate unpacks to NaN, which fails both comparisons
            keep &= (second > 0) & (cost.double() <= max_ratio**2 * second.double())
        index0 = keep.nonzero()[:, 0]
        index1, cost = index1[index0], cost[index0]
        key1 = _pack(cost, index0)
        if self.nearest1 is not None:
            keep = self.nearest1[index1] == key1
        else:
            cheapest = torch.full((self.num_keypoints1,), _NONE, device=key1.device)
            cheapest.scatter_reduce_(0, index1, key1, "amin")
            keep = cheapest[index1] == key1
        return index0[keep], index1[keep], cost[keep]


def _pack(cost: Tensor, index: Tensor) -> Tensor:
    return cost.view(torch.int32).to(torch.int64) << _INDEX_BITS | index


def _unpack(key: Tensor) -> tuple[Tensor, Tensor]:
    return (key >> _INDEX_BITS).to(torch.int32).view(torch.float32), key & (2**_INDEX_BITS - 1)


def _ssd(features0: Features, features1: Features, index0: Tensor, index1: Tensor) -> Tensor:
    """(K,) float32 costs of candidates. Each row is summed on its own, whatever its neighbours."""
    descriptors0, descriptors1 = features0.descriptors, features1.descriptors
    cost = descriptors0.new_empty(len(index0))
    step = max(1, _CHUNK_VALUES // max(1, descriptors0.shape[1]))
    for start in range(0, len(index0), step):
        rows = slice(start, start + step)
        difference = descriptors0.index_select(0, index0[rows]).sub_(descriptors1.index_select(0, index1[rows]))
        torch.sum(difference.square_(), 1, out=cost[rows])
    return cost


def gated_candidates(
    features0: Features, features1: Features, config: MatchingConfig
) -> Iterator[tuple[Tensor, Tensor]]:
    """List the pairs of keypoints inside the gates, in blocks of bounded size.

    Cells are one pixel wide and max(1, ``max_row_offset_px``) high. Sorted by (pair, cell row, cell column), the
    cells of one row that a gate touches are one run, found by binary search; a gate touches at most four rows.

    Args:
        features0: view 0 of B pairs.
        features1: view 1.
        config: gates; infinity and None leave a side open.

    Yields:
        (K,) int64 rows of ``features0`` and of ``features1``, by increasing row of ``features0``. All candidates of one
        keypoint come in the same block.

    Raises:
        ValueError: if a keypoint is not finite or beyond 2**24 px.

    >>> points = torch.tensor([[9.0, 4.0], [5.0, 6.0]])
    >>> features = Features(points, torch.tensor([0, 2]), torch.zeros(2, 1), torch.zeros(2))
    >>> list(gated_candidates(features, features, MatchingConfig(max_row_offset_px=1)))
    [(tensor([0, 1]), tensor([0, 1]))]
    """
    x0, y0 = _coordinates("features0", features0)
    x1, y1 = _coordinates("features1", features1)
    if len(x0) == 0 or len(x1) == 0:
        return
    offset = config.max_row_offset_px
    if offset is None or math.isinf(offset):
        y0, y1, offset = torch.zeros_like(y0), torch.zeros_like(y1), 0.0  # all in one row
    low = -math.inf if config.min_disparity_px is None else config.min_disparity_px
    high = math.inf if config.max_disparity_px is None else config.max_disparity_px
    top, bottom, left, right = y0 - offset, y0 + offset, x0 - high, x0 - low

    height = max(1.0, offset)
    row1, first_row0, last_row0 = ((y / height).floor() for y in (y1, top, bottom))
    column1 = x1.floor()
    first_row, first_column = row1.min(), column1.min()
    num_rows, num_columns = (int(v.max() - v.min()) + 1 for v in (row1, column1))

    def cell(batch: Tensor, row: Tensor, column: Tensor) -> Tensor:
        return (batch * num_rows + row) * num_columns + column

    key1 = cell(ptr_to_batch(features1.ptr), (row1 - first_row).long(), (column1 - first_column).long())
    key1, order1 = key1.sort(stable=True)

    reach = int(2 * offset / height) + 2  # rows of cells that a gate can touch, at most
    rows = first_row0[:, None] + torch.arange(reach, device=top.device)  # (N0, reach)
    touched = (rows <= last_row0[:, None]) & (rows >= first_row) & (rows < first_row + num_rows)
    rows = rows - first_row
    batch0, rows = ptr_to_batch(features0.ptr)[:, None], rows.clamp(0, num_rows - 1).long()
    begin, end = (
        torch.searchsorted(key1, cell(batch0, rows, bound.clamp(0, num_columns).long()[:, None]))
        for bound in (left.floor() - first_column, right.floor() + 1 - first_column)
    )
    count = torch.where(touched, end - begin, 0)  # (N0, reach)

    for start, stop in _blocks(count.sum(1)):
        length = count[start:stop].flatten()
        run = torch.repeat_interleave(length)
        position = torch.arange(len(run), device=run.device) - (length.cumsum(0) - length)[run]
        index1 = order1[begin[start:stop].flatten()[run] + position]
        index0 = start + run // reach
        y, x = y1[index1], x1[index1]
        inside = (y >= top[index0]) & (y <= bottom[index0]) & (x >= left[index0]) & (x <= right[index0])
        yield index0[inside], index1[inside]


def _coordinates(name: str, features: Features) -> tuple[Tensor, Tensor]:
    """Columns and rows of the keypoints in float64, where their differences are exact."""
    keypoints = features.keypoints.detach().double()
    if not bool((keypoints.abs() <= _MAX_COORDINATE_PX).all()):
        raise ValueError(f"keypoints of {name} must be finite and at most {_MAX_COORDINATE_PX} px with gates")
    x, y = keypoints.unbind(1)
    return x, y


def _blocks(counts: Tensor) -> Iterator[tuple[int, int]]:
    """Ranges of rows that own up to ``_CHUNK_CANDIDATES`` candidates, and those of one row more."""
    block = (counts.cumsum(0) - counts) // _CHUNK_CANDIDATES
    sizes = torch.unique_consecutive(block, return_counts=True)[1]
    stop = 0
    for size in sizes.tolist():
        start, stop = stop, stop + size
        yield start, stop


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
    best.nearest[rows] = _pack(cost[:, 0], index[:, 1] + columns.start)
    if best.nearest1 is not None:
        cost, index = match_nn(descriptors1, descriptors0, dm=ssd.T)
        key1 = _pack(cost[:, 0], index[:, 1] + rows.start)
        best.nearest1[columns] = torch.minimum(best.nearest1[columns], key1)
    if best.second is not None and ssd.shape[1] > 1:
        index = best.nearest[rows, None] & (2**_INDEX_BITS - 1)
        cost = ssd.scatter_(1, index - columns.start, math.inf).amin(1)
        best.second[rows] = _pack(cost, torch.zeros_like(index[:, 0]))


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
    best.update(index0, index1, _ssd(features0, features1, index0, index1))
