from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from tensor_stereo import matching
from tensor_stereo.batching import concatenate_features
from tensor_stereo.configs import MatchingConfig, PipelineConfig
from tensor_stereo.matching import MatchIndices
from tensor_stereo.ops import reference_ssd
from tensor_stereo.types import Features, Matches

WIDE = {"max_row_offset_px": 1e6}  # a gate that lets everything through: the ragged search instead of the dense one


def match_indices(features0: Features, features1: Features, config: MatchingConfig | None = None) -> MatchIndices:
    return matching.match_indices(features0, features1, PipelineConfig(matching=config or MatchingConfig()))


def match_features(features0: Features, features1: Features, config: MatchingConfig | None = None) -> Matches:
    return matching.match_features(features0, features1, PipelineConfig(matching=config or MatchingConfig()))


def make_features(
    generator: np.random.Generator,
    counts: list[int],
    *,
    size: int = 4,
    levels: int = 3,
    grid: float = 1.0,
    side: int = 8,
) -> Features:
    """Random features of several images; few levels make equal costs, ``grid`` sets how fine the coordinates are."""
    total = sum(counts)
    keypoints = generator.integers(0, round(side / grid), (total, 2)) * grid
    descriptors = generator.integers(0, levels, (total, size)) if levels else generator.normal(size=(total, size))
    ptr = torch.tensor([0, *np.cumsum(counts)], dtype=torch.int64)
    return Features(torch.from_numpy(keypoints).float(), ptr, torch.from_numpy(descriptors).float(), torch.zeros(total))


def is_inside(points0: np.ndarray, points1: np.ndarray, config: MatchingConfig) -> np.ndarray:
    """(N0, N1) bool: which pairs pass the gates."""
    disparity, offset = points0[:, None, 0] - points1[:, 0], np.abs(points0[:, None, 1] - points1[:, 1])
    inside = np.ones_like(disparity, dtype=bool)
    if config.max_row_offset_px is not None:
        inside &= offset <= config.max_row_offset_px
    if config.min_disparity_px is not None:
        inside &= disparity >= config.min_disparity_px
    if config.max_disparity_px is not None:
        inside &= disparity <= config.max_disparity_px
    return inside


def brute_force(features0: Features, features1: Features, config: MatchingConfig) -> list[tuple[int, int, float]]:
    """The five steps of the definition, one keypoint at a time, in float64."""
    matches = []
    for b in range(features0.num_images):
        (i0, i1), (j0, j1) = (map(int, f.ptr[b : b + 2]) for f in (features0, features1))
        points0, points1 = features0.keypoints.double().numpy()[i0:i1], features1.keypoints.double().numpy()[j0:j1]
        difference = features0.descriptors.double().numpy()[i0:i1, None] - features1.descriptors.double().numpy()[j0:j1]
        cost = (difference**2).sum(2)
        cost[~is_inside(points0, points1, config)] = math.inf
        chosen = {}
        for i, row in enumerate(cost):
            ranked = sorted((c, j) for j, c in enumerate(row) if c < math.inf)
            if not ranked:
                continue
            if config.max_ratio is not None and (
                len(ranked) < 2 or ranked[1][0] == 0 or ranked[0][0] > config.max_ratio**2 * ranked[1][0]
            ):
                continue
            if config.mutual and int(cost[:, ranked[0][1]].argmin()) != i:
                continue
            chosen[i] = ranked[0]
        for i, (c, j) in chosen.items():
            if min((d, k) for k, (d, m) in chosen.items() if m == j) == (c, i):
                matches.append((i0 + i, j0 + j, c))
    return matches


def rows(found: MatchIndices) -> list[tuple[int, int, float]]:
    return list(zip(found.index0.tolist(), found.index1.tolist(), found.cost.tolist(), strict=True))


def same(a: MatchIndices, b: MatchIndices) -> bool:
    return all(map(torch.equal, a, b))


