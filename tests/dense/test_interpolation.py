from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import LinearNDInterpolator
from torch import Tensor

from tensor_stereo import Matches
from tensor_stereo.batching import collate_matches, split_matches
from tensor_stereo.dense import interpolation
from tensor_stereo.dense.interpolation import interpolate_disparity

SIZE = (23, 31)


def anchors(points: Tensor, disparity: Tensor) -> Matches:
    """One pair with given keypoints of view 0 and disparities."""
    return Matches(points, points - torch.stack([disparity, 0 * disparity], 1), torch.tensor([0, len(points)]))


def random_points(count: int, seed: int, *, whole: bool = False) -> Tensor:
    """Points in and around a map of :data:`SIZE`; distinct if whole."""
    generator = torch.Generator().manual_seed(seed)
    if whole:
        cell = torch.randperm(SIZE[0] * SIZE[1], generator=generator)[:count]
        return torch.stack([cell % SIZE[1], cell // SIZE[1]], 1).double()
    spread = torch.tensor([SIZE[1] + 8.0, SIZE[0] + 8.0])
    return (torch.rand(count, 2, generator=generator, dtype=torch.float64) * spread) - 4


def random_matches(count: int, seed: int, *, whole: bool = False) -> Matches:
    generator = torch.Generator().manual_seed(seed + 1)
    points = random_points(count, seed, whole=whole)
    return anchors(points, torch.rand(count, generator=generator, dtype=torch.float64) * 20)


def pixels() -> tuple[Tensor, Tensor]:
    """x and y of every pixel."""
    y, x = torch.meshgrid(*(torch.arange(side).double() for side in SIZE), indexing="ij")
    return x, y


@given(st.integers(3, 60), st.integers(0, 10**6), st.booleans(), st.tuples(*[st.floats(-2, 2)] * 3))
def test_plane_is_reproduced_inside_of_the_hull(
    count: int, seed: int, whole: bool, plane: tuple[float, float, float]
) -> None:
    points = random_points(count, seed, whole=whole)
    corners = torch.tensor([[0.0, 0.0], [SIZE[1] - 1, 0], [0, SIZE[0] - 1], [SIZE[1] - 1, SIZE[0] - 1]]).double()
    points = torch.cat([points, corners]).unique(dim=0)
    a, b, c = plane
    found = interpolate_disparity(anchors(points, a * points[:, 0] + b * points[:, 1] + c), SIZE)
    x, y = pixels()
    torch.testing.assert_close(found[0, 0], a * x + b * y + c, rtol=0, atol=1e-10)


@given(st.integers(1, 60), st.integers(0, 10**6))
def test_map_passes_through_anchors_on_pixels(count: int, seed: int) -> None:
    matches = random_matches(count, seed, whole=True)
    x, y = matches.keypoints0.long().unbind(1)
    assert torch.equal(interpolate_disparity(matches, SIZE)[0, 0, y, x], matches.disparity)


@given(st.integers(4, 80), st.integers(0, 10**6))
def test_inside_of_the_hull_it_agrees_with_scipy(count: int, seed: int) -> None:
    matches = random_matches(count, seed)
    x, y = (values.numpy() for values in pixels())
    expected = LinearNDInterpolator(matches.keypoints0.numpy(), matches.disparity.numpy())(x, y)
    inside = np.isfinite(expected)
    found = interpolate_disparity(matches, SIZE)[0, 0].numpy()
    np.testing.assert_allclose(found[inside], expected[inside], rtol=0, atol=1e-7)


@given(st.integers(1, 40), st.integers(0, 10**6), st.booleans())
def test_outside_of_the_hull_it_has_the_value_of_the_nearest_point(count: int, seed: int, whole: bool) -> None:
    matches = random_matches(count, seed, whole=whole)
    small = (matches.keypoints0 - 12) / 3 + 12  # the hull leaves most of the map outside
    found = interpolate_disparity(anchors(small, matches.disparity), SIZE)[0, 0]
    x, y = pixels()
    outside, expected = _nearest_on_hull(small.numpy(), matches.disparity.numpy(), torch.stack([x, y], -1).numpy())
    np.testing.assert_allclose(found.numpy()[outside], expected[outside], rtol=0, atol=1e-6)
    assert bool(found.isfinite().all())
    assert bool((found >= matches.disparity.min() - 1e-9).all())
    assert bool((found <= matches.disparity.max() + 1e-9).all())


def _nearest_on_hull(points: np.ndarray, values: np.ndarray, where: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels outside of the hull, and the value at the nearest place of all segments with the points on one side."""
    best, expected = np.full(where.shape[:2], np.inf), np.full(where.shape[:2], np.nan)
    outside = np.zeros(where.shape[:2], bool)
    if len(points) == 1:
        return ~outside, np.full(where.shape[:2], values[0])
    for i in range(len(points)):
        for j in range(len(points)):
            way = points[j] - points[i]
            turn = way[0] * (points - points[i])[:, 1] - way[1] * (points - points[i])[:, 0]
            between = ((points - points[i]) @ way > 0) & ((points - points[j]) @ way < 0) & (np.abs(turn) < 1e-9)
            if i == j or (turn < -1e-9).any() or between.any():
                continue
            beyond = way[0] * (where - points[i])[..., 1] - way[1] * (where - points[i])[..., 0] < -1e-6
            outside |= beyond | (len(points) == 2)
            share = ((where - points[i]) @ way / (way @ way)).clip(0, 1)
            distance = np.linalg.norm(points[i] + share[..., None] * way - where, axis=-1)
            better = distance < best - 1e-12
            best = np.where(better, distance, best)
            expected = np.where(better, values[i] + share * (values[j] - values[i]), expected)
    return outside, expected


@pytest.mark.parametrize("kind", ["ellipse", "path"])
@given(st.integers(2, 90), st.integers(0, 10**6), st.floats(0, 2 * math.pi))
def test_hulls_of_many_sides_give_the_value_of_the_nearest_one(kind: str, count: int, seed: int, angle: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    width, height = (2 + 14 * torch.rand(2, generator=generator, dtype=torch.float64)).tolist()
    if kind == "ellipse":
        turn = torch.arange(count).double() * (2 * math.pi / count) + angle
        points = torch.stack([15 + width * turn.cos(), 11 + height * turn.sin()], 1)
        sides = torch.stack([torch.arange(count), (torch.arange(count) + 1) % count], 1).numpy()
    else:
        way = torch.randint(-3, 4, (2,), generator=generator).double()
        way[0] += way.abs().sum() == 0
        place = torch.randperm(4 * count, generator=generator)[:count].sort().values
        points = torch.tensor([15.0, 11.0]) + (place[:, None] - 2 * count) / 8 * way  # exactly collinear
        sides = torch.stack([torch.arange(count - 1), torch.arange(1, count)], 1).numpy()
    value = torch.rand(count, generator=generator, dtype=torch.float64) * 20
    order = torch.randperm(count, generator=generator)
    found = interpolate_disparity(anchors(points[order], value[order]), SIZE)[0, 0].numpy()
    where = torch.stack(pixels(), -1).numpy()
    start, way = points.numpy()[sides[:, 0]], (points[sides[:, 1]] - points[sides[:, 0]]).numpy()
    gap = where[:, :, None] - start  # (H, W, K, 2)
    share = ((gap * way).sum(-1) / (way * way).sum(-1)).clip(0, 1)
    nearest = ((gap - share[..., None] * way) ** 2).sum(-1).argmin(-1)[..., None]
    share = np.take_along_axis(share, nearest, -1)[..., 0]
    low, high = (value.numpy()[sides[:, end]][nearest[..., 0]] for end in (0, 1))
    outside = (way[:, 0] * gap[..., 1] - way[:, 1] * gap[..., 0] < -1e-5).any(-1) | (kind == "path") | (count == 2)
    np.testing.assert_allclose(found[outside], (low + share * (high - low))[outside], rtol=0, atol=1e-5)


def test_collinear_anchors_are_a_line() -> None:
    points = torch.tensor([[2.0, 3.0], [6.0, 3.0], [4.0, 3.0]])
    found = interpolate_disparity(anchors(points, torch.tensor([1.0, 2.0, 5.0])), (5, 9))[0, 0]
    assert torch.equal(found, torch.tensor([1.0, 1.0, 1.0, 3.0, 5.0, 3.5, 2.0, 2.0, 2.0]).expand(5, 9))


def test_no_anchor_gives_nan_and_one_a_constant() -> None:
    one = anchors(torch.tensor([[-3.0, 100.0]]), torch.tensor([7.0]))
    assert torch.equal(interpolate_disparity(one, (4, 5)), torch.full((1, 1, 4, 5), 7.0))
    for none in (torch.tensor([False]), one.ptr[1:] > 1):
        assert bool(interpolate_disparity(one, (4, 5), inlier=none).isnan().all())
    empty = Matches(torch.zeros(0, 2), torch.zeros(0, 2), torch.tensor([0]))
    assert interpolate_disparity(empty, (4, 5)).shape == (0, 1, 4, 5)
    assert interpolate_disparity(empty, []) == []


@given(st.lists(st.integers(0, 30), min_size=1, max_size=5), st.integers(0, 10**6), st.booleans())
def test_batch_is_the_loop_over_pairs(counts: list[int], seed: int, whole: bool) -> None:
    batch = collate_matches([random_matches(count, seed + k, whole=whole) for k, count in enumerate(counts)])
    inlier = torch.rand(batch.num_matches, generator=torch.Generator().manual_seed(seed)) < 0.7
    sizes = [(5 + k, 31 - 2 * k) for k in range(len(counts))]
    found = interpolate_disparity(batch, sizes, inlier=inlier)
    same = interpolate_disparity(batch, SIZE, inlier=inlier)
    masks = inlier.split(counts)
    for k, (one, mask) in enumerate(zip(split_matches(batch), masks, strict=True)):
        alone = interpolate_disparity(one, sizes[k], inlier=mask)[0]
        assert found[k].shape == (1, *sizes[k])
        torch.testing.assert_close(found[k], alone, rtol=0, atol=0, equal_nan=True)
        torch.testing.assert_close(same[k, :, :5, :21], alone[:, :5, :21], rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("at_once", [1, 40, 700])
def test_number_of_pixels_at_once_changes_nothing(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    batch = collate_matches([random_matches(count, count) for count in (30, 0, 1, 2, 60)])
    sizes = [(23, 31), (4, 9), (17, 3), (1, 40), (12, 31)]
    for max_step_px in (None, 4):
        expected = interpolate_disparity(batch, sizes, max_step_px=max_step_px)
        with monkeypatch.context() as patch:
            patch.setattr(interpolation, "_AT_ONCE", at_once)
            found = interpolate_disparity(batch, sizes, max_step_px=max_step_px)
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)


@given(st.integers(2, 80), st.integers(0, 10**6), st.sampled_from([None, 6]))
def test_order_of_matches_changes_nothing(count: int, seed: int, max_step_px: float | None) -> None:
    matches = random_matches(count, seed, whole=True)  # with many co-circular points
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    mixed = anchors(matches.keypoints0[order], matches.disparity[order])
    one, other = (interpolate_disparity(given, SIZE, max_step_px=max_step_px) for given in (matches, mixed))
    assert torch.equal(one, other)


def test_of_coincident_anchors_score_then_cost_then_order_decides() -> None:
    points = torch.tensor([[0.0, 0.0], [-0.0, 0.0], [0.0, 0.0]])
    plain = anchors(points, torch.tensor([1.0, 2.0, 3.0]))
    costly = Matches(plain.keypoints0, plain.keypoints1, plain.ptr, torch.tensor([3.0, 1.0, 2.0]))
    score = torch.tensor([0.2, 0.6, 0.9])

    def value(matches: Matches, **options: Tensor) -> float:
        return float(interpolate_disparity(matches, (1, 1), **options))

    assert value(plain) == 1
    assert value(costly) == 2
    assert value(costly, inlier=torch.tensor([True, False, True])) == 3
    assert value(costly, score=score) == 3


def test_score_keeps_matches_from_its_threshold_on() -> None:
    matches = random_matches(50, 3)
    score = torch.rand(50, generator=torch.Generator().manual_seed(0))
    expected = interpolate_disparity(matches, SIZE, inlier=score >= 0.5)
    assert torch.equal(interpolate_disparity(matches, SIZE, score=score), expected)
    least = float(score.min())
    every = interpolate_disparity(matches, SIZE)
    assert torch.equal(interpolate_disparity(matches, SIZE, score=score, min_score=least), every)


@given(st.integers(2, 40), st.integers(0, 10**6))
def test_cut_triangles_have_the_disparity_of_a_corner_and_the_others_are_linear(count: int, seed: int) -> None:
    matches = random_matches(count, seed)
    linear = interpolate_disparity(matches, SIZE)
    every = interpolate_disparity(matches, SIZE, max_step_px=0)
    assert bool(torch.isin(every, matches.disparity).all())
    assert torch.equal(interpolate_disparity(matches, SIZE, max_step_px=20), linear)
    some = interpolate_disparity(matches, SIZE, max_step_px=6)
    assert bool(((some == linear) | (some == every)).all())


def test_pixels_of_a_cut_triangle_go_to_the_nearest_corner() -> None:
    points = torch.tensor([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [10.0, 10.0]])
    matches = anchors(points, torch.tensor([5.0, 9.0, 5.0, 9.0]))
    assert torch.equal(interpolate_disparity(matches, SIZE, max_step_px=4), interpolate_disparity(matches, SIZE))
    found = interpolate_disparity(matches, (11, 11), max_step_px=3.9)[0, 0]
    assert bool((found[:, :5] == 5).all())
    assert bool((found[:, 6:] == 9).all())


def test_pixels_on_the_sides_of_a_cut_triangle_are_its_own_however_they_round() -> None:
    generator = torch.Generator().manual_seed(0)
    pixel = torch.tensor([15.0, 11.0], dtype=torch.float64)
    pairs = []
    for angle in (torch.rand(200, generator=generator, dtype=torch.float64) * 2 * math.pi).tolist():
        way = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
        across = torch.tensor([-math.sin(angle), math.cos(angle)], dtype=torch.float64)
        before, behind = (1 + 3 * torch.rand(2, generator=generator, dtype=torch.float64)).tolist()
        points = pixel + torch.stack([-before * way, behind * way, across / 2])
        pairs.append(anchors(points, torch.tensor([1.0, 9.0, 20.0]).double()))
    maps = interpolate_disparity(collate_matches(pairs), SIZE, max_step_px=4)
    torch.testing.assert_close(maps[:, 0, 11, 15], torch.full((200,), 20.0).double())  # of the nearest corner


@pytest.mark.parametrize(("sign", "expected"), [(1, [0.0, 0.0, 2.0]), (-1, [0.5, 1.0, 1.5])])
def test_pixels_between_a_cut_triangle_and_another_go_to_the_later_one(sign: int, expected: list[float]) -> None:
    corners = torch.tensor([[0.0, -2.0], [0.0, 2.0], [-3.0, 0.0], [3.0, 0.0]])  # lower, upper, and one on each side
    points = corners * torch.tensor([sign, 1.0]) + torch.tensor([4.0, 3.0])
    found = interpolate_disparity(anchors(points, torch.tensor([0.0, 2.0, 1.0, 9.0])), (7, 9), max_step_px=4)
    assert found[0, 0, 2:5, 4].tolist() == expected


@given(st.integers(3, 30), st.integers(0, 10**6), st.sampled_from([1e-6, 1e-7, 1e-8, 1e-10, 1e-13]), st.booleans())
def test_anchors_hardly_off_the_pixels_are_neither_overshot_nor_without_gradient(
    count: int, seed: int, offset: float, together: bool
) -> None:
    generator = torch.Generator().manual_seed(seed)
    cell = torch.randint(0, 7, (count, 2), generator=generator)
    shift = torch.randn(1 if together else count, 2, generator=generator, dtype=torch.float64)
    points = (cell + offset * shift).requires_grad_()
    disparity = torch.rand(count, generator=generator, dtype=torch.float64) * 20
    matches = Matches(points, anchors(points.detach(), disparity).keypoints1, torch.tensor([0, count]))
    found = interpolate_disparity(matches, (9, 9))
    assert bool((found.detach() >= disparity.min() - 1e-12).all())
    assert bool((found.detach() <= disparity.max() + 1e-12).all())
    found.sum().backward()
    assert points.grad is not None
    assert bool(points.grad.isfinite().all())


@pytest.mark.parametrize("count", [1, 2, 9])
def test_gradients_with_respect_to_both_keypoints(count: int) -> None:
    points = torch.rand(count, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = points * torch.tensor([6.4, 5.4])
    matches = anchors(points, random_matches(count, 5).disparity)
    if count > 2:
        x, y = (values[:6, :7] for values in pixels())
        inside = LinearNDInterpolator(points.numpy(), np.zeros(count))(x, y)
        assert 10 <= np.isfinite(inside).sum() <= 32  # of 42 pixels

    def run(keypoints0: Tensor, keypoints1: Tensor) -> Tensor:
        return interpolate_disparity(Matches(keypoints0, keypoints1, matches.ptr), (6, 7))

    views = [view.clone().requires_grad_() for view in (matches.keypoints0, matches.keypoints1)]
    assert torch.autograd.gradcheck(run, views)


def test_gradients_are_finite_at_anchors_edges_and_lines() -> None:
    grid = torch.stack(torch.meshgrid(*[torch.arange(0.0, 9, 4)] * 2, indexing="ij"), -1).reshape(-1, 2)
    for points in (grid, grid[:3], grid[:1]):
        keypoints0 = points.clone().requires_grad_()
        disparity = torch.arange(len(points)).float().requires_grad_()
        keypoints1 = points - torch.stack([disparity, 0 * disparity], 1)
        ptr = torch.tensor([0, len(points)])
        interpolate_disparity(Matches(keypoints0, keypoints1, ptr), (11, 12)).sum().backward()
        assert keypoints0.grad is not None
        assert disparity.grad is not None
        assert bool(keypoints0.grad.isfinite().all())
        # The weights of a pixel sum to one.
        torch.testing.assert_close(disparity.grad.sum(), torch.tensor(132.0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_follows_the_keypoints(dtype: torch.dtype) -> None:
    matches = random_matches(20, 0)
    given = Matches(matches.keypoints0.to(dtype), matches.keypoints1.to(dtype), matches.ptr)
    found = interpolate_disparity(given, SIZE)
    assert found.dtype == dtype
    torch.testing.assert_close(found.double(), interpolate_disparity(matches, SIZE), rtol=0, atol=1e-3)


def test_sizes_may_be_integers_of_numpy() -> None:
    matches = random_matches(9, 0)
    height, width = np.array(SIZE)
    assert torch.equal(interpolate_disparity(matches, (height, width)), interpolate_disparity(matches, SIZE))
    assert torch.equal(interpolate_disparity(matches, [(height, width)])[0], interpolate_disparity(matches, SIZE)[0])


def test_errors_name_the_argument() -> None:
    matches = random_matches(4, 0)
    everything = torch.ones(4)
    for size in ((0, 5), (4.0, 5), (True, 5), (4, np.True_), 7, (4, 5, 6), [(4, 5), (4,)], [(4, 0)], [(4, True)]):
        with pytest.raises(ValueError, match="size must be"):
            interpolate_disparity(matches, size)  # type: ignore[call-overload]
    with pytest.raises(ValueError, match="one per pair"):
        interpolate_disparity(matches, [(4, 5), (4, 5)])
    with pytest.raises(ValueError, match="both"):
        interpolate_disparity(matches, SIZE, inlier=everything > 0, score=everything)
    with pytest.raises(ValueError, match="inlier must have shape"):
        interpolate_disparity(matches, SIZE, inlier=torch.ones(3, dtype=torch.bool))
    with pytest.raises(TypeError, match="inlier must be bool"):
        interpolate_disparity(matches, SIZE, inlier=everything)
    with pytest.raises(TypeError, match="score must be floating"):
        interpolate_disparity(matches, SIZE, score=everything.long())
    with pytest.raises(ValueError, match="score must not be NaN, got NaN in row 2"):
        interpolate_disparity(matches, SIZE, score=torch.tensor([1.0, 1.0, torch.nan, 1.0]))
    for options in ({}, {"inlier": everything > 0}):
        with pytest.raises(ValueError, match=r"min_score must be a number, and given only with score, got 0\.2"):
            interpolate_disparity(matches, SIZE, min_score=0.2, **options)
    with pytest.raises(ValueError, match="min_score must be a number, and given only with score, got nan"):
        interpolate_disparity(matches, SIZE, score=everything, min_score=math.nan)
    with pytest.raises(ValueError, match="max_step_px must be at least 0 px, got -1"):
        interpolate_disparity(matches, SIZE, max_step_px=-1)
    costly = Matches(matches.keypoints0, matches.keypoints1, matches.ptr, torch.tensor([1.0, torch.nan, 1.0, 1.0]))
    with pytest.raises(ValueError, match="cost must not be NaN, got NaN in row 1"):
        interpolate_disparity(costly, SIZE)
    broken = matches.keypoints1.clone()
    broken[3, 0] = torch.inf
    with pytest.raises(ValueError, match="keypoints1 must be finite where matches are kept, got no disparity in row 3"):
        interpolate_disparity(Matches(matches.keypoints0, broken, matches.ptr), SIZE)
