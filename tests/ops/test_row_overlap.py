from __future__ import annotations

import pytest
import torch

from tensor_stereo.batching import lengths_to_ptr
from tensor_stereo.ops import reference, row_overlap
from tests.oracles import installed_backends


def _pattern(seed: int, num_rows: int, density: float) -> tuple[torch.Tensor, torch.Tensor]:
    dense = torch.rand(num_rows, num_rows, generator=torch.Generator().manual_seed(seed)) < density
    return lengths_to_ptr(dense.sum(1)), dense.nonzero()[:, 1]


@pytest.mark.parametrize("backend", installed_backends())
@pytest.mark.parametrize(("num_rows", "density"), [(0, 0.5), (1, 0.0), (1, 1.0), (70, 0.0), (70, 0.1), (70, 1.0)])
def test_every_back_end_equals_the_dense_product(backend: str, num_rows: int, density: float) -> None:
    one, two = _pattern(0, num_rows, density), _pattern(1, num_rows, 0.5)
    dense = []
    for crow, cols in (one, two):
        matrix = torch.zeros(num_rows, num_rows, dtype=torch.bool)
        matrix[torch.repeat_interleave(crow.diff()), cols] = True
        dense.append(matrix)
    overlap, degree0, degree1 = row_overlap(*one, *two, backend)
    assert torch.equal(overlap, (dense[0] & dense[1]).sum(1))
    assert torch.equal(degree0, dense[0].sum(1))
    assert torch.equal(degree1, dense[1].sum(1))
    assert all(
        torch.equal(a, b) for a, b in zip((overlap, degree0, degree1), reference.row_overlap(*one, *two), strict=True)
    )


@pytest.mark.parametrize("backend", installed_backends())
def test_operator_keeps_the_rules_of_torch_and_compiles(backend: str) -> None:
    one, two = _pattern(0, 20, 0.3), _pattern(1, 20, 0.5)
    torch.library.opcheck(torch.ops.tensor_stereo.row_overlap.default, (*one, *two, backend))
    compiled = torch.compile(lambda: row_overlap(*one, *two, backend)[0] + 1, fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(), row_overlap(*one, *two, backend)[0] + 1)


def test_a_broken_pattern_is_refused() -> None:
    if "native" not in installed_backends():
        pytest.skip("the native kernels are not installed")
    crow, cols = _pattern(0, 20, 0.3)
    with pytest.raises(ValueError, match="crow0"):
        row_overlap(crow.flip(0), cols, crow, cols, "native")
