"""The differentiable counterpart of the set tests: how far two Delaunay graphs agree around every match.

An edge of the graph has a dual Voronoi edge of positive length; that length, over a temperature, makes the membership
soft. Keypoints are differentiable; which points bound a dual edge is not, so gradients have kinks where two points tie
for it or where both views agree on a pair, and stay finite everywhere. Nothing here is differentiable twice, nor in
forward mode.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

from tensor_stereo import ops
from tensor_stereo.configs import COLDEST, HOTTEST, Backend, TemperatureUnit
from tensor_stereo.graphs import MatchGraphs
from tensor_stereo.types import Adjacency, Matches, check_pairs, check_points, check_tie_tolerance, check_unit

SATURATION = 40.0  # |length / temperature| beyond which an adjacency is constant
REACH = 16.0  # temperatures of negative length below which a pair counts as blocked; its adjacency is below 1.2e-7
_TIE = 1e-9  # adjacencies closer than that share the gradient of their minimum
_UNBOUNDED = 2.0**30  # edge lengths to which dual edges are clipped where the tolerance does not


class PairGeometry(NamedTuple):
    """What bounds the dual Voronoi edges of E pairs of rows in one view."""

    critical: Tensor  # (E, 2) int64 rows right and left of the way from i to j; -1: none, -2: blocked or out of reach
    is_edge: Tensor  # (E,) bool, of the view's graph


class SoftGraphs(NamedTuple):
    """The graphs of both views of a batch of matches, and all pairs of matches that count softly."""

    graphs: MatchGraphs
    pairs: Tensor  # (E, 2) int64 rows i < j
    pair_ptr: Tensor  # (B + 1,) int64 offsets of the pairs
    view0: PairGeometry
    view1: PairGeometry


class SoftCounts(NamedTuple):
    """Sums over the neighbours of every match, (M,) float64; the soft sizes of |N0 & N1|, |N0 | N1|, |N0| and |N1|."""

    intersection: Tensor
    union: Tensor
    degree0: Tensor
    degree1: Tensor


def build_soft_graphs(
    matches: Matches,
    temperature: Tensor | float = 1.0,
    *,
    unit: TemperatureUnit = "edge",
    tie_tolerance: float = 1e-3,
    backend: Backend = "auto",
) -> SoftGraphs:
    """The graphs of both views, and the pairs of matches whose soft adjacency counts.

    In either view these are the edges of the exact graph; the two critical points of each edge if their segment crosses
    it, so that an ordinary flip enters and leaves without a jump; and the chords of co-circular polygons with at most
    16 corners.

    Args:
        matches: B pairs; ``group`` splits each pair into objects.
        temperature: () above which dual lengths are told apart; pairs :data:`REACH` temperatures below zero count as
            blocked.
        unit: ``edge``: in lengths of the pair; ``px``: in pixels.
        tie_tolerance: as in :func:`tensor_stereo.build_graphs`.
        backend: as in :func:`tensor_stereo.build_graphs`. Without native kernels all pairs are held against all points:
            3 s for 1000 matches, growing with the square.

    Returns:
        Graphs and pairs. No gradient.

    Raises:
        ValueError: as :func:`tensor_stereo.graphs.build_match_graphs`, for an unknown ``unit``, or a temperature that
            is no number between 1e-9 and 1e9.

    Example:
        >>> corners = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])
        >>> build_soft_graphs(Matches(corners, corners, torch.tensor([0, 4]))).pairs.shape
        torch.Size([6, 2])
    """
    check_unit(unit)
    like = matches.keypoints0
    reach = REACH * _to_temperature(temperature, like.device).detach()
    none = torch.zeros_like(reach)
    found = ops.soft_match_graphs(
        like.detach(),
        matches.keypoints1.detach(),
        matches.ptr,
        matches.cost,
        matches.group,
        torch.stack([reach, none] if unit == "edge" else [none, reach]),
        tie_tolerance,
        backend,
    )
    crow0, cols0, crow1, cols1, group_size, pairs, pair_ptr, critical0, critical1, is_edge0, is_edge1 = found
    adjacencies = Adjacency(crow0, cols0, matches.ptr), Adjacency(crow1, cols1, matches.ptr)
    views = PairGeometry(critical0, is_edge0), PairGeometry(critical1, is_edge1)
    return SoftGraphs(MatchGraphs(*adjacencies, group_size), pairs, pair_ptr, *views)


def dual_critical_points(
    keypoints: Tensor, ptr: Tensor, pairs: Tensor, group: Tensor | None = None, *, backend: Backend = "auto"
) -> Tensor:
    """The points that bound the dual Voronoi edge of given pairs of points.

    On either side of the line through i and j that is the point which sees the segment under the largest angle: the
    circle through the three has no other point of that side strictly inside. Of several the lexicographically first.
    Found exactly, by a walk through the triangles that the segment crosses.

    Args:
        keypoints: (N, 2) float32 or float64 px.
        ptr: (B + 1,) int64 offsets of the images.
        pairs: (E, 2) int64 rows of two distinct points of one image and group.
        group: (N,) integer object groups.
        backend: as in :func:`tensor_stereo.build_graphs`.

    Returns:
        (E, 2) int64 rows, right and left of the way from i to j as seen with y upwards; -1 where that side has no
        point; -2 for both where a point lies between i and j. No gradient.

    Raises:
        ValueError: for pairs that are none, or keypoints as in :func:`tensor_stereo.build_graphs`.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [4.0, 0.0], [2.0, 1.0], [2.0, -2.0]])
        >>> dual_critical_points(points, torch.tensor([0, 4]), torch.tensor([[0, 1]]))
        tensor([[3, 2]])
    """
    found: Tensor = ops.dual_critical_points(keypoints.detach(), ptr, group, pairs, backend)
    return found


def dual_edge_length(
    keypoints: Tensor,
    pairs: Tensor,
    critical: Tensor,
    pair_ptr: Tensor | None = None,
    *,
    tie_tolerance: float = 1e-3,
    backend: Backend = "auto",
) -> Tensor:
    """Signed length of the dual Voronoi edge of each pair: positive iff it is an edge of the Delaunay graph.

    With i, j the pair, m its midpoint and n its unit normal, the circle around m + t n through both leaves a third
    point k outside iff a_k t + b_k > 0. The length is the least of these bounds of t from above minus the greatest from
    below.

    Args:
        keypoints: (M, 2) float32 or float64 px.
        pairs: (E, 2) int64 rows.
        critical: (E, 2) int64 rows, as :func:`dual_critical_points` gives them.
        pair_ptr: (K + 1,) int64 offsets of ranges of pairs that share no point; they may run in parallel.
        tie_tolerance: e; both bounds are clipped to 1 / e lengths of the pair, 2**30 if it is zero.
        backend: as in :func:`tensor_stereo.build_graphs`.

    Returns:
        (E,) float64 px; minus twice the clipped bound where a point lies between. Gradients flow to all four points,
        and are finite; there is none through a bound that is clipped but for the length of the pair. Not differentiable
        twice.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.0, 1.0], [1.0, -2.0]])
        >>> dual_edge_length(points, torch.tensor([[0, 1]]), torch.tensor([[3, 2]]))
        tensor([0.7500], dtype=torch.float64)
    """
    points = _to_float64("keypoints", keypoints)
    check_pairs("pairs", pairs, len(points))
    ratio = _ratio(points, pairs, critical, pair_ptr, tie_tolerance, backend)
    return ratio * pair_length(points, pairs)


def pair_length(keypoints: Tensor, pairs: Tensor) -> Tensor:
    """(E,) distance of the two points of each pair in px; gradients flow.

    >>> pair_length(torch.tensor([[0.0, 0.0], [3.0, 4.0]]), torch.tensor([[0, 1]]))
    tensor([5.])
    """
    i, j = pairs.unbind(1)
    length: Tensor = torch.linalg.vector_norm(keypoints.index_select(0, j) - keypoints.index_select(0, i), dim=1)
    return length


def soft_adjacency(
    keypoints: Tensor,
    pairs: Tensor,
    geometry: PairGeometry,
    temperature: Tensor | float = 1.0,
    *,
    unit: TemperatureUnit = "edge",
    pair_ptr: Tensor | None = None,
    tie_tolerance: float = 1e-3,
    backend: Backend = "auto",
) -> Tensor:
    """How much each pair is an edge: the sigmoid of its dual length over the temperature.

    The sign of the length is that of the hard graph, so that the limit of temperature 0 is the hard graph wherever the
    length is not zero; where the tolerance has turned the sign, the gradient is still that of the length itself. At a
    tie the adjacency is 1/2. |length / temperature| is cut at :data:`SATURATION`.

    Args:
        keypoints: (M, 2) float32 or float64 px of one view.
        pairs: (E, 2) int64 rows.
        geometry: critical points and hard edges of that view.
        temperature: (); positive.
        unit: ``edge``: in lengths of the pair; ``px``: in pixels.
        pair_ptr: as in :func:`dual_edge_length`.
        tie_tolerance: as in :func:`dual_edge_length`.
        backend: as in :func:`tensor_stereo.build_graphs`.

    Returns:
        (E,) float64 in (0, 1). Gradients flow to the keypoints and to the temperature.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.0, 1.0], [1.0, -1.0]])
        >>> tie = PairGeometry(torch.tensor([[3, 2]]), torch.tensor([False]))
        >>> soft_adjacency(points, torch.tensor([[0, 1]]), tie)
        tensor([0.5000], dtype=torch.float64)
    """
    check_unit(unit)
    points = _to_float64("keypoints", keypoints)
    check_pairs("pairs", pairs, len(points))
    length = _ratio(points, pairs, geometry.critical, pair_ptr, tie_tolerance, backend)
    if unit == "px":
        length = length * pair_length(points, pairs)
    with torch.no_grad():  # rounding and the tolerance must not contradict the hard graph, nor turn the gradient
        signed = torch.where(geometry.is_edge, length.abs(), -length.abs())
    length = length + (signed - length).detach()
    return torch.sigmoid((length / _to_temperature(temperature, length.device)).clamp(-SATURATION, SATURATION))


def soft_counts(adjacency0: Tensor, adjacency1: Tensor, pairs: Tensor, num_matches: int) -> SoftCounts:
    """Soft sizes of the neighbour sets of every match, of what they share and of what they hold together.

    Args:
        adjacency0: (E,) soft adjacency of each pair in view 0.
        adjacency1: (E,) the same in view 1.
        pairs: (E, 2) int64 rows.
        num_matches: M.

    Returns:
        Sums of min, max and both adjacencies over the pairs of each match. Gradients flow; where both adjacencies
        agree, half to each.

    Example:
        >>> half = torch.tensor([0.5])
        >>> soft_counts(half, 2 * half, torch.tensor([[0, 1]]), 2).union
        tensor([1., 1.])
    """
    # Where both agree, rounding must not decide which of them gets the gradient of the lesser.
    share = (0.5 + (adjacency1 - adjacency0).detach() / (2 * _TIE)).clamp(0, 1)
    shared = share * adjacency0 + (1 - share) * adjacency1
    shared = shared + (torch.minimum(adjacency0, adjacency1) - shared).detach()
    values = torch.stack([shared, adjacency0, adjacency1], 1)  # (E, 3)
    zeros = values.new_zeros(num_matches, 3)
    i, j = pairs.unbind(1)
    intersection, degree0, degree1 = zeros.index_add(0, i, values).index_add(0, j, values).unbind(1)
    return SoftCounts(intersection, degree0 + degree1 - intersection, degree0, degree1)


def count_soft_neighbors(
    matches: Matches,
    found: SoftGraphs,
    temperature: Tensor | float = 1.0,
    *,
    unit: TemperatureUnit = "edge",
    tie_tolerance: float = 1e-3,
    backend: Backend = "auto",
) -> SoftCounts:
    """:func:`soft_adjacency` in both views and :func:`soft_counts`, where there are native kernels in one pass.

    Args:
        matches: as in :func:`build_soft_graphs`.
        found: what it has found.
        temperature: (); positive.
        unit: as in :func:`build_soft_graphs`.
        tie_tolerance: as in :func:`build_soft_graphs`.
        backend: as in :func:`tensor_stereo.build_graphs`.

    Returns:
        Gradients flow to both keypoints and the temperature, and are finite. Not differentiable twice.

    Example:
        >>> corners = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])
        >>> matches = Matches(corners, corners, torch.tensor([0, 4]))
        >>> count_soft_neighbors(matches, build_soft_graphs(matches)).intersection > 2  # and half of a diagonal
        tensor([True, True, True, True])
    """
    check_unit(unit)
    views = (("keypoints0", matches.keypoints0, found.view0), ("keypoints1", matches.keypoints1, found.view1))
    if ops.resolve_backend(backend) == "scipy":
        adjacency0, adjacency1 = (
            soft_adjacency(
                keypoints,
                found.pairs,
                view,
                temperature,
                unit=unit,
                pair_ptr=found.pair_ptr,
                tie_tolerance=tie_tolerance,
                backend=backend,
            )
            for _, keypoints, view in views
        )
        return soft_counts(adjacency0, adjacency1, found.pairs, matches.num_matches)
    points0, points1 = (_to_float64(name, keypoints) for name, keypoints, _ in views)
    counts = ops.soft_counts(
        points0,
        points1,
        found.pairs,
        found.view0.critical,
        found.view1.critical,
        found.view0.is_edge,
        found.view1.is_edge,
        found.pair_ptr,
        _to_temperature(temperature, points0.device),
        SATURATION,
        unit == "px",
        _bound(tie_tolerance),
    )
    intersection, degree0, degree1 = counts.unbind(1)
    return SoftCounts(intersection, degree0 + degree1 - intersection, degree0, degree1)


def soft_jaccard(counts: SoftCounts) -> Tensor:
    """Shared over all neighbours, (M,) in [0, 1]; 1 iff both sides agree, the limit of Restriction 1. No neighbour: 0.

    Example:
        >>> one = torch.ones(1)
        >>> soft_jaccard(SoftCounts(one, 2 * one, one, 2 * one))
        tensor([0.5000])
    """
    return _divide(counts.intersection, counts.union)


def soft_overlap(counts: SoftCounts) -> Tensor:
    """Shared neighbours over those of the smaller side, (M,) in [0, 1]; the limit of Restriction 2. No neighbour: 0.

    Example:
        >>> one = torch.ones(1)
        >>> soft_overlap(SoftCounts(one, 2 * one, one, 2 * one))
        tensor([1.])
    """
    return _divide(counts.intersection, torch.minimum(counts.degree0, counts.degree1))


def _divide(part: Tensor, whole: Tensor) -> Tensor:
    is_empty = whole <= 0
    return torch.where(is_empty, torch.zeros_like(part), part / torch.where(is_empty, 1, whole))


def _ratio(
    points: Tensor, pairs: Tensor, critical: Tensor, pair_ptr: Tensor | None, tie_tolerance: float, backend: Backend
) -> Tensor:
    if pair_ptr is None:
        pair_ptr = torch.tensor([0, len(pairs)], device=pairs.device)
    ratio: Tensor = ops.dual_edge_ratio(points, pairs, critical, pair_ptr, _bound(tie_tolerance), backend)
    return ratio


def _bound(tie_tolerance: float) -> float:
    """Edge lengths to which the ends of dual edges are clipped."""
    check_tie_tolerance(tie_tolerance)
    return 1 / tie_tolerance if tie_tolerance > 0 else _UNBOUNDED


def _to_float64(name: str, keypoints: Tensor) -> Tensor:
    check_points(name, keypoints)
    if not torch.compiler.is_compiling() and forward_ad.unpack_dual(keypoints).tangent is not None:  # type: ignore[no-untyped-call]
        raise NotImplementedError(f"{name} carries a tangent, but the soft score has no forward mode")
    return keypoints.to(torch.float64)


def _to_temperature(temperature: Tensor | float, device: torch.device) -> Tensor:
    """() float64."""
    value = torch.as_tensor(temperature, dtype=torch.float64, device=device)
    if value.ndim != 0:
        raise ValueError(f"temperature must be a number, got shape {tuple(value.shape)}")
    if not torch.compiler.is_compiling():
        check_temperature(value.item())
    return value


def check_temperature(temperature: float) -> None:
    """Raise unless 1e-9 <= temperature <= 1e9, where gradients are finite in float32 too.

    >>> check_temperature(1.0)
    """
    if not COLDEST <= temperature <= HOTTEST:
        raise ValueError(f"temperature must lie in [{COLDEST:g}, {HOTTEST:g}], got {temperature}")
