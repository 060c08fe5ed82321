"""The soft graphs in plain torch: the definition of what the compiled kernels compute.

A link joins two rows, i and j, that are neighbours in some view, or nearly so. Each function whose name ends in
``_backward`` is the gradient of another one, written out, because torch runs no autograd inside an operator.
"""

from __future__ import annotations

import torch
from torch import Tensor

_TIE = 1e-9  # adjacencies closer than that share the gradient of their minimum


def dual_edge_ratio(points: Tensor, links: Tensor, critical: Tensor, bound: float) -> Tensor:
    """Signed lengths of dual Voronoi edges in lengths of their links; see :func:`tensor_stereo.ops.dual_edge_ratio`."""
    ends = []
    for k in critical.unbind(1):
        along, across, is_free = _dual_end(points, links, k, bound)
        with torch.no_grad():
            end = (along / across).nan_to_num(bound, posinf=bound, neginf=-bound).clamp(-bound, bound)
            clipped = torch.where(k == -1, bound, end)
        # masked before the division, because where() would turn an unused 0 / 0 into a NaN gradient
        ends.append(torch.where(is_free, along / torch.where(is_free, across, 1), clipped))
    return torch.where((critical == -2).any(1), -2 * bound, ends[0] + ends[1])


def dual_edge_ratio_backward(points: Tensor, links: Tensor, critical: Tensor, gradient: Tensor, bound: float) -> Tensor:
    """Gradient of :func:`dual_edge_ratio` with respect to the points.

    With q = p_k - p_i, d = p_j - p_i and J the rotation by 90 degrees, an end is q.(q - d) / 2 |d x q|.
    """
    result = torch.zeros_like(points)
    i, j = links.unbind(1)
    d = points[j] - points[i]
    gradient = gradient.masked_fill((critical == -2).any(1), 0)
    for side, k in zip((-1, 1), critical.unbind(1), strict=True):
        along, across, is_free = _dual_end(points, links, k, bound)
        q = points[k.clamp(min=0)] - points[i]
        across = torch.where(is_free, across, 1)[:, None]
        scale = torch.where(is_free, gradient, 0)[:, None] / across
        turn = 2 * side * along[:, None] / across
        of_k = scale * (2 * q - d - turn * _rotate(d))
        of_j = scale * (turn * _rotate(q) - q)
        for index, part in ((k.clamp(min=0), of_k), (j, of_j), (i, -of_k - of_j)):
            result.index_add_(0, index, part)
    return result


def _dual_end(points: Tensor, links: Tensor, k: Tensor, bound: float) -> tuple[Tensor, Tensor, Tensor]:
    """Numerator and denominator of the ends towards k, and which are finite and not clipped."""
    i = points[links[:, 0]]
    dx, dy = (points[links[:, 1]] - i).unbind(1)
    x, y = (points[k.clamp(min=0)] - i).unbind(1)
    along, across = x * (x - dx) + y * (y - dy), 2 * (dx * y - dy * x).abs()
    return along, across, (k >= 0) & ((along / across).detach().abs() < bound)


def _rotate(vectors: Tensor) -> Tensor:
    return torch.stack([-vectors[:, 1], vectors[:, 0]], 1)


def link_length(points: Tensor, links: Tensor) -> Tensor:
    """(E,) distance of the two points of each link in px."""
    i, j = links.unbind(1)
    length: Tensor = torch.linalg.vector_norm(points.index_select(0, j) - points.index_select(0, i), dim=1)
    return length


def _dual_length(points: Tensor, links: Tensor, critical: Tensor, in_px: bool, bound: float) -> Tensor:
    """(E,) signed lengths of dual Voronoi edges, in px or in lengths of their links."""
    ratio = dual_edge_ratio(points, links, critical, bound)
    return ratio * link_length(points, links) if in_px else ratio


def _dual_length_backward(
    points: Tensor, links: Tensor, critical: Tensor, gradient: Tensor, in_px: bool, bound: float
) -> Tensor:
    if not in_px:
        return dual_edge_ratio_backward(points, links, critical, gradient, bound)
    i, j = links.unbind(1)
    edge = link_length(points, links)
    direction = ((points[j] - points[i]) / edge[:, None]).masked_fill(edge[:, None] == 0, 0)
    pull = (gradient * dual_edge_ratio(points, links, critical, bound))[:, None] * direction
    of_edge = torch.zeros_like(points).index_add(0, i, -pull) + torch.zeros_like(points).index_add(0, j, pull)
    return of_edge + dual_edge_ratio_backward(points, links, critical, gradient * edge, bound)