configs = st.builds(
    MatchingConfig,
    max_ratio=st.sampled_from([None, 0.5, 0.8, 1.0]),
    mutual=st.booleans(),
    max_row_offset_px=st.sampled_from([None, 0, 0.25, 1, 1.5, 2.75, 40, math.inf]),
    min_disparity_px=st.sampled_from([None, -2, 0, 0.5, -math.inf]),
    max_disparity_px=st.sampled_from([None, 0.5, 1, 3.75, 40, math.inf]),
)


@settings(max_examples=200)
@given(
    counts=st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), max_size=4),
    config=configs,
    grid=st.sampled_from([1.0, 0.25]),
    seed=st.integers(0, 2**32 - 1),
)
@example(counts=[], config=MatchingConfig(), grid=1.0, seed=0)
def test_matches_are_those_of_the_definition(
    counts: list[tuple[int, int]], config: MatchingConfig, grid: float, seed: int
) -> None:
    generator = np.random.default_rng(seed)
    views = [make_features(generator, [pair[v] for pair in counts], grid=grid) for v in (0, 1)]
    found = match_indices(*views, config)
    assert rows(found) == brute_force(*views, config)
    owner = torch.searchsorted(views[0].ptr, found.index0, right=True) - 1
    assert found.ptr.tolist() == [int((owner < b).sum()) for b in range(len(counts) + 1)]
    assert found.cost.dtype == torch.float32


@pytest.mark.parametrize("ratio", [None, 0.99])
@pytest.mark.parametrize("mutual", [False, True])
@pytest.mark.parametrize(("levels", "size"), [(6, 3), (256, 121), (256, 900), (5000, 64), (0, 128), (0, 1)])
def test_dense_search_equals_the_gated_one_bit_for_bit(
    levels: int, size: int, mutual: bool, ratio: float | None
) -> None:
    generator = np.random.default_rng(5)
    views = [make_features(generator, [70, 0, 33], size=size, levels=levels) for _ in range(2)]
    config = MatchingConfig(max_ratio=ratio, mutual=mutual)
    dense, gated = match_indices(*views, config), match_indices(*views, replace(config, **WIDE))
    assert len(dense.index0) > 5
    assert same(dense, gated)


@pytest.mark.parametrize("mutual", [False, True])
def test_near_ties_beyond_single_precision_are_settled_by_cost_and_index(mutual: bool) -> None:
    generator = np.random.default_rng(6)
    base = make_features(generator, [40], size=64, levels=0)
    noise = torch.from_numpy(generator.normal(size=(5, 40, 64)) * 1e-7).float()
    near = (base.descriptors + noise).flatten(0, 1)  # 5 copies of each, apart by a few roundings
    crowd = Features(torch.zeros(200, 2), torch.tensor([0, 200]), near, torch.zeros(200))
    config = MatchingConfig(mutual=mutual)
    for views in ((base, crowd), (crowd, base), (crowd, crowd)):
        assert same(match_indices(*views, config), match_indices(*views, replace(config, **WIDE)))


def test_tiny_and_large_descriptors_obey_the_same_definition() -> None:
    generator = np.random.default_rng(7)
    for scale in (1e-30, 1e-20, 1e12):
        views = [make_features(generator, [20], levels=0) for _ in range(2)]
        views = [replace(view, descriptors=view.descriptors * scale) for view in views]
        assert same(match_indices(*views), match_indices(*views, MatchingConfig(**WIDE)))


def make_windows(seed: int, count: int = 80) -> tuple[Features, np.ndarray]:
    generator = np.random.default_rng(seed)
    features = make_features(generator, [count], size=121, levels=256, side=100)
    return features, features.descriptors.numpy()


def test_nearest_neighbours_are_those_of_opencv() -> None:
    (features0, windows0), (features1, windows1) = make_windows(0), make_windows(1, 60)
    pairs = [(m.queryIdx, m.trainIdx) for m in cv2.BFMatcher(cv2.NORM_L2SQR, crossCheck=True).match(windows0, windows1)]
    found = match_indices(features0, features1, MatchingConfig(mutual=True))
    assert list(zip(found.index0.tolist(), found.index1.tolist(), strict=True)) == sorted(pairs)
    expected = {m.queryIdx: (m.trainIdx, m.distance) for m in cv2.BFMatcher(cv2.NORM_L2SQR).match(windows0, windows1)}
    for i, j, cost in rows(match_indices(features0, features1)):
        assert expected[i] == (j, cost)


