"""Both back ends find the same links and critical points; the definition over fractions says which are right."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo import ops
from tests.oracles import installed_backends
from tests.point_sets import GENERATORS, distinct_points

KINDS = sorted(GENERATORS)
INFINITE = torch.tensor([torch.inf, 0.0], dtype=torch.float64)
NATIVE = pytest.mark.skipif("native" not in installed_backends(), reason="the native kernels are not installed")


def _views(kind: str, seed: int, n: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    left = distinct_points(kind, seed, n)
    right = left[np.random.default_rng(seed).permutation(len(left))]
    ptr = torch.tensor([0, len(left) // 3, len(left) // 3, len(left)])
    return torch.from_numpy(left), torch.from_numpy(right), ptr


@NATIVE
@pytest.mark.parametrize("reach", [(np.inf, 0.0), (4.0, 0.0), (0.0, 3.0)])
@pytest.mark.parametrize("kind", KINDS)
def test_back_ends_give_the_same_bits(kind: str, reach: tuple[float, float]) -> None:
    for seed in range(25):
        _compare_back_ends(kind, seed, 1 + 2 * seed, reach)


@NATIVE
@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_back_ends_give_the_same_bits_on_many_sets(kind: str) -> None:
    for seed in range(400):
        _compare_back_ends(kind, seed, 1 + seed % 40, [(4.0, 0.0), (0.0, 3.0), (1.6, 0.0)][seed % 3])


def _compare_back_ends(kind: str, seed: int, n: int, reach: tuple[float, float]) -> None:
    left, right, ptr = _views(kind, seed, n)
    group = torch.arange(len(left)) % 2 if seed % 2 else None
    arguments = (left, right, ptr, None, group, torch.tensor(reach, dtype=torch.float64), 1e-3)
    for native, plain in zip(
        ops.soft_match_graphs(*arguments, "native"), ops.soft_match_graphs(*arguments, "scipy"), strict=True
    ):
        assert native.dtype == plain.dtype
        assert torch.equal(native, plain)


@pytest.mark.parametrize("backend", installed_backends())
@given(st.sampled_from(KINDS), st.integers(0, 10**6), st.integers(3, 14))
def test_critical_points_have_an_empty_circle_on_their_side(backend: str, kind: str, seed: int, n: int) -> None:
    points = distinct_points(kind, seed, n)
    links = np.stack(np.triu_indices(len(points), 1), 1)
    ptr = torch.tensor([0, len(points)])
    found = ops.dual_critical_points(torch.from_numpy(points), ptr, None, torch.from_numpy(links), backend)
    exact = [(Fraction(float(x)), Fraction(float(y))) for x, y in points]
    for (i, j), given_critical in zip(links.tolist(), found.tolist(), strict=True):
        assert given_critical == _critical(exact, i, j)


def _critical(points: list[tuple[Fraction, Fraction]], i: int, j: int) -> list[int]:
    """By definition: least cotangent on either side, lexicographically first among equals."""
    (ax, ay), (bx, by) = points[i], points[j]
    best: dict[int, tuple[Fraction, tuple[Fraction, Fraction], int]] = {}
    for k, (x, y) in enumerate(points):
        if k in (i, j):
            continue
        cross = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
        along = (x - ax) * (x - bx) + (y - ay) * (y - by)
        if cross == 0:
            if along < 0:
                return [-2, -2]
            continue
        side = 1 if cross > 0 else 0
        candidate = (along / abs(cross), points[k], k)
        best[side] = min(best.get(side, candidate), candidate)
    return [best[side][2] if side in best else -1 for side in (0, 1)]


@pytest.mark.parametrize("backend", installed_backends())
@given(st.sampled_from(KINDS), st.integers(0, 10**6), st.integers(1, 30))
def test_links_hold_both_graphs_and_do_not_depend_on_the_order_of_matches(
    backend: str, kind: str, seed: int, n: int
) -> None:
    left, right, ptr = _views(kind, seed, n)
    ptr = ptr[[0, -1]]
    crow0, cols0, crow1, cols1, size, links, link_ptr, *_, edge0, edge1 = ops.soft_match_graphs(
        left, right, ptr, None, None, INFINITE, 1e-3, backend
    )
    hard = ops.match_graphs(left, right, ptr, None, None, 1e-3, backend)
    assert all(torch.equal(a, b) for a, b in zip((crow0, cols0, crow1, cols1, size), hard, strict=True))
    assert link_ptr.tolist() == [0, len(links)]
    assert bool((links[:, 0] < links[:, 1]).all())
    for crow, cols, is_edge in ((crow0, cols0, edge0), (crow1, cols1, edge1)):
        rows = torch.repeat_interleave(crow.diff())
        edges = {(i, j) for i, j in zip(rows.tolist(), cols.tolist(), strict=True) if i < j}
        assert edges == set(map(tuple, links[is_edge].tolist()))
    order = torch.from_numpy(np.random.default_rng(seed).permutation(len(left)))
    shuffled = ops.soft_match_graphs(left[order], right[order], ptr, None, None, INFINITE, 1e-3, backend)[5]
    assert set(map(tuple, order[shuffled].sort(1).values.tolist())) == set(map(tuple, links.tolist()))


@pytest.mark.parametrize("backend", installed_backends())
def test_operators_keep_the_rules_of_torch(backend: str) -> None:
    left, right, ptr = _views("uniform", 0, 20)
    reach = torch.tensor([16.0, 0.0], dtype=torch.float64)
    arguments = (left, right, ptr, None, None, reach, 1e-3, backend)
    torch.library.opcheck(torch.ops.tensor_stereo.soft_match_graphs.default, arguments)
    links, link_ptr, critical = (ops.soft_match_graphs(*arguments)[k] for k in (5, 6, 7))
    torch.library.opcheck(torch.ops.tensor_stereo.dual_critical_points.default, (left, ptr, None, links, backend))
    leaf = left.clone().requires_grad_()
    torch.library.opcheck(
        torch.ops.tensor_stereo.dual_edge_ratio.default, (leaf, links, critical, link_ptr, 1e3, backend)
    )
    torch.library.opcheck(
        torch.ops.tensor_stereo.dual_edge_ratio_backward.default,
        (left, links, critical, link_ptr, torch.ones(len(links), dtype=torch.float64), 1e3, backend),
    )


@pytest.mark.parametrize(
    ("links", "message"),
    [
        (torch.tensor([[0, 0]]), "two distinct points"),
        (torch.tensor([[0, 3]]), "one segment"),
        (torch.tensor([[1, 2]]), "not repeated"),
        (torch.tensor([[0, 9]]), "rows 0..3"),
        (torch.tensor([0, 1]), "links must be"),
    ],
)
def test_links_that_are_none_are_refused(links: torch.Tensor, message: str) -> None:
    points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [5.0, 5.0]])
    with pytest.raises(ValueError, match=message):
        ops.dual_critical_points(points, torch.tensor([0, 3, 4]), None, links, "auto")
