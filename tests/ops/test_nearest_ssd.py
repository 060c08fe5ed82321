from __future__ import annotations

import math

import pytest
import torch

from tensor_stereo.ops import nearest_ssd
from tensor_stereo.ops.reference_ssd import ssd
from tests.oracles import installed_backends

GATES = [(1.0, 0.0, 64.0), (0.0, -math.inf, math.inf), (math.inf, 0.0, 20.0), (2.5, -5.0, 5.0), (3.0, 8.0, math.inf)]
OPEN = (math.inf, -math.inf, math.inf)


def _views(seed: int, size: int, whole: bool) -> tuple[torch.Tensor, ...]:
    rng = torch.Generator().manual_seed(seed)
    tensors = []
    for lengths in ((90, 0, 40, 1), (70, 5, 60, 0)):
        ptr = torch.tensor([0, *lengths]).cumsum(0)
        points = torch.rand(int(ptr[-1]), 2, generator=rng) * 60
        vectors = torch.rand(int(ptr[-1]), size, generator=rng)
        if whole:
            points, vectors = points.round(), (vectors * 3).round()  # many ties
        tensors.append((points, vectors, ptr))
    (points0, vectors0, ptr0), (points1, vectors1, ptr1) = tensors
    return points0, points1, vectors0, vectors1, ptr0, ptr1


@pytest.mark.skipif("native" not in installed_backends(), reason="the native kernels are not installed")
@pytest.mark.parametrize("gate", [*GATES, OPEN])
@pytest.mark.parametrize(
    ("size", "whole"), [(121, False), (121, True), (1, True), (3, True), (16, False), (64, False), (0, False)]
)
def test_kernel_equals_the_reference_bit_for_bit(gate: tuple[float, float, float], size: int, whole: bool) -> None:
    arguments = *_views(size, size, whole), *gate
    for native, torch_result in zip(nearest_ssd(*arguments, "native"), nearest_ssd(*arguments, "scipy"), strict=True):
        assert torch.equal(native, torch_result)


@pytest.mark.skipif("native" not in installed_backends(), reason="the native kernels are not installed")
@pytest.mark.parametrize("kind", ["windows", "large", "offset", "tiny", "copies", "halves"])
def test_dense_kernel_equals_the_reference_whatever_the_descriptors(kind: str) -> None:
    rng = torch.Generator().manual_seed(3)
    lengths, size = ((301, 130), (257, 190)), 121
    vectors = [torch.rand(sum(n), size, generator=rng) for n in lengths]
    change = {
        "windows": lambda v: (v * 255).round(),
        "large": lambda v: (v * 2**20).round(),  # whole, and beyond what float32 sums hold
        "offset": lambda v: 1000 + v,  # products say little about the sums
        "tiny": lambda v: v * 1e-22,  # squares underflow
        "copies": lambda v: v[torch.randint(20, (len(v),), generator=rng)],
        "halves": lambda v: (v * 8).round() / 2,
    }[kind]
    vectors0, vectors1 = map(change, vectors)
    if kind == "copies":
        vectors1[:60] = vectors0[:60]
    ptrs = [torch.tensor([0, *n]).cumsum(0) for n in lengths]
    points = [torch.full((len(v), 2), math.nan) for v in vectors]  # nobody looks at them
    arguments = *points, vectors0, vectors1, *ptrs, *OPEN
    threads = torch.get_num_threads()
    expected = nearest_ssd(*arguments, "scipy")
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        found = nearest_ssd(*arguments, "native")
        torch.set_num_threads(threads)
        assert all(map(torch.equal, found, expected))


def test_order_of_summation_is_exact_for_whole_numbers_and_close_otherwise() -> None:
    rng = torch.Generator().manual_seed(0)
    a, b = (torch.rand(50, 121, generator=rng) * 255 for _ in range(2))
    rows = torch.arange(50)
    exact = (a.round().double() - b.round().double()).square().sum(1)
    assert torch.equal(ssd(a.round(), b.round(), rows, rows).double(), exact)
    # 8 additions in a lane, 4 to join the lanes, 2 roundings in each term.
    error = (ssd(a, b, rows, rows).double() / (a.double() - b.double()).square().sum(1) - 1).abs()
    assert error.max() < 14 * torch.finfo(torch.float32).eps


@pytest.mark.parametrize("backend", installed_backends())
def test_operator_keeps_the_rules_of_torch_and_compiles(backend: str) -> None:
    arguments = *_views(0, 5, True), 1.0, 0.0, 64.0, backend
    torch.library.opcheck(torch.ops.tensor_stereo.nearest_ssd.default, arguments)
    compiled = torch.compile(lambda: nearest_ssd(*arguments)[1] + 1, fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(), nearest_ssd(*arguments)[1] + 1)