def soft_adjacency(length: Tensor, is_edge: Tensor, temperature: Tensor, saturation: float) -> Tensor:
    """(E,) sigmoid of dual lengths over the temperature; see :func:`tensor_stereo.soft.soft_adjacency`.

    The value takes the sign of the hard graph, which rounding and the tolerance must not contradict; the gradient is
    that of the length itself.
    """
    length = length + (_signed(length, is_edge) - length).detach()
    return torch.sigmoid((length / temperature).clamp(-saturation, saturation))


def _soft_adjacency_backward(
    length: Tensor, is_edge: Tensor, temperature: Tensor, saturation: float, gradient: Tensor
) -> tuple[Tensor, Tensor]:
    """Gradients of the lengths and of the temperature."""
    exponent = _signed(length, is_edge) / temperature
    adjacency = torch.sigmoid(exponent.clamp(-saturation, saturation))
    of_exponent = gradient * (1 - adjacency) * adjacency
    of_exponent = torch.where(exponent.abs() <= saturation, of_exponent, 0)
    return of_exponent / temperature, -(of_exponent * (exponent / temperature)).sum()


def _signed(length: Tensor, is_edge: Tensor) -> Tensor:
    size = length.detach().abs()
    return torch.where(is_edge, size, -size)


def sum_adjacency(adjacency0: Tensor, adjacency1: Tensor, links: Tensor, num_matches: int) -> Tensor:
    """(M, 3) sums of min(a0, a1), a0 and a1 over the links of each match."""
    share = _share(adjacency0, adjacency1)
    shared = share * adjacency0 + (1 - share) * adjacency1
    shared = shared + (torch.minimum(adjacency0, adjacency1) - shared).detach()
    values = torch.stack([shared, adjacency0, adjacency1], 1)  # (E, 3)
    i, j = links.unbind(1)
    return values.new_zeros(num_matches, 3).index_add(0, i, values).index_add(0, j, values)


def _sum_adjacency_backward(
    adjacency0: Tensor, adjacency1: Tensor, links: Tensor, gradient: Tensor
) -> tuple[Tensor, Tensor]:
    i, j = links.unbind(1)
    of_shared, of_adjacency0, of_adjacency1 = (gradient[i] + gradient[j]).unbind(1)
    share = _share(adjacency0, adjacency1)
    return of_adjacency0 + of_shared * share, of_adjacency1 + of_shared * (1 - share)


def _share(adjacency0: Tensor, adjacency1: Tensor) -> Tensor:
    """(E,) part of the gradient of min(a0, a1) that a0 gets: where both agree one half, so that rounding has no say."""
    return (0.5 + (adjacency1 - adjacency0).detach() / (2 * _TIE)).clamp(0, 1)


def soft_counts(
    points0: Tensor,
    points1: Tensor,
    links: Tensor,
    critical0: Tensor,
    critical1: Tensor,
    is_edge0: Tensor,
    is_edge1: Tensor,
    temperature: Tensor,
    saturation: float,
    in_px: bool,
    bound: float,
) -> Tensor:
    """Soft sizes of the neighbour sets of every match; see :func:`tensor_stereo.ops.soft_counts`."""
    adjacency0, adjacency1 = (
        soft_adjacency(_dual_length(points, links, critical, in_px, bound), is_edge, temperature, saturation)
        for points, critical, is_edge in ((points0, critical0, is_edge0), (points1, critical1, is_edge1))
    )
    return sum_adjacency(adjacency0, adjacency1, links, points0.shape[0])


def soft_counts_backward(
    points0: Tensor,
    points1: Tensor,
    links: Tensor,
    critical0: Tensor,
    critical1: Tensor,
    is_edge0: Tensor,
    is_edge1: Tensor,
    temperature: Tensor,
    gradient: Tensor,
    saturation: float,
    in_px: bool,
    bound: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of :func:`soft_counts` with respect to both point sets and the temperature."""
    views = ((points0, critical0, is_edge0), (points1, critical1, is_edge1))
    lengths = [_dual_length(points, links, critical, in_px, bound) for points, critical, _ in views]
    adjacency0, adjacency1 = (
        soft_adjacency(length, is_edge, temperature, saturation)
        for length, (_, _, is_edge) in zip(lengths, views, strict=True)
    )
    of_adjacencies = _sum_adjacency_backward(adjacency0, adjacency1, links, gradient)
    of_points, of_temperature = [], torch.zeros_like(temperature)
    for (points, critical, is_edge), length, of_adjacency in zip(views, lengths, of_adjacencies, strict=True):
        of_length, part = _soft_adjacency_backward(length, is_edge, temperature, saturation, of_adjacency)
        of_points.append(_dual_length_backward(points, links, critical, of_length, in_px, bound))
        of_temperature = of_temperature + part
    return of_points[0], of_points[1], of_temperature
