"""Nearest neighbours by sum of squared differences in plain torch: the definition of what the kernel computes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import torch
from kornia.feature import match_nn
from torch import Tensor

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.configs import MatchingConfig
from tensor_stereo.types import Features

NONE = torch.iinfo(torch.int64).max  # key of "no candidate", larger than that of any candidate
_INDEX_BITS = 32
_LANES = 16
_CHUNK_DENSE = 2**20  # entries of a dense SSD matrix that are formed at a time
_CHUNK_VALUES = 2**17  # descriptor values that are compared at a time: 512 kB, which stay in the cache
_CHUNK_CANDIDATES = 2**18  # candidates that are listed at a time
_MAX_COORDINATE_PX = 2**24
_MAX_DESCRIPTOR = 2**50  # keeps the SSD finite


def nearest_ssd(features0: Features, features1: Features, config: MatchingConfig) -> tuple[Tensor, ...]:
    """Nearest neighbours inside the gates; see :func:`tensor_stereo.ops.nearest_ssd` for the five results.

    With gates, keypoints of view 1 are sorted into cells of one pixel, and the cells inside the gate of a keypoint are
    runs in that order. Without gates a matrix product per pair finds the candidates: directly where its float32 result
    is exact (whole numbers, 2 D max**2 and D (max - min)**2 <= 2**24; ``kornia.feature.match_nn`` picks the
    neighbours), otherwise in float64, and all that could be nearest within rounding are compared by their cost.

    Example:
        >>> ptr = torch.tensor([0, 2])
        >>> features = Features(torch.zeros(2, 2), ptr, torch.tensor([[3.0], [5.0]]), torch.ones(2))
        >>> nearest_ssd(features, features, MatchingConfig(max_row_offset_px=1))[1]
        tensor([0, 1])
    """
    best = Best.empty(features0, features1)
    if is_open(*open_gates(config)):
        _search_dense(features0, features1, best)
    else:
        for index0, index1 in gated_candidates(features0, features1, config):
            best.update(index0, index1, ssd(features0.descriptors, features1.descriptors, index0, index1))
    (cost, index), (second_cost, _), (cost1, index1) = (
        _unpack_or_none(k) for k in (best.nearest, best.second, best.nearest1)
    )
    return cost, index, second_cost, cost1, index1


def open_gates(config: MatchingConfig) -> tuple[float, float, float]:
    """Row offset and disparity range in px, with infinities for what is not gated.

    Example:
        >>> open_gates(MatchingConfig(max_disparity_px=64))
        (inf, -inf, 64)
    """
    return (
        math.inf if config.max_row_offset_px is None else config.max_row_offset_px,
        -math.inf if config.min_disparity_px is None else config.min_disparity_px,
        math.inf if config.max_disparity_px is None else config.max_disparity_px,
    )


def is_open(max_row_offset_px: float, min_disparity_px: float, max_disparity_px: float) -> bool:
    """Whether these gates let everything through.

    Example:
        >>> is_open(math.inf, -math.inf, math.inf), is_open(math.inf, math.inf, math.inf)
        (True, False)
    """
    return (max_row_offset_px, min_disparity_px, max_disparity_px) == (math.inf, -math.inf, math.inf)


def check_descriptors(name: str, descriptors: Tensor) -> None:
    """Raise unless all descriptors are finite and so small that their SSD is."""
    extremes = descriptors.aminmax() if descriptors.numel() else (0.0, 0.0)
    peak = max(abs(float(value)) for value in extremes)  # that of NaN is NaN
    if not peak <= _MAX_DESCRIPTOR:
        raise ValueError(f"descriptors of {name} must be finite and at most 2**50, got {peak:g}")


@dataclass
class Best:
    """Running minima over candidates, as keys that order by cost and index."""

    nearest: Tensor  # (N0,) key (cost, index1) of the best candidate
    second: Tensor  # (N0,) key of the second best
    nearest1: Tensor  # (N1,) key (cost, index0) of the best candidate of view 1

    @classmethod
    def empty(cls, features0: Features, features1: Features) -> Best:
        nearest, nearest1 = (
            torch.full((len(f.keypoints),), NONE, device=f.keypoints.device) for f in (features0, features1)
        )
        return cls(nearest, nearest.clone(), nearest1)

    def update(self, index0: Tensor, index1: Tensor, cost: Tensor) -> None:
        """Take in candidates. All those of one keypoint of view 0 must come in the same call."""
        key = pack(cost, index1)
        self.nearest.scatter_reduce_(0, index0, key, "amin")
        others = torch.where(key == self.nearest[index0], NONE, key)
        self.second.scatter_reduce_(0, index0, others, "amin")
        self.nearest1.scatter_reduce_(0, index1, pack(cost, index0), "amin")


def _unpack_or_none(key: Tensor) -> tuple[Tensor, Tensor]:
    cost, index = unpack(key)
    missing = key == NONE
    return cost.masked_fill(missing, math.inf), index.masked_fill(missing, -1)


def pack(cost: Tensor, index: Tensor) -> Tensor:
    """Keys that order by (cost, index): the bits of non-negative floats order as the floats do.

    Example:
        >>> unpack(pack(torch.tensor([0.5]), torch.tensor([7])))
        (tensor([0.5000]), tensor([7]))
    """
    return cost.view(torch.int32).to(torch.int64) << _INDEX_BITS | index


def unpack(key: Tensor) -> tuple[Tensor, Tensor]:
    """Costs float32 and indices int64 of keys; the inverse of :func:`pack`."""
    return (key >> _INDEX_BITS).to(torch.int32).view(torch.float32), key & (2**_INDEX_BITS - 1)


def ssd(descriptors0: Tensor, descriptors1: Tensor, index0: Tensor, index1: Tensor) -> Tensor:
    """Sums of squared differences of chosen rows, in an order of summation that any machine can repeat.

    Sixteen interleaved lanes are each summed in order and then added in halves, in float32; exact for whole numbers
    up to 2**24.

    Args:
        descriptors0: (N0, D).
        descriptors1: (N1, D).
        index0: (K,) int64 rows.
        index1: (K,) int64 rows.

    Returns:
        (K,) float32. Each row is summed on its own, whatever its neighbours.

    Example:
        >>> ssd(torch.tensor([[1.0, 2.0]]), torch.tensor([[4.0, 6.0]]), torch.tensor([0]), torch.tensor([0]))
        tensor([25.])
    """
    size = descriptors0.shape[1]
    padding = (0, -size % _LANES)
    descriptors0, descriptors1 = descriptors0.float(), descriptors1.float()
    cost = descriptors0.new_zeros(len(index0))
    step = max(1, _CHUNK_VALUES // max(1, size))
    for start in range(0, len(index0) if size else 0, step):
        rows = slice(start, start + step)
        difference = descriptors0.index_select(0, index0[rows]).sub_(descriptors1.index_select(0, index1[rows]))
        blocks = torch.nn.functional.pad(difference.square_(), padding).view(len(difference), -1, _LANES).unbind(1)
        lanes = blocks[0].clone()  # (K, 16)
        for block in blocks[1:]:
            lanes += block
        while lanes.shape[1] > 1:
            lanes = lanes[:, : lanes.shape[1] // 2] + lanes[:, lanes.shape[1] // 2 :]
        cost[rows] = lanes[:, 0]
    return cost


def gated_candidates(
    features0: Features, features1: Features, config: MatchingConfig
) -> Iterator[tuple[Tensor, Tensor]]:
    """List the candidates, two keypoints inside the gates, in blocks of bounded size.

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
    check_coordinates(name, features.keypoints)
    x, y = features.keypoints.detach().double().unbind(1)
    return x, y


