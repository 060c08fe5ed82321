from __future__ import annotations

import pytest
import torch

from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.ops import agreeing_neighbors
from tensor_stereo.types import Matches
from tests.oracles import installed_backends, neighbor_sets

LIMITS = (1.0, 2.0, 0.2, 0.0)


def _given(lengths: tuple[int, ...], dtype: torch.dtype) -> tuple[Matches, tuple[torch.Tensor, ...]]:
    """Whole and half pixels, so that many differences are just at their limit."""
    generator = torch.Generator().manual_seed(len(lengths))
    left = (torch.rand(sum(lengths), 2, generator=generator) * 50).round().to(dtype)
    right = left - torch.randint(0, 6, left.shape, generator=generator).to(dtype) / 2
    matches = Matches(left, right, torch.tensor([0, *lengths]).cumsum(0))
    graphs = build_match_graphs(matches)
    return matches, tuple(x for view in graphs[:2] for x in (view.crow_indices, view.col_indices))


@pytest.mark.parametrize("backend", installed_backends())
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("lengths", [(), (0, 1), (40, 0, 70)])
@pytest.mark.parametrize("spread", [0.0, 0.0625])
def test_every_back_end_counts_sets_of_neighbors(
    backend: str, dtype: torch.dtype, lengths: tuple[int, ...], spread: float
) -> None:
    matches, graphs = _given(lengths, dtype)
    found = agreeing_neighbors(matches.keypoints0, matches.keypoints1, *graphs, *LIMITS[:3], spread, backend)
    views = [neighbor_sets(view) for view in build_match_graphs(matches)[:2]]
    left, right = (view.double().tolist() for view in (matches.keypoints0, matches.keypoints1))
    expected = []
    for i in range(matches.num_matches):
        count = 0
        for j in [*views[0][i], *views[1][i]]:
            row = abs((right[i][1] - left[i][1]) - (right[j][1] - left[j][1]))
            disparity = abs((left[i][0] - right[i][0]) - (left[j][0] - right[j][0]))
            way_x, way_y = (abs(left[i][k] - left[j][k]) for k in (0, 1))
            more = spread * (way_x + way_y)
            count += row <= 1 + more and disparity <= 2 + 0.2 * way_x + more
        expected.append(count)
    assert found.dtype == torch.int64
    assert found.tolist() == expected


@pytest.mark.parametrize("backend", installed_backends())
def test_operator_keeps_the_rules_of_torch_and_compiles(backend: str) -> None:
    matches, graphs = _given((30,), torch.float64)
    arguments = (matches.keypoints0, matches.keypoints1, *graphs, *LIMITS, backend)
    torch.library.opcheck(torch.ops.tensor_stereo.agreeing_neighbors.default, arguments)
    compiled = torch.compile(lambda: agreeing_neighbors(*arguments) + 1, fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(), agreeing_neighbors(*arguments) + 1)


def test_a_broken_pattern_is_refused() -> None:
    if "native" not in installed_backends():
        pytest.skip("the native kernels are not installed")
    matches, (crow, cols, *rest) = _given((20,), torch.float64)
    points = matches.keypoints0, matches.keypoints1
    for broken, name in (((crow.flip(0), cols), "crow0"), ((crow, cols + 1), "cols0")):
        with pytest.raises(ValueError, match=name):
            agreeing_neighbors(*points, *broken, *rest, *LIMITS, "native")