def test_ratio_test_is_that_of_opencv_neighbours() -> None:
    (features0, windows0), (features1, windows1) = make_windows(2), make_windows(3)
    two = cv2.BFMatcher(cv2.NORM_L2).knnMatch(windows0, windows1, k=2)
    expected = {a.queryIdx for a, b in two if a.distance <= 0.95 * b.distance}
    found = match_indices(features0, features1, MatchingConfig(max_ratio=0.95))
    lost = expected - set(found.index0.tolist())
    assert set(found.index0.tolist()) <= expected
    assert {two[i][0].trainIdx for i in lost} <= set(
        found.index1.tolist()
    )  # lost to a cheaper match of the same partner
    assert 5 < len(found.index0) < len(windows0)


def scalar_features(values: list[float], points: list[tuple[float, float]] | None = None) -> Features:
    keypoints = torch.zeros(len(values), 2) if points is None else torch.tensor(points)
    ptr = torch.tensor([0, len(values)])
    return Features(keypoints, ptr, torch.tensor(values)[:, None], torch.zeros(len(values)))


@pytest.mark.parametrize("gate", [{}, WIDE])
@pytest.mark.parametrize(
    ("values1", "ratio", "kept"),
    [
        ([4.0, 5.0], 0.8, True),  # the bound itself passes
        ([4.0, 5.0], 0.79, False),
        ([4.0, 4.0], 1.0, True),
        ([0.0, 0.0], 1.0, False),  # no distance to compare
        ([0.0, 1.0], 0.1, True),
        ([4.0], 0.8, False),  # no second candidate
    ],
)
def test_ratio_is_of_distances(gate: dict[str, float], values1: list[float], ratio: float, kept: bool) -> None:
    found = match_indices(scalar_features([0.0]), scalar_features(values1), MatchingConfig(max_ratio=ratio, **gate))
    assert (len(found.index0) == 1) is kept


def test_second_best_is_sought_inside_the_gate() -> None:
    view0 = scalar_features([0.0], [(9.0, 5.0)])
    view1 = scalar_features([4.0, 4.5, 9.0], [(5.0, 5.0), (5.0, 8.0), (6.0, 5.0)])
    assert len(match_indices(view0, view1, MatchingConfig(max_ratio=0.8)).index0) == 0
    assert len(match_indices(view0, view1, MatchingConfig(max_ratio=0.8, max_row_offset_px=1)).index0) == 1


@pytest.mark.parametrize(
    ("config", "inside"),
    [
        (MatchingConfig(max_row_offset_px=1), [(0, 1), (0, -1), (50, 0)]),
        (MatchingConfig(min_disparity_px=2), [(2, 0), (2.25, 90)]),
        (MatchingConfig(max_disparity_px=2), [(2, 0), (-70, 90)]),
        (MatchingConfig(min_disparity_px=2, max_disparity_px=2, max_row_offset_px=0), [(2, 0)]),
    ],
)
def test_bounds_of_gates_are_inside(config: MatchingConfig, inside: list[tuple[float, float]]) -> None:
    outside = {
        "max_row_offset_px": [(0, 1.0000001), (0, -1.25)],
        "min_disparity_px": [(1.9999, 0)],
        "max_disparity_px": [(2.0001, 0)],
    }
    for disparity, row in inside:
        views = scalar_features([0.0], [(10.0, 20.0)]), scalar_features([0.0], [(10.0 - disparity, 20.0 + row)])
        assert len(match_indices(*views, config).index0) == 1
    for name, offsets in outside.items():
        for disparity, row in offsets if getattr(config, name) is not None else []:
            point = torch.tensor([[10.0 - disparity, 20.0 + row]], dtype=torch.float64)
            views = scalar_features([0.0], [(10.0, 20.0)]), replace(scalar_features([0.0]), keypoints=point)
            assert len(match_indices(*views, config).index0) == 0