def check_coordinates(name: str, keypoints: Tensor) -> None:
    """Raise unless all keypoints are finite and so small that their pixels can be counted."""
    if not bool((keypoints.abs() <= _MAX_COORDINATE_PX).all()):
        raise ValueError(f"keypoints of {name} must be finite and at most {_MAX_COORDINATE_PX} px with gates")


def _blocks(counts: Tensor) -> Iterator[tuple[int, int]]:
    """Ranges of rows that own up to ``_CHUNK_CANDIDATES`` candidates, and those of one row more."""
    block = (counts.cumsum(0) - counts) // _CHUNK_CANDIDATES
    sizes = torch.unique_consecutive(block, return_counts=True)[1]
    stop = 0
    for size in sizes.tolist():
        start, stop = stop, stop + size
        yield start, stop


def _search_dense(features0: Features, features1: Features, best: Best) -> None:
    """Candidates without gates: one matrix product per pair, in blocks of rows."""
    size = features0.descriptors.shape[1]
    values = torch.cat([f.descriptors.flatten() for f in (features0, features1)])
    low, high = (float(value) for value in values.aminmax()) if values.numel() else (0.0, 0.0)
    whole = bool((values == values.round()).all())
    peak = max(-low, high)
    largest = size * max(2 * peak**2, (high - low) ** 2)  # of all products and sums
    exact = whole and peak <= 256 and largest <= 2**24  # TF32 and bfloat16 hold whole numbers up to 256
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


