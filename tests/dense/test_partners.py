"""Partners of keypoints in disparity maps, against a plain loop and against scenes whose truth is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tensor_stereo import DelaunayFilter, Matches, sample_disparity
from tensor_stereo.batching import collate_matches, lengths_to_ptr, split

VALUES = [math.nan, math.inf, -math.inf, -1.0, -0.0, 0.0, 0.5, 1.0, 1.25, 2.0, 7.0, 100.0]


def loop(disparity: Tensor, keypoints: Tensor, disparity1: Tensor | None) -> list[tuple[float, ...]]:
    """(row, x0, y0, x1, y1, cost) of every match of one pair, said once more with Python numbers."""
    height, width = disparity.shape

    def at(values: Tensor, x: float, y: float) -> float:
        return values[min(max(round(y), 0), height - 1), min(max(round(x), 0), width - 1)].item()

    found = []
    for row, (x, y) in enumerate(keypoints.tolist()):
        d = at(disparity, x, y)
        if not 0 <= d < math.inf or not 0 <= x - d <= width - 1:
            continue
        cost = 0.0
        if disparity1 is not None:
            d1 = at(disparity1, x - d, y)
            cost = min(abs(d - d1), width) if 0 <= d1 < math.inf else width
        found.append((cost, -d, row, x, y, x - d))
    kept, taken = [], set()
    for cost, _, row, x, y, x1 in sorted(found):
        if taken.isdisjoint([(0, x, y), (1, x1, y)]):
            taken |= {(0, x, y), (1, x1, y)}
            kept.append((row, x, y, x1, y, cost))
    return sorted(kept)


def batch_of(
    seed: int, sizes: list[tuple[int, int, int]], grid: float
) -> tuple[list[Tensor], list[Tensor], Tensor, Tensor]:
    """Maps of both views, keypoints and their offsets; few distinct disparities, so that partners coincide."""
    rng = np.random.default_rng(seed)
    maps, maps1 = ([torch.from_numpy(rng.choice(VALUES, (h, w))) for h, w, _ in sizes] for _ in range(2))
    keypoints = [
        torch.from_numpy(rng.integers(0, [round(w / grid), round(h / grid)], (n, 2)) * grid) for h, w, n in sizes
    ]
    empty = torch.zeros(0, 2, dtype=torch.float64)
    ptr = lengths_to_ptr(torch.tensor([len(points) for points in keypoints], dtype=torch.int64))
    return maps, maps1, torch.cat([empty, *keypoints]), ptr


sizes_of_pairs = st.lists(st.tuples(st.integers(1, 6), st.integers(1, 9), st.integers(0, 12)), max_size=4)


@settings(max_examples=200)
@given(st.integers(0, 2**32 - 1), sizes_of_pairs, st.sampled_from([1.0, 0.25]), st.booleans())
def test_matches_are_those_of_a_plain_loop(
    seed: int, sizes: list[tuple[int, int, int]], grid: float, both: bool
) -> None:
    maps, maps1, keypoints, ptr = batch_of(seed, sizes, grid)
    matches = sample_disparity(maps, keypoints, ptr, disparity1=maps1 if both else None)
    assert (matches.cost is not None) == both
    points = split(keypoints, ptr)
    expected = [loop(maps[b], points[b], maps1[b] if both else None) for b in range(len(sizes))]
    assert matches.ptr.diff().tolist() == [len(one) for one in expected]
    rows = torch.cat([matches.keypoints0, matches.keypoints1], 1).tolist()
    assert rows == [list(match[1:5]) for one in expected for match in one]
    if both:
        assert matches.cost.tolist() == [match[5] for one in expected for match in one]


@given(st.integers(0, 2**32 - 1), sizes_of_pairs.filter(len))
def test_a_batch_is_the_loop_over_its_pairs(seed: int, sizes: list[tuple[int, int, int]]) -> None:
    maps, maps1, keypoints, ptr = batch_of(seed, sizes, 0.5)
    batch = sample_disparity(maps, keypoints, ptr, disparity1=maps1)
    pairs = zip(maps, split(keypoints, ptr), maps1, strict=True)
    alone = collate_matches([sample_disparity(d, points, disparity1=d1) for d, points, d1 in pairs])
    for name in ("keypoints0", "keypoints1", "ptr", "cost"):
        assert torch.equal(getattr(batch, name), getattr(alone, name)), name


def test_maps_of_one_size_may_be_stacked() -> None:
    maps, maps1, keypoints, ptr = batch_of(3, [(5, 8, 20), (5, 8, 0), (5, 8, 9)], 1.0)
    stacked, stacked1 = torch.stack(maps), torch.stack(maps1)
    expected = sample_disparity(maps, keypoints, ptr, disparity1=maps1)
    for found in (
        sample_disparity(stacked, keypoints, ptr, disparity1=stacked1),
        sample_disparity(stacked[:, None], keypoints, ptr, disparity1=stacked1[:, None]),
        sample_disparity(stacked, keypoints, ptr, disparity1=maps1),
    ):
        assert torch.equal(found.keypoints1, expected.keypoints1)
        assert torch.equal(found.cost, expected.cost)


def two_planes(width: int = 60, near: float = 20.0, far: float = 5.0) -> tuple[Tensor, Tensor, Tensor]:
    """Maps of both views of a near square before a far plane, and where view 0 sees what view 1 does not."""
    disparity, disparity1 = torch.full((2, 30, width), far)
    disparity[10:20, 30:40] = near
    disparity1[10:20, 10:20] = near
    occluded = torch.zeros(30, width, dtype=torch.bool)
    occluded[10:20, 15:25] = True  # far points whose partners lie behind the square: 15 - 5 = 10 to 24 - 5 = 19
    return disparity, disparity1, occluded


def grid_of(disparity: Tensor) -> Tensor:
    height, width = disparity.shape
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([x, y], -1).reshape(-1, 2).to(disparity)


def test_the_cost_marks_occluded_points_and_the_visible_one_stays() -> None:
    disparity, disparity1, occluded = two_planes()
    keypoints = grid_of(disparity)
    hidden = keypoints[occluded.flatten()]
    alone = sample_disparity(disparity, hidden, disparity1=disparity1)
    assert alone.num_matches == len(hidden)
    assert (alone.cost == 15).all()
    visible = keypoints[~occluded.flatten()]
    seen = sample_disparity(disparity, visible, disparity1=disparity1)
    assert (seen.cost == 0).all()
    for other in (disparity1, None):  # without a cost the nearest surface stays
        everything = sample_disparity(disparity, keypoints, disparity1=other)
        assert torch.equal(everything.keypoints0, seen.keypoints0)
        assert torch.equal(everything.keypoints1, seen.keypoints1)


@given(st.sampled_from([0, 1, 3.5, 20]), st.booleans())
def test_one_constant_shifts_all_keypoints_that_stay_inside(value: float, both: bool) -> None:
    disparity = torch.full((6, 30), float(value))
    keypoints = grid_of(disparity) + 0.25
    keypoints[:, 0] -= 0.5  # some lie left of the outermost pixel centres
    matches = sample_disparity(disparity, keypoints, disparity1=disparity if both else None)
    x1 = keypoints[:, 0] - value
    assert torch.equal(matches.keypoints0, keypoints[(x1 >= 0) & (x1 <= 29)])
    assert torch.equal(matches.disparity, torch.full_like(matches.disparity, value))
    assert torch.equal(matches.keypoints0[:, 1], matches.keypoints1[:, 1])
    assert not both or (matches.cost == 0).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_matches_are_what_a_filter_takes(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    keypoints = torch.rand(300, 2, generator=generator, dtype=dtype) * torch.tensor([199.0, 99.0], dtype=dtype)
    disparity = torch.full((100, 200), 9.0)
    wrong = torch.rand(100, 200, generator=generator) < 0.2
    disparity[wrong] = 60 * torch.rand(int(wrong.sum()), generator=generator)
    matches = sample_disparity(disparity, keypoints)
    assert matches.keypoints1.dtype == dtype
    output = DelaunayFilter()(matches)
    right = matches.disparity.sub(9).abs() < 1
    assert output.inlier[right].float().mean() > 0.9
    assert output.inlier[~right].float().mean() < 0.1


def test_nothing_in_gives_nothing_out() -> None:
    none = torch.zeros(0, 2)
    for matches in (
        sample_disparity(torch.zeros(4, 5), none),
        sample_disparity(torch.full((4, 5), torch.nan), torch.ones(3, 2), disparity1=torch.zeros(4, 5)),
        sample_disparity(torch.zeros(0, 0), none, disparity1=torch.zeros(0, 0)),
        sample_disparity([], none, torch.tensor([0]), disparity1=[]),
        sample_disparity(torch.zeros(2, 4, 5), none, torch.tensor([0, 0, 0])),
    ):
        assert isinstance(matches, Matches)
        assert matches.num_matches == 0


def test_matches_are_constants() -> None:
    disparity = torch.full((4, 9), 2.0, requires_grad=True)
    keypoints = torch.tensor([[5.0, 1.0]], requires_grad=True)
    matches = sample_disparity(disparity, keypoints, disparity1=disparity)
    assert not any(t.requires_grad for t in (matches.keypoints0, matches.keypoints1, matches.cost))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"disparity": torch.zeros(2, 4, 5)}, "ptr must be given for disparity of 2 pairs"),
        ({"disparity": torch.zeros(5)}, r"disparity must have shape \(H, W\), .* got \(5,\)"),
        ({"disparity": torch.zeros(1, 2, 4, 5)}, "disparity must have shape"),
        ({"disparity": [torch.zeros(1, 4, 5)]}, r"disparity\[0\] must have shape \(H, W\), got \(1, 4, 5\)"),
        ({"disparity": torch.zeros(2, 4, 5), "ptr": torch.tensor([0, 1])}, "disparity must hold one map per pair"),
        ({"disparity1": [torch.zeros(4, 5)] * 2}, r"disparity1 must hold one map per pair \(1\), got 2"),
        ({"disparity1": torch.zeros(4, 6)}, r"disparity1 must have the size of disparity in every pair, got \(4, 6\)"),
        ({"keypoints": torch.zeros(1, 3)}, r"keypoints must have shape \(N, 2\)"),
        ({"keypoints": torch.full((1, 2), 9.0)}, "keypoints must lie in their image"),
        ({"keypoints": torch.full((1, 2), math.nan)}, "keypoints must lie in their image"),
        ({"ptr": torch.tensor([0, 2])}, "ptr must rise from 0 to the number of rows 1"),
        ({"disparity": torch.zeros(4, 5, dtype=torch.int16)}, r"disparity\[0\] must be float32 or float64 pixels"),
        ({"disparity": np.zeros((4, 5))}, "disparity must be a torch.Tensor, got ndarray"),
        ({"disparity1": torch.zeros(4, 5).half()}, r"disparity1\[0\] must be float32 or float64"),
        ({"keypoints": torch.zeros(1, 2).half()}, "keypoints must be float32 or float64"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_named(arguments: dict[str, object], words: str) -> None:
    good: dict[str, object] = {
        "disparity": torch.zeros(4, 5),
        "keypoints": torch.ones(1, 2),
        "ptr": None,
        "disparity1": None,
    }
    given = good | arguments
    with pytest.raises((ValueError, TypeError), match=words):
        sample_disparity(given["disparity"], given["keypoints"], given["ptr"], disparity1=given["disparity1"])  # type: ignore[arg-type]
