"""What the learned score sees of every match and of every link, over both graphs of a batch.

A link joins two matches that are neighbours in at least one view.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.configs import FilterConfig
from tensor_stereo.graphs import MatchGraphs, check_match_graphs
from tensor_stereo.relations import shared_neighbors
from tensor_stereo.scores.alignment.form import Alignment, align_matches
from tensor_stereo.scores.image_evidence import NUM_CURVES, NUM_VALUES, ImageEvidence
from tensor_stereo.types import Adjacency, Matches

NUM_NODE, NUM_COST, NUM_EDGE, NUM_ODD, NUM_REFINED = 8, 2, 15, 2, 4
NUM_EDGE_IMAGE = 2 * NUM_CURVES + 1 + NUM_REFINED
_TINY_PX2 = 1e-6  # added to squared lengths, so that their roots have a gradient at coincident points


class Receivers(NamedTuple):
    """The U links in the order of their ends."""

    i: Tensor  # (U,) int64 rows of one end
    j: Tensor  # (U,) int64 rows of the other
    order_i: Tensor  # (U,) int64 links, sorted by i
    offsets_i: Tensor  # (M + 1,) int64 into ``order_i``
    order_j: Tensor  # (U,) int64 links, sorted by j
    offsets_j: Tensor  # (M + 1,) int64 into ``order_j``

    def sum(self, to_i: Tensor, to_j: Tensor) -> Tensor:
        """(M, K) sums of the (U, K) messages to either end; gradients flow."""
        if torch.compiler.is_compiling():  # embedding_bag asks for sizes that are not known yet
            sums = to_i.new_zeros(len(self.offsets_i) - 1, to_i.shape[1])
            return sums.index_add(0, self.i, to_i).index_add(0, self.j, to_j)
        # a gather in the order of the receivers; adding to scattered rows takes ten times as long
        sums = functional.embedding_bag(self.order_i, to_i, self.offsets_i, mode="sum", include_last_offset=True)
        other = functional.embedding_bag(self.order_j, to_j, self.offsets_j, mode="sum", include_last_offset=True)
        return sums + other


class Quantities(NamedTuple):
    """What the network sees of M matches of B pairs, and of the U links between them; all float32."""

    nodes: Tensor  # (M, NUM_NODE) from the graphs and from the offset between rows
    cost: Tensor  # (M, NUM_COST); zero without cost
    image: Tensor  # (M, NUM_VALUES); zero without images
    has_cost: Tensor  # (M, 1) 0 or 1
    has_image: Tensor  # (M, 1) 0 or 1
    disparity: Tensor  # (M,) px, less the mean of the pair
    refined: Tensor  # (M,) px, the disparity that the images favour nearby; the same without images
    batch: Tensor  # (M,) int64 pair of each match
    share: Tensor  # (M, 1) one over the number of matches of the pair
    degree: Tensor  # (M, 1) neighbours in either view, at least 1
    i: Tensor  # (U,) int64 rows
    j: Tensor  # (U,) int64 rows, greater than i
    edges: Tensor  # (U, NUM_EDGE), the same for both ends
    odd: Tensor  # (U, NUM_ODD), from i to j; the other way they change their sign
    image_i: Tensor  # (U, NUM_EDGE_IMAGE) the disparity of j in the windows of i
    image_j: Tensor  # (U, NUM_EDGE_IMAGE) the disparity of i in the windows of j
    step: Tensor  # (U, 2) from i to j in view 0, over the mean distance of both to their neighbours
    receivers: Receivers
    num_pairs: int
    shown: bool  # whether there is image evidence


def measure_quantities(
    matches: Matches,
    graphs: MatchGraphs,
    evidence: ImageEvidence | None = None,
    config: FilterConfig | None = None,
    alignment: Alignment | None = None,
) -> Quantities:
    """Collect what the network sees.

    Nothing depends on the order of the matches, on the other pairs, on a common shift of both views, or on a shift of
    one of them along the rows; and next to nothing on what the alignment takes out. In pairs that are not rectified the
    epipolar lines stand for the rows, and the way along them for the disparity.

    Args:
        matches: B pairs; without ``cost`` its columns are zero.
        graphs: graphs of the same matches.
        evidence: evidence of the images; None: its columns are zero.
        config: ``backend`` is read; None means the defaults.
        alignment: What the matches of every pair share; None: rectified pairs with the same rows in both views.

    Returns:
        The quantities. Gradients flow from all that is continuous in the keypoints, and are finite; none through
        ``cost`` and ``evidence``.

    Raises:
        ValueError: for graphs or evidence of another number of matches.

    Example:
        >>> from tensor_stereo.graphs import build_match_graphs
        >>> points = torch.tensor([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]])
        >>> matches = Matches(points, points, torch.tensor([0, 3]))
        >>> measure_quantities(matches, build_match_graphs(matches)).edges.shape
        torch.Size([3, 15])
    """
    check_fit(matches, graphs, evidence)
    batch = ptr_to_batch(matches.ptr)
    share = (1 / matches.ptr.diff().double()).index_select(0, batch)[:, None]
    has_rows = None
    if alignment is not None:
        has_rows = alignment.has_rows.index_select(0, batch)[:, None].float()
        matches = align_matches(matches, alignment)
    points = [_center(view, matches.num_pairs, batch, share) for view in (matches.keypoints0, matches.keypoints1)]
    disparity = matches.keypoints0[:, :1].double() - matches.keypoints1[:, :1].double()
    row_offset = (matches.keypoints0[:, 1].double() - matches.keypoints1[:, 1].double()).abs().float()
    nodes, degree = _node_quantities(row_offset, has_rows, graphs, config or FilterConfig())
    if matches.cost is None:
        cost, has_cost = nodes.new_zeros(len(nodes), NUM_COST), nodes.new_zeros(len(nodes), 1)
    else:
        cost, has_cost = _relative_cost(matches.cost.detach().double(), matches.ptr, batch)
    i, j, in0, in1 = _union(graphs.adjacency0, graphs.adjacency1)
    receivers = find_receivers(i, j, len(nodes))
    edges, odd, step, length = _edge_quantities(torch.cat(points, 1), i, j, in0, in1)
    mean_length = (receivers.sum(length[:, None], length[:, None])[:, 0] / degree).clamp(min=1e-3)
    step = 2 * step / (mean_length.index_select(0, i) + mean_length.index_select(0, j))
    refined = centered = _center(disparity, matches.num_pairs, batch, share)[:, 0]
    if evidence is None:
        image, has_image = nodes.new_zeros(len(nodes), NUM_VALUES), nodes.new_zeros(len(nodes), 1)
        image_i = image_j = edges.new_zeros(len(i), NUM_EDGE_IMAGE)
    else:
        image, has_image = evidence.values, (evidence.num_columns > 0)[:, None].float()
        refined = centered + evidence.offset
        gap = _refined_gap(refined, i, j, length)
        image_i, image_j = (
            torch.cat([_look_up(evidence, disparity.detach()[:, 0], *ends), gap], 1) for ends in ((i, j), (j, i))
        )
    return Quantities(
        nodes, cost, image, has_cost, has_image, centered, refined, batch, share.float(), degree[:, None],
        i, j, edges, odd, image_i, image_j, step.t(), receivers, matches.num_pairs, evidence is not None,
    )  # fmt: skip


def check_fit(matches: Matches, graphs: MatchGraphs, evidence: ImageEvidence | None) -> None:
    """Raise unless graphs and evidence are as long as there are matches.

    >>> from tensor_stereo.graphs import build_match_graphs
    >>> points = torch.tensor([[0.0, 0.0], [4.0, 0.0]])
    >>> matches = Matches(points, points, torch.tensor([0, 2]))
    >>> check_fit(matches, build_match_graphs(matches), None)
    """
    check_match_graphs(matches, graphs)
    if evidence is not None and len(evidence.values) != matches.num_matches:
        raise ValueError(f"evidence must be that of {matches.num_matches} matches, got {len(evidence.values)}")


def find_receivers(i: Tensor, j: Tensor, num_matches: int) -> Receivers:
    """Sort the links (i, j) by either end.

    >>> find_receivers(torch.tensor([0, 0]), torch.tensor([2, 1]), 3).offsets_j
    tensor([0, 0, 1, 2])
    """
    rows = torch.arange(num_matches + 1, device=i.device)
    found = []
    for ends in (i, j):
        receiver, order = torch.sort(ends, stable=True)
        found += [order, torch.searchsorted(receiver, rows)]
    return Receivers(i, j, *found)


def _center(values: Tensor, num_pairs: int, batch: Tensor, share: Tensor) -> Tensor:
    """(M, K) float32, less the mean of the pair, so that rounding does not grow with a shift."""
    values = values.double()
    mean = values.new_zeros(num_pairs, values.shape[1]).index_add(0, batch, values.detach() * share)
    return (values - mean.index_select(0, batch)).float()


def _node_quantities(
    row_offset: Tensor, has_rows: Tensor | None, graphs: MatchGraphs, config: FilterConfig
) -> tuple[Tensor, Tensor]:
    """(M, NUM_NODE) and (M,) number of neighbours. Three zeros, which no offset gives, where no row is known."""
    counts = shared_neighbors(graphs.adjacency0, graphs.adjacency1, backend=config.backend)
    overlap, degree0, degree1 = (count.float() for count in counts)
    degree = (degree0 + degree1 - overlap).clamp(min=1)
    rows = [torch.exp(-2 * row_offset), torch.exp(-row_offset / 2), torch.log1p(row_offset)]
    if has_rows is not None:
        rows = [column * has_rows[:, 0] for column in rows]
    columns = [
        overlap / degree,
        overlap / torch.minimum(degree0, degree1).clamp(min=1),
        torch.log1p(degree0),
        torch.log1p(degree1),
        *rows,
        torch.log1p(overlap),
    ]
    return torch.stack(columns, 1), degree


def _relative_cost(cost: Tensor, ptr: Tensor, batch: Tensor) -> tuple[Tensor, Tensor]:
    """(M, 2) rank of the cost within its pair, in (0, 1), equal costs alike, and its logarithm over the pair's mean.

    (M, 1) float32, 0 in pairs with infinite costs, which say nothing. Costs of a pair with negative ones count from the
    least.
    """
    lengths = ptr.diff()
    order = torch.argsort(cost)
    order = order[torch.argsort(batch[order], stable=True)]
    ordered, pair = cost[order], batch[order]
    begins = torch.ones_like(pair, dtype=torch.bool)
    begins[1:] = (ordered[1:] != ordered[:-1]) | (pair[1:] != pair[:-1])
    run = begins.cumsum(0) - 1
    place = torch.arange(len(order), dtype=torch.float64, device=order.device)
    total = place.new_zeros(len(order)).index_add(0, run, place)
    middle = torch.empty_like(place)
    middle[order] = (total / torch.bincount(run, minlength=len(order)).clamp(min=1))[run]
    rank = (middle - ptr[batch] + 0.5) / lengths[batch]
    usable = cost.new_ones(len(lengths)).scatter_reduce(0, batch, cost.isfinite().to(cost), "amin")[batch]
    cost = torch.where(usable > 0, cost, 0)
    least = cost.new_zeros(len(lengths)).scatter_reduce(0, batch, cost, "amin")
    logs = torch.log(cost - least[batch] + 1e-3)
    mean = logs.new_zeros(len(lengths)).index_add(0, batch, logs) / lengths.clamp(min=1)
    columns = torch.stack([rank, (logs - mean[batch]).clamp(-5, 5)], 1)
    return columns.float(), usable[:, None].float()


def _union(adjacency0: Adjacency, adjacency1: Adjacency) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pairs i < j that are neighbours in either view, and in which, as 0.0 or 1.0."""
    size = max(adjacency0.num_nodes, 1)
    upper = []
    for adjacency in (adjacency0, adjacency1):
        row, col = adjacency.row_indices, adjacency.col_indices
        kept = (row < col).nonzero()[:, 0]
        upper.append(row.index_select(0, kept) * size + col.index_select(0, kept))
    first = torch.cat([upper[0], upper[0].new_full((1,), -1)])  # equal to none, found beyond the last one
    place = torch.searchsorted(upper[0], upper[1])
    shared = first.index_select(0, place) == upper[1]
    extra = upper[1][~shared]
    keys = torch.cat([upper[0], extra])
    if torch.compiler.is_compiling():  # a compiled linear layer needs to know that it has a row
        torch._check(  # type: ignore[no-untyped-call]
            keys.shape[0] >= 1, lambda: "a compiled score 'learned' needs a batch with neighbours in it"
        )
    i = torch.div(keys, size, rounding_mode="floor")
    in0 = torch.cat([torch.ones_like(upper[0]), torch.zeros_like(extra)]).float()
    in1 = torch.cat([torch.zeros_like(upper[0]).index_fill(0, place[shared], 1), torch.ones_like(extra)]).float()
    return i, keys - i * size, in0, in1


