"""The operators in plain torch: the definition of what the compiled kernels compute."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.configs import MatchingConfig
from tensor_stereo.types import Features, Relation

NONE = torch.iinfo(torch.int64).max  # key of "no candidate", larger than that of any candidate
_INDEX_BITS = 32
_LANES = 16
_CHUNK_VALUES = 2**17  # descriptor values that are compared at a time: 512 kB, which stay in the cache
_CHUNK_CANDIDATES = 2**18  # candidates that are listed at a time
_MAX_COORDINATE_PX = 2**24


def row_overlap(crow0: Tensor, cols0: Tensor, crow1: Tensor, cols1: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Row sums of A0 AND A1, and of A0 and A1; see :func:`tensor_stereo.ops.row_overlap`.

    torch has no arithmetic on sparse boolean tensors; the AND is a merge of the sorted keys row * M + column.

    Example:
        >>> crow = torch.tensor([0, 2, 3])
        >>> row_overlap(crow, torch.tensor([0, 1, 1]), crow, torch.tensor([1, 2, 0]))[0]
        tensor([1, 0])
    """
    degree0, degree1 = crow0.diff(), crow1.diff()
    if not len(cols0) or not len(cols1):
        return torch.zeros_like(degree0), degree0, degree1
    stride = int(torch.maximum(cols0.max(), cols1.max())) + 1
    keys0, keys1 = (
        torch.repeat_interleave(degree) * stride + cols for degree, cols in ((degree0, cols0), (degree1, cols1))
    )
    position = torch.searchsorted(keys1, keys0).clamp_(max=len(keys1) - 1)
    shared = torch.nn.functional.pad((keys1[position] == keys0).cumsum(0), (1, 0))  # (nnz0 + 1,)
    return shared[crow0].diff(), degree0, degree1


def agreeing_neighbors(
    keypoints0: Tensor,
    keypoints1: Tensor,
    crow0: Tensor,
    cols0: Tensor,
    crow1: Tensor,
    cols1: Tensor,
    row_px: float,
    disparity_px: float,
    slope: float,
    spread: float,
) -> Tensor:
    """How many neighbours move as a match does; see :func:`tensor_stereo.ops.agreeing_neighbors`."""
    places, partners = keypoints0.double(), keypoints1.double()
    seen = torch.cat([places, places[:, :1] - partners[:, :1], partners[:, 1:] - places[:, 1:]], 1)
    count = torch.zeros_like(crow0[1:])
    for crow, j in ((crow0, cols0), (crow1, cols1)):
        i = torch.repeat_interleave(crow.diff())
        x, y, disparity, row = (seen.index_select(0, i) - seen.index_select(0, j)).abs_().unbind(1)
        more = spread * (x + y)
        agrees = (row <= row_px + more) & (disparity <= disparity_px + slope * x + more)
        count.index_add_(0, i, agrees.to(count.dtype))
    return count


def relate(
    overlap: Tensor, degree0: Tensor, degree1: Tensor, group_size: Tensor, min_group_size: int, accept_subsets: bool
) -> tuple[Tensor, Tensor]:
    """Relation and verdict from the sizes of neighbour sets; see :func:`tensor_stereo.ops.relate`."""
    within0, within1 = overlap == degree0, overlap == degree1
    relation = torch.full_like(overlap, Relation.CONFLICT, dtype=torch.int8)
    relation[within0] = int(Relation.SUBSET)
    relation[within1] = int(Relation.SUPERSET)
    relation[within0 & within1] = int(Relation.EQUAL)
    # An empty neighbour set is a subset of anything: evidence only where there is nobody else.
    has_evidence = ((degree0 > 0) & (degree1 > 0)) | (group_size == 1)
    relation[(group_size < min_group_size) | (group_size == 0) | ~has_evidence] = int(Relation.UNTESTED)
    last = Relation.SUPERSET if accept_subsets else Relation.EQUAL
    return relation, (relation >= int(Relation.EQUAL)) & (relation <= int(last))


def gated_ssd(features0: Features, features1: Features, config: MatchingConfig) -> tuple[Tensor, ...]:
    """Nearest neighbours inside the gates; see :func:`tensor_stereo.ops.gated_ssd` for the five results.

    Example:
        >>> ptr = torch.tensor([0, 2])
        >>> features = Features(torch.zeros(2, 2), ptr, torch.tensor([[3.0], [5.0]]), torch.ones(2))
        >>> gated_ssd(features, features, MatchingConfig(max_row_offset_px=1))[1]
        tensor([0, 1])
    """
    num0, num1, device = len(features0.keypoints), len(features1.keypoints), features0.keypoints.device
    nearest, second = torch.full((2, num0), NONE, device=device)
    nearest1 = torch.full((num1,), NONE, device=device)
    for index0, index1 in gated_candidates(features0, features1, config):
        cost = ssd(features0.descriptors, features1.descriptors, index0, index1)
        key = pack(cost, index1)
        nearest.scatter_reduce_(0, index0, key, "amin")
        second.scatter_reduce_(0, index0, torch.where(key == nearest[index0], NONE, key), "amin")
        nearest1.scatter_reduce_(0, index1, pack(cost, index0), "amin")
    (cost, index), (second_cost, _), (cost1, index1) = (_unpack_or_none(k) for k in (nearest, second, nearest1))
    return cost, index, second_cost, cost1, index1


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