def _search_exact(features0: Features, features1: Features, rows: slice, columns: slice, best: Best) -> None:
    """Whole numbers whose products and sums float32 holds exactly, in any order of summation."""
    descriptors0, descriptors1 = features0.descriptors[rows], features1.descriptors[columns]
    product = _expand(descriptors0, descriptors1)
    cost, index = match_nn(descriptors0, descriptors1, dm=product)
    best.nearest[rows] = pack(cost[:, 0], index[:, 1] + columns.start)
    cost, index = match_nn(descriptors1, descriptors0, dm=product.T)
    key1 = pack(cost[:, 0], index[:, 1] + rows.start)
    best.nearest1[columns] = torch.minimum(best.nearest1[columns], key1)
    if product.shape[1] > 1:
        index = best.nearest[rows, None] & (2**32 - 1)
        cost = product.scatter_(1, index - columns.start, math.inf).amin(1)
        best.second[rows] = pack(cost, torch.zeros_like(index[:, 0]))


def _search_rounded(features0: Features, features1: Features, rows: slice, columns: slice, best: Best) -> None:
    """Any descriptors: float64 finds all that may be nearest, and the costs of those decide.

    A cost is off by at most (D + 2) float32 roundings of itself, and D times the smallest normal number if squares
    underflow; the product by at most 2 (D + 4) float64 roundings of (|a| + |b|)**2 (Higham, Accuracy and Stability of
    Numerical Algorithms, section 3.1).
    """
    descriptors0, descriptors1 = features0.descriptors[rows].double(), features1.descriptors[columns].double()
    product = _expand(descriptors0, descriptors1)
    size = descriptors0.shape[1]
    relative = 1 + 4 * (size + 2) * torch.finfo(torch.float32).eps
    norm = sum(float(d.norm(dim=1).max()) for d in (descriptors0, descriptors1))
    absolute = 8 * (size + 4) * torch.finfo(torch.float64).eps * norm**2 + 2 * size * torch.finfo(torch.float32).tiny
    index = product.argmin(1, keepdim=True)
    bound = product.scatter(1, index, math.inf).amin(1, keepdim=True)
    candidates = (product <= bound * relative + absolute) | (product <= product.amin(0) * relative + absolute)
    index0, index1 = candidates.nonzero().unbind(1)
    index0, index1 = index0 + rows.start, index1 + columns.start
    best.update(index0, index1, ssd(features0.descriptors, features1.descriptors, index0, index1))