@settings(max_examples=100)
@given(config=configs, grid=st.sampled_from([1.0, 0.25, 0.1]), seed=st.integers(0, 2**16))
def test_candidates_are_the_pairs_inside_the_gates(config: MatchingConfig, grid: float, seed: int) -> None:
    generator = np.random.default_rng(seed)
    views = [make_features(generator, [6, 0, 9], grid=grid) for _ in range(2)]
    index0, index1 = (
        torch.cat(rows).numpy() for rows in zip(*reference_ssd.gated_candidates(*views, config), strict=True)
    )
    points0, points1 = (view.keypoints.double().numpy() for view in views)
    image = np.arange(15) >= 6
    expected = is_inside(points0, points1, config) & (image[:, None] == image)
    listed = np.zeros_like(expected)
    listed[index0, index1] = True
    assert np.array_equal(listed, expected)
    assert len(index0) == expected.sum()
    assert (np.diff(index0) >= 0).all()


def test_memory_limits_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = np.random.default_rng(8)
    views = [make_features(generator, [30, 0, 25], size=5, levels=levels) for levels in (4, 4)]
    real = [make_features(generator, [30, 0, 25], size=5, levels=0) for _ in range(2)]
    cases = [
        (pair, MatchingConfig(max_ratio=ratio, mutual=mutual, **gate))
        for pair in (views, real)
        for ratio in (None, 0.9)
        for mutual in (False, True)
        for gate in ({}, {"max_row_offset_px": 2.0, "min_disparity_px": 0.0})
    ]
    expected = [match_indices(*pair, config) for pair, config in cases]
    monkeypatch.setattr(reference_ssd, "_CHUNK_DENSE", 64)
    monkeypatch.setattr(reference_ssd, "_CHUNK_VALUES", 7)
    monkeypatch.setattr(reference_ssd, "_CHUNK_CANDIDATES", 11)
    monkeypatch.setenv("TENSOR_STEREO_BACKEND", "scipy")
    blocks = list(reference_ssd.gated_candidates(*views, MatchingConfig(max_row_offset_px=2)))
    assert len(blocks) > 5
    assert max(len(index0) for index0, _ in blocks) <= 11 + 30
    assert all(same(match_indices(*pair, config), e) for (pair, config), e in zip(cases, expected, strict=True))


@pytest.mark.parametrize("levels", [3, 256, 0])
@pytest.mark.parametrize("gate", [{}, {"max_row_offset_px": 1.0, "min_disparity_px": 0.0, "max_disparity_px": 6.0}])
def test_batch_equals_loop_bit_for_bit(gate: dict[str, float], levels: int) -> None:
    generator = np.random.default_rng(9)
    counts = [(40, 35), (0, 5), (7, 0), (0, 0), (1, 1), (50, 60)]
    pairs = [[make_features(generator, [n], size=33, levels=levels) for n in pair] for pair in counts]
    config = MatchingConfig(**gate)
    batch = match_features(*(concatenate_features(view) for view in zip(*pairs, strict=True)), config)
    assert batch.num_matches > 10
    for b, pair in enumerate(pairs):
        alone = match_features(*pair, config)
        part = slice(int(batch.ptr[b]), int(batch.ptr[b + 1]))
        for name in ("keypoints0", "keypoints1", "cost"):
            assert torch.equal(getattr(batch, name)[part], getattr(alone, name))


@pytest.mark.parametrize("gate", [{}, {"max_row_offset_px": 2.0}])
def test_mutual_matching_commutes_with_exchange_of_views(gate: dict[str, float]) -> None:
    generator = np.random.default_rng(10)
    views = [make_features(generator, [n], size=30, levels=256) for n in (60, 45)]
    config = MatchingConfig(mutual=True, **gate)
    there = {(i, j) for i, j, _ in rows(match_indices(*views, config))}
    back = {(j, i) for i, j, _ in rows(match_indices(*views[::-1], config))}
    assert there == back
    assert len(there) > 5


