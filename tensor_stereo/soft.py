"""The differentiable counterpart of the set tests: how far two Delaunay graphs agree around every match.

An edge of the graph has a dual Voronoi edge of positive length; that length, over a temperature, makes the membership
soft. A link joins two matches that are neighbours in some view, or nearly so; each link has a soft adjacency per view.

Keypoints are differentiable; the choice of the points that bound a dual edge is not. Gradients therefore have kinks
where two points tie for that choice and where both views agree on a link, and they are finite everywhere. Nothing here
is differentiable twice, nor in forward mode.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tensor_stereo import ops
from tensor_stereo.configs import COLDEST, HOTTEST, Backend, TemperatureUnit
from tensor_stereo.graphs import MatchGraphs
from tensor_stereo.ops import reference_soft
from tensor_stereo.ops.registration import refuse_tangent
from tensor_stereo.types import Adjacency, Matches, check_links, check_points, check_tie_tolerance, check_unit

SATURATION = 40.0  # |length / temperature| beyond which an adjacency is constant
REACH = 16.0  # temperatures of negative length below which a link counts as blocked; its adjacency is below 1.2e-7
_UNBOUNDED = 2.0**30  # edge lengths to which dual edges are clipped where the tolerance does not


class LinkGeometry(NamedTuple):
    """What bounds the dual Voronoi edges of E links in one view."""

    critical: Tensor  # (E, 2) int64 rows right and left of the way from i to j; -1: none, -2: blocked or out of reach
    is_edge: Tensor  # (E,) bool, of the view's graph


class SoftGraphs(NamedTuple):
    """The graphs of both views of a batch of matches, and all links whose soft adjacency counts."""

    graphs: MatchGraphs
    links: Tensor  # (E, 2) int64 rows i < j of the matches that each link joins
    link_ptr: Tensor  # (B + 1,) int64 offsets of the links of each stereo pair
    view0: LinkGeometry
    view1: LinkGeometry


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
    """Build the graphs of both views, and find the links whose soft adjacency counts.

    In either view these are the edges of the exact graph; the two critical points of each edge if the segment between
    them crosses it, so that an ordinary flip enters and leaves without a jump; and the chords of co-circular polygons
    with at most 16 corners. Without native kernels every link is compared with every point: 3 s for 1000 matches,
    growing with the square.

    Args:
        matches: B pairs; ``group`` splits each pair into objects.
        temperature: () scale above which dual lengths are told apart. Links whose length is below minus :data:`REACH`
            temperatures count as blocked.
        unit: unit of the temperature; ``edge``: lengths of the link, ``px``: pixels.
        tie_tolerance: tolerance of the graphs in [0, 1), in edge lengths; see :func:`tensor_stereo.build_graphs`.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        Graphs and links. No gradient.

    Raises:
        ValueError: for an unknown ``unit``, a temperature that is no number between 1e-9 and 1e9, or what
            :func:`tensor_stereo.graphs.build_match_graphs` refuses.

    Example:
        >>> corners = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])
        >>> build_soft_graphs(Matches(corners, corners, torch.tensor([0, 4]))).links.shape
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
    crow0, cols0, crow1, cols1, group_size, links, link_ptr, critical0, critical1, is_edge0, is_edge1 = found
    adjacencies = Adjacency(crow0, cols0, matches.ptr), Adjacency(crow1, cols1, matches.ptr)
    views = LinkGeometry(critical0, is_edge0), LinkGeometry(critical1, is_edge1)
    return SoftGraphs(MatchGraphs(*adjacencies, group_size), links, link_ptr, *views)


