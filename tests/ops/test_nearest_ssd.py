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
@pytest.mark.parametrize("kind", ["windows", "large", "offset", "tiny", "copies", "halves", "signed"])
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
        "signed": lambda v: (3300 * v).round() - 1650,  # products are exact, sums of squared differences are not
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


@pytest.mark.skipif("native" not in installed_backends(), reason="the native kernels are not installed")
@pytest.mark.parametrize("size", [3, 121, 1225, 2025])
def test_bytes_are_multiplied_exactly_also_in_large_windows(size: int) -> None:
    rng = torch.Generator().manual_seed(size)
    level = 78 if size > 200 else 250  # dark enough for sums that float32 holds
    vectors0 = (level + 4 * torch.rand(90, size, generator=rng)).round()
    vectors1 = torch.cat([vectors0[:50], (level + 4 * torch.rand(40, size, generator=rng)).round()])
    ptr = torch.tensor([0, 90])
    arguments = torch.zeros(90, 2), torch.zeros(90, 2), vectors0, vectors1, ptr, ptr, *OPEN
    found, expected = nearest_ssd(*arguments, "native"), nearest_ssd(*arguments, "scipy")
    assert all(map(torch.equal, found, expected))
    assert (found[0][:50] == 0).all()


@pytest.mark.parametrize("backend", installed_backends())
def test_gates_and_descriptors_that_mean_nothing_are_refused(backend: str) -> None:
    points, ptr = torch.zeros(2, 2), torch.tensor([0, 2])
    vectors = torch.ones(2, 3)
    with pytest.raises(ValueError, match="must not be NaN"):
        nearest_ssd(points, points, vectors, vectors, ptr, ptr, math.nan, 0.0, 1.0, backend)
    for wrong in (math.nan, math.inf, 1e30):
        with pytest.raises(ValueError, match="descriptors of features1 must be finite"):
            nearest_ssd(points, points, vectors, vectors * wrong, ptr, ptr, *OPEN, backend)


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