@pytest.mark.parametrize("gate", [{}, {"max_row_offset_px": 2.0}])
def test_matches_do_not_depend_on_the_order_of_keypoints(gate: dict[str, float]) -> None:
    generator = np.random.default_rng(11)
    views = [make_features(generator, [50], size=30, levels=256) for _ in range(2)]
    orders = [torch.from_numpy(generator.permutation(50)) for _ in range(2)]
    shuffled = [
        Features(v.keypoints[o], v.ptr, v.descriptors[o], v.scores[o]) for v, o in zip(views, orders, strict=True)
    ]
    config = MatchingConfig(max_ratio=0.99, **gate)
    expected = set(rows(match_indices(*views, config)))
    found = {(int(orders[0][i]), int(orders[1][j]), c) for i, j, c in rows(match_indices(*shuffled, config))}
    assert found == expected
    assert len(found) > 5


def test_equal_costs_go_to_the_lowest_index() -> None:
    for gate in ({}, WIDE):
        found = match_indices(scalar_features([3.0, 3.0]), scalar_features([3.0, 3.0]), MatchingConfig(**gate))
        assert rows(found) == [(0, 0, 0.0)]  # both prefer 0, which goes to the first


def test_matches_carry_keypoints_and_their_gradient_but_no_gradient_of_cost() -> None:
    generator = np.random.default_rng(12)
    views = [make_features(generator, [9]) for _ in range(2)]
    for view in views:
        view.keypoints.requires_grad_()
        view.descriptors.requires_grad_()
    matches = match_features(*views)
    found = match_indices(*views)
    assert torch.equal(matches.keypoints0, views[0].keypoints[found.index0])
    assert torch.equal(matches.keypoints1, views[1].keypoints[found.index1])
    assert matches.cost is not None
    assert not matches.cost.requires_grad
    matches.disparity.sum().backward()
    gradient = views[0].keypoints.grad
    assert gradient is not None
    assert gradient[:, 0].sum() == matches.num_matches


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float64])
def test_other_descriptor_dtypes_give_the_costs_of_float32(dtype: torch.dtype) -> None:
    generator = np.random.default_rng(13)
    whole = dtype == torch.uint8
    cast = [make_features(generator, [40], levels=256 if whole else 0) for _ in range(2)]
    cast = [replace(v, descriptors=v.descriptors.to(dtype) / (1 if whole else 3)) for v in cast]
    cast = [replace(v, descriptors=v.descriptors.to(dtype)) for v in cast]
    views = [replace(v, descriptors=v.descriptors.float()) for v in cast]
    for config in (MatchingConfig(), MatchingConfig(mutual=True, max_ratio=0.9), MatchingConfig(**WIDE)):
        assert same(match_indices(*cast, config), match_indices(*views, config))


def features_with(**changes: Tensor) -> Features:
    base: dict[str, Any] = {
        "keypoints": torch.zeros(1, 2),
        "ptr": torch.tensor([0, 1]),
        "descriptors": torch.zeros(1, 3),
        "scores": torch.zeros(1),
    }
    return Features(**base | changes)


@pytest.mark.parametrize(
    ("features1", "message"),
    [
        (
            features_with(ptr=torch.tensor([0, 0, 1])),
            "features0 and features1 must hold the same number of images, got 1 and 2",
        ),
        (features_with(descriptors=torch.zeros(1, 4)), r"descriptors .* one D, got \(1, 3\) and \(1, 4\)"),
        (features_with(descriptors=torch.full((1, 3), math.nan)), "descriptors of features1 must be finite"),
        (features_with(descriptors=torch.full((1, 3), math.inf)), "descriptors of features1 must be finite"),
        (features_with(descriptors=torch.full((1, 3), -1e30)), "descriptors of features1 must be finite and at most"),
        (features_with(keypoints=torch.full((1, 2), math.nan)), "keypoints of features1 must be finite"),
        (features_with(keypoints=torch.full((1, 2), 1e9)), "keypoints of features1 must be finite and at most"),
    ],
)
def test_unfit_features_are_named(features1: Features, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        match_indices(features_with(), features1, MatchingConfig(max_row_offset_px=1))