def dual_critical_points(
    keypoints: Tensor, ptr: Tensor, links: Tensor, group: Tensor | None = None, *, backend: Backend = "auto"
) -> Tensor:
    """Find the points that bound the dual Voronoi edges of given links.

    On either side of the line through i and j this is the point that sees the segment under the largest angle: the
    circle through the three has no other point of that side strictly inside. Of several such points it is the
    lexicographically first. The result is exact.

    Args:
        keypoints: (N, 2) float32 or float64 px.
        ptr: (B + 1,) int64 offsets of the images.
        links: (E, 2) int64 rows of two distinct points of one image and group.
        group: (N,) integer object groups.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        (E, 2) int64 rows, right and left of the way from i to j as seen with y upwards; -1 where that side has no
        point; -2 for both where a point lies between i and j. No gradient.

    Raises:
        ValueError: for links that do not join two distinct points of one image and group, or keypoints that
            :func:`tensor_stereo.build_graphs` refuses.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [4.0, 0.0], [2.0, 1.0], [2.0, -2.0]])
        >>> dual_critical_points(points, torch.tensor([0, 4]), torch.tensor([[0, 1]]))
        tensor([[3, 2]])
    """
    found: Tensor = ops.dual_critical_points(keypoints.detach(), ptr, group, links, backend)
    return found


def dual_edge_length(
    keypoints: Tensor,
    links: Tensor,
    critical: Tensor,
    link_ptr: Tensor | None = None,
    *,
    tie_tolerance: float = 1e-3,
    backend: Backend = "auto",
) -> Tensor:
    """Signed length of the dual Voronoi edge of each link: positive iff it is an edge of the Delaunay graph.

    With i, j the ends of the link, m its midpoint and n its unit normal, the circle around m + t n through both leaves
    a third point k outside iff a_k t + b_k > 0. The length is the least of these bounds of t from above minus the
    greatest from below.

    Args:
        keypoints: (M, 2) float32 or float64 px.
        links: (E, 2) int64 rows.
        critical: (E, 2) int64 rows from :func:`dual_critical_points`.
        link_ptr: (K + 1,) int64 offsets of ranges of links that share no point; ranges may run in parallel. None: one
            range.
        tie_tolerance: e in [0, 1); both bounds are clipped to 1 / e lengths of the link, 2**30 if e is zero.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        (E,) float64 px; minus twice the clipped bound where a point lies between. Gradients flow to all four points
        and are finite. Through a bound that is clipped they flow only to the length of the link. Not differentiable
        twice.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.0, 1.0], [1.0, -2.0]])
        >>> dual_edge_length(points, torch.tensor([[0, 1]]), torch.tensor([[3, 2]]))
        tensor([0.7500], dtype=torch.float64)
    """
    points = _to_float64("keypoints", keypoints)
    check_links("links", links, len(points))
    ratio = _ratio(points, links, critical, link_ptr, tie_tolerance, backend)
    return ratio * reference_soft.link_length(points, links)


def soft_adjacency(
    keypoints: Tensor,
    links: Tensor,
    geometry: LinkGeometry,
    temperature: Tensor | float = 1.0,
    *,
    unit: TemperatureUnit = "edge",
    link_ptr: Tensor | None = None,
    tie_tolerance: float = 1e-3,
    backend: Backend = "auto",
) -> Tensor:
    """How much each link is an edge of one view: the sigmoid of its dual length over the temperature.

    The sign of the length is that of the hard graph, so that the limit of temperature 0 is the hard graph wherever the
    length is not zero; where the tolerance has turned the sign, the gradient is still that of the length itself. At a
    tie the adjacency is 1/2. |length / temperature| is clamped to :data:`SATURATION`.

    Args:
        keypoints: (M, 2) float32 or float64 px of one view.
        links: (E, 2) int64 rows.
        geometry: critical points and hard edges of that view.
        temperature: () positive number.
        unit: unit of the temperature; ``edge``: lengths of the link, ``px``: pixels.
        link_ptr: (K + 1,) int64 offsets of ranges of links that share no point; see :func:`dual_edge_length`.
        tie_tolerance: e in [0, 1), which clips dual lengths; see :func:`dual_edge_length`.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        (E,) float64 in (0, 1). Gradients flow to the keypoints and to the temperature.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [2.0, 0.0], [1.0, 1.0], [1.0, -1.0]])
        >>> tie = LinkGeometry(torch.tensor([[3, 2]]), torch.tensor([False]))
        >>> soft_adjacency(points, torch.tensor([[0, 1]]), tie)
        tensor([0.5000], dtype=torch.float64)
    """
    check_unit(unit)
    points = _to_float64("keypoints", keypoints)
    check_links("links", links, len(points))
    length = _ratio(points, links, geometry.critical, link_ptr, tie_tolerance, backend)
    if unit == "px":
        length = length * reference_soft.link_length(points, links)
    value = _to_temperature(temperature, length.device)
    return reference_soft.soft_adjacency(length, geometry.is_edge, value, SATURATION)


