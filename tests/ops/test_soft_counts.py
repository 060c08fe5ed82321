"""Both back ends give the same soft counts and gradients; autograd over plain torch says which are right."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo import ops
from tensor_stereo.ops import reference_soft
from tests.oracles import installed_backends
from tests.point_sets import GENERATORS, distinct_points

NATIVE = pytest.mark.skipif("native" not in installed_backends(), reason="the native kernels are not installed")
KINDS = sorted(GENERATORS)
SATURATION = 40.0


def _tensors(kind: str, seed: int, n: int, temperature: float, tie_tolerance: float) -> tuple[torch.Tensor, ...]:
    """Some of the matches wrong, in three pairs of which one is empty."""
    left = distinct_points(kind, seed, n)
    right = left.copy()
    rng = np.random.default_rng(seed)
    moved = np.flatnonzero(rng.random(len(left)) < 0.4)
    right[moved] = right[rng.permutation(moved)]
    views = torch.from_numpy(left), torch.from_numpy(right)
    ptr = torch.tensor([0, len(left) // 3, len(left) // 3, len(left)])
    reach = torch.tensor([16.0 * temperature, 0.0], dtype=torch.float64)
    found = ops.soft_match_graphs(*views, ptr, None, None, reach, tie_tolerance, "auto")
    links, link_ptr, *geometry = found[5:]
    return *views, links, *geometry, link_ptr, torch.tensor(temperature, dtype=torch.float64)


def _results(tensors: tuple[torch.Tensor, ...], *settings: Any) -> list[torch.Tensor]:
    """Counts, and gradients of both point sets and the temperature for distinct weights of the counts."""
    leaves = {k: tensors[k].clone().requires_grad_() for k in (0, 1, 8)}
    counts = ops.soft_counts(*(leaves.get(k, tensor) for k, tensor in enumerate(tensors)), *settings)
    return [counts.detach(), *torch.autograd.grad(counts, list(leaves.values()), _weights(counts))]


def _weights(counts: torch.Tensor) -> torch.Tensor:
    return torch.linspace(-1, 2, counts.numel(), dtype=torch.float64).reshape(counts.shape)


def _assert_close(found: list[torch.Tensor], expected: list[torch.Tensor]) -> None:
    for one, two in zip(found, expected, strict=True):
        scale = float(two.abs().max()) if two.numel() else 0.0
        torch.testing.assert_close(one, two, rtol=1e-9, atol=1e-9 * scale)


@NATIVE
@given(
    st.sampled_from(KINDS),
    st.integers(0, 10**6),
    st.integers(1, 30),
    st.booleans(),
    st.sampled_from([1e-2, 1.0, 30.0]),
    st.sampled_from([0.0, 1e-3]),
)
def test_back_ends_give_the_same_counts(
    kind: str, seed: int, n: int, in_px: bool, temperature: float, tie_tolerance: float
) -> None:
    tensors = _tensors(kind, seed, n, temperature, tie_tolerance)
    settings = SATURATION, in_px, 1 / max(tie_tolerance, 2.0**-30)
    native, plain = (ops.soft_counts(*tensors, *settings, backend) for backend in ("native", "scipy"))
    assert native.dtype == plain.dtype == torch.float64
    torch.testing.assert_close(native, plain, rtol=1e-12, atol=1e-12)


@NATIVE
@pytest.mark.parametrize("in_px", [False, True])
@pytest.mark.parametrize("kind", ["uniform", "clustered", "integers", "grid_8px", "rotated_grid", "far_away"])
def test_back_ends_give_the_same_gradients(kind: str, in_px: bool) -> None:
    for seed in range(5):
        tensors = _tensors(kind, seed, 40, 1.3, 1e-3)
        native, plain = (_results(tensors, SATURATION, in_px, 1e3, backend) for backend in ("native", "scipy"))
        # where both views nearly agree on a link, a difference of 1e-16 moves its gradient by 1e-7
        for one, two in zip(native, plain, strict=True):
            torch.testing.assert_close(one, two, rtol=1e-6, atol=1e-6 * float(two.abs().max()))


@pytest.mark.parametrize("in_px", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_gradient_of_the_reference_is_that_of_autograd(kind: str, in_px: bool) -> None:
    for seed, temperature in ((0, 1.3), (1, 0.05), (2, 50.0)):
        points0, points1, *rest, _, kelvin = _tensors(kind, seed, 25, temperature, 1e-3)
        leaves = [tensor.clone().requires_grad_() for tensor in (points0, points1, kelvin)]
        counts = reference_soft.soft_counts(*leaves[:2], *rest, leaves[2], SATURATION, in_px, 1e3)
        expected = torch.autograd.grad(counts, leaves, _weights(counts))
        found = reference_soft.soft_counts_backward(
            points0, points1, *rest, kelvin, _weights(counts), SATURATION, in_px, 1e3
        )
        _assert_close(list(found), list(expected))
        assert all(bool(gradient.isfinite().all()) for gradient in found)


@pytest.mark.parametrize("backend", installed_backends())
@pytest.mark.parametrize("n", [1, 2])
def test_few_matches_and_none_have_defined_counts(backend: str, n: int) -> None:
    tensors = _tensors("uniform", 0, n, 1.0, 1e-3)
    counts, *gradients = _results(tensors, SATURATION, False, 1e3, backend)
    assert counts.tolist() == [[float(n > 1)] * 3] * n  # the only link is an edge whose dual edge has no end
    assert all(bool((gradient == 0).all()) for gradient in gradients)
    points, links = torch.empty(0, 2, dtype=torch.float64), torch.empty(0, 2, dtype=torch.int64)
    flags, ptr = torch.empty(0, dtype=torch.bool), torch.tensor([0])
    empty = (points, points, links, links, links, flags, flags, ptr, torch.tensor(1.0, dtype=torch.float64))
    counts, *gradients = _results(empty, SATURATION, True, 1e3, backend)
    assert counts.shape == (0, 3)
    assert [gradient.shape for gradient in gradients] == [(0, 2), (0, 2), ()]


@pytest.mark.parametrize("backend", installed_backends())
@pytest.mark.parametrize("in_px", [False, True])
def test_points_that_have_moved_together_give_no_nan(in_px: bool, backend: str) -> None:
    points0, points1, *rest = _tensors("uniform", 0, 12, 1.0, 1e-3)
    together = points1.clone()
    together[rest[0][0, 1]] = together[rest[0][0, 0]]  # the graphs are those of before
    results = _results((points0, together, *rest), SATURATION, in_px, 1e3, backend)
    assert all(bool(result.isfinite().all()) for result in results)


@pytest.mark.slow  # compiles for ten seconds
@pytest.mark.parametrize("backend", installed_backends())
@pytest.mark.parametrize("in_px", [False, True])
def test_operators_keep_the_rules_of_torch_and_compile(backend: str, in_px: bool) -> None:
    tensors = _tensors("uniform", 0, 20, 1.5, 1e-3)
    settings = (SATURATION, in_px, 1e3, backend)
    asked = [tensor.clone().requires_grad_() if k in (0, 1, 8) else tensor for k, tensor in enumerate(tensors)]
    torch.library.opcheck(torch.ops.tensor_stereo.soft_counts.default, (*asked, *settings))
    weights = torch.ones(20, 3, dtype=torch.float64)
    torch.library.opcheck(torch.ops.tensor_stereo.soft_counts_backward.default, (*tensors, weights, *settings))
    compiled = torch.compile(lambda: ops.soft_counts(*asked, *settings) * 2, fullgraph=True, backend="aot_eager")
    found, expected = compiled(), ops.soft_counts(*asked, *settings) * 2
    assert torch.equal(found, expected)
    leaves = [asked[k] for k in (0, 1, 8)]
    for one, two in zip(*(torch.autograd.grad(value.sum(), leaves) for value in (found, expected)), strict=True):
        assert torch.equal(one, two)


@pytest.mark.parametrize("backend", installed_backends())
def test_a_second_derivative_is_refused(backend: str) -> None:
    tensors = _tensors("uniform", 0, 12, 1.0, 1e-3)
    leaf = tensors[0].clone().requires_grad_()
    counts = ops.soft_counts(leaf, *tensors[1:], SATURATION, False, 1e3, backend)
    (gradient,) = torch.autograd.grad(counts.sum(), leaf, create_graph=True)
    with pytest.raises(NotImplementedError, match="twice"):
        gradient.sum().backward()