def _edge_quantities(
    points: Tensor, i: Tensor, j: Tensor, in0: Tensor, in1: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(U, NUM_EDGE) quantities, the same for both ends; (U, NUM_ODD) those that change their sign with the way.

    (2, U) way from i to j in view 0, and (U,) its length in px.
    """
    x0, y0, x1, y1 = (points.index_select(0, j) - points.index_select(0, i)).t().contiguous()
    length0, length1 = ((x.square() + y.square() + _TINY_PX2).sqrt() for x, y in ((x0, y0), (x1, y1)))
    step = x0 - x1
    gap, row_gap = step.abs(), (y0 - y1).abs()  # px, of the disparities and of the offsets between rows
    log_length, relative = torch.log(length0), gap / length0
    same = torch.exp(gap / -0.7)
    columns = [
        same,
        torch.exp(gap / -2),
        torch.exp(gap / -6),
        torch.log1p(gap),
        relative.clamp(max=2),
        torch.exp(-8 * relative),
        torch.exp(-row_gap),
        torch.log1p(row_gap),
        in0,
        in1,
        log_length,
        torch.log(length1) - log_length,
        same * in0 * in1,
        y0.abs() / length0,
        torch.tanh(step / 4) * x0 / length0,  # is the nearer one on the right?
    ]
    odd = torch.stack([torch.tanh(step / 2), torch.tanh(step / 8)])
    return torch.stack(columns).t(), odd.t(), torch.stack([x0, y0]), length0


def _look_up(evidence: ImageEvidence, disparity: Tensor, i: Tensor, j: Tensor) -> Tensor:
    """(U, 5) would the disparity of j explain the windows of i better, in either view, and was it searched?"""
    _, num_curves, width = evidence.curve0.shape
    if not width:
        return evidence.values.new_zeros(len(i), 2 * num_curves + 1)
    other = disparity.index_select(0, j)  # float64
    column = (other - evidence.first.index_select(0, i)).round().long()
    known = (column >= 0) & (column < evidence.num_columns.index_select(0, i))
    place = torch.where(known, column, 0) + i * (num_curves * width)
    far = known & ((other - disparity.index_select(0, i)).abs() >= 0.5)
    values = [
        curve.reshape(-1).index_select(0, place + k * width) * far
        for curve in (evidence.curve0, evidence.curve1)
        for k in range(num_curves)
    ]
    return torch.stack([*values, known.float()], 1)


def _refined_gap(refined: Tensor, i: Tensor, j: Tensor, length: Tensor) -> Tensor:
    """(U, NUM_REFINED) how far the disparities that the images favour differ."""
    gap = (refined.index_select(0, j) - refined.index_select(0, i)).abs()
    columns = [torch.exp(gap / -0.3), torch.exp(-gap), torch.log1p(gap), torch.exp(-27 * gap / length.clamp(min=1))]
    return torch.stack(columns, 1)