def sum_soft_adjacency(adjacency0: Tensor, adjacency1: Tensor, links: Tensor, num_matches: int) -> SoftCounts:
    """Soft sizes of the neighbour sets of every match, of their intersection and of their union.

    Args:
        adjacency0: (E,) soft adjacency of each link in view 0.
        adjacency1: (E,) soft adjacency of each link in view 1.
        links: (E, 2) int64 rows.
        num_matches: number of matches, M.

    Returns:
        Sums of min, max and both adjacencies over the links of each match. Gradients flow; where both adjacencies
        agree, half to each.

    Example:
        >>> half = torch.tensor([0.5])
        >>> sum_soft_adjacency(half, 2 * half, torch.tensor([[0, 1]]), 2).union
        tensor([1., 1.])
    """
    return _to_counts(reference_soft.sum_adjacency(adjacency0, adjacency1, links, num_matches))


def count_soft_neighbors(
    matches: Matches,
    found: SoftGraphs,
    temperature: Tensor | float = 1.0,
    *,
    unit: TemperatureUnit = "edge",
    tie_tolerance: float = 1e-3,
    backend: Backend = "auto",
) -> SoftCounts:
    """Compute :func:`soft_adjacency` in both views and :func:`sum_soft_adjacency` in one pass.

    Args:
        matches: B pairs, M matches.
        found: the result of :func:`build_soft_graphs` for these matches.
        temperature: () positive number.
        unit: unit of the temperature; ``edge``: lengths of the link, ``px``: pixels.
        tie_tolerance: e in [0, 1), which clips dual lengths; see :func:`dual_edge_length`.
        backend: a name of :mod:`tensor_stereo.ops.backends`.

    Returns:
        The counts. Gradients flow to both keypoints and the temperature, and are finite. Not differentiable twice.

    Example:
        >>> corners = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])
        >>> matches = Matches(corners, corners, torch.tensor([0, 4]))
        >>> count_soft_neighbors(matches, build_soft_graphs(matches)).intersection > 2  # and half of a diagonal
        tensor([True, True, True, True])
    """
    check_unit(unit)
    points0, points1 = _to_float64("keypoints0", matches.keypoints0), _to_float64("keypoints1", matches.keypoints1)
    sums = ops.soft_counts(
        points0,
        points1,
        found.links,
        found.view0.critical,
        found.view1.critical,
        found.view0.is_edge,
        found.view1.is_edge,
        found.link_ptr,
        _to_temperature(temperature, points0.device),
        SATURATION,
        unit == "px",
        _bound(tie_tolerance),
        backend,
    )
    return _to_counts(sums)


def _to_counts(sums: Tensor) -> SoftCounts:
    intersection, degree0, degree1 = sums.unbind(1)
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
    points: Tensor, links: Tensor, critical: Tensor, link_ptr: Tensor | None, tie_tolerance: float, backend: Backend
) -> Tensor:
    if link_ptr is None:
        link_ptr = torch.tensor([0, len(links)], device=links.device)
    ratio: Tensor = ops.dual_edge_ratio(points, links, critical, link_ptr, _bound(tie_tolerance), backend)
    return ratio


def _bound(tie_tolerance: float) -> float:
    """Edge lengths to which the ends of dual edges are clipped."""
    check_tie_tolerance(tie_tolerance)
    return 1 / tie_tolerance if tie_tolerance > 0 else _UNBOUNDED


def _to_float64(name: str, keypoints: Tensor) -> Tensor:
    check_points(name, keypoints)
    refuse_tangent(name, keypoints, "soft")
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
