"""What the images say about a match is what windows say that are sampled and compared one by one in float64."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, map_coordinates
from torch import Tensor

from tensor_stereo.features import to_gray
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.scores.image_evidence import NUM_VALUES, ImageEvidence, measure_images, search_ranges
from tensor_stereo.types import Matches
from tests.oracles import neighbor_sets
from tests.scores.evidence_oracle import brightness, measure_match, search_range, slope_at
from tests.scores.learned_oracle import random_pairs

# Grey levels count from the pixel in the middle of each window. Where others lie 100 levels away, squares reach 1e4,
# whose weighted sums float32 keeps to about sqrt(225) * 2^-24 * 1e4 / 15 = 6e-4 squared levels; the logarithm of the
# difference is taken from 2 squared levels on: 3e-4, or twice that for a difference of two logarithms.
ATOL = 6e-4
BACKENDS = ("native", "scipy")
HEIGHT, WIDTH = 60, 80
SIDE = (NUM_VALUES - 2) // 2
NAMES = ["near"] * 28 + ["whole"] * 4 + ["likeness"] * 4 + ["margin"] * 4 + ["margin_likeness"] * 4 + ["crowd"] * 4
NAMES += ["distance"] * 4 + ["half"] * 4 + ["half_above"] * 4 + ["variance"] * 4 + ["gradient"]
NAMES += ["along"] * 14 + ["along_gain"] * 2 + ["along_likeness"] * 2 + ["offset"] * 2
MARGIN, DISTANCE = ([k for k, other in enumerate(NAMES) if other == name] for name in ("margin", "distance"))
OFFSETS = [k for k, name in enumerate(2 * NAMES) if name == "offset"]


def textured_views(seed: int, height: int = HEIGHT, width: int = WIDTH, *, noise: float = 2.0) -> list[Tensor]:
    """(1, H, W) uint8: a blurred random texture, and the same as seen with disparity 6 + x / 20 px, and noise."""
    rng = np.random.default_rng(seed)
    texture = gaussian_filter(rng.normal(0, 1, (height, width)), 1.2)
    texture = 120 + 35 * texture / texture.std()
    y, x = np.mgrid[:height, :width].astype(float)
    moved = map_coordinates(texture, [y, (x + 6) / (1 - 1 / 20)], order=1, mode="nearest")
    moved += rng.normal(0, noise, moved.shape)
    return [torch.from_numpy(view.clip(0, 255).round()).to(torch.uint8)[None] for view in (texture, moved)]


def level_surfaces(surfaces: list[tuple[int, int]], row_offset: float = 0.0) -> Matches:
    """``surfaces``: disparity in px and number of matches of each, from left to right."""
    disparity = torch.cat([torch.full((count,), level) for level, count in surfaces]).double()
    place = torch.arange(len(disparity))
    left = torch.stack([place * 3.0, place % 4 * 20.0 + place % 3], 1).double()
    shift = torch.stack([disparity, torch.full_like(disparity, row_offset)], 1)
    return Matches(left, left - shift, torch.tensor([0, len(disparity)]))


def voters_of(matches: Matches) -> list[list[int]]:
    """Rows of the neighbours of every match in view 0, then in view 1."""
    graphs = build_match_graphs(matches)
    return [[*a, *b] for a, b in zip(*(neighbor_sets(adjacency) for adjacency in graphs[:2]), strict=True)]


def ranges_of(matches: Matches) -> list[tuple[int, int]]:
    near = voters_of(matches)
    disparity, row_offset = (matches.keypoints0 - matches.keypoints1).double().T.numpy()
    ranges = []
    for start, stop in pairwise(matches.ptr.tolist()):
        voters = [[j - start for j in near[i]] for i in range(start, stop)]
        ranges.append(search_range(disparity[start:stop], row_offset[start:stop], voters))
    return ranges


def assert_same(
    found: ImageEvidence, matches: Matches, views: Sequence[Sequence[Tensor]], rows: Sequence[int] | None = None
) -> None:
    """``views``: two lists of B images."""
    ranges = ranges_of(matches)
    width = max((count for _, count in ranges), default=0)
    assert found.values.shape == (matches.num_matches, NUM_VALUES)
    assert found.curve0.shape == found.curve1.shape == (matches.num_matches, 2, width)
    assert all(part.dtype == torch.float32 for name, part in found._asdict().items() if name != "num_columns")
    assert found.num_columns.dtype == torch.int64
    gray = [[to_gray(image[None])[0, 0].double().numpy() for image in images] for images in views]
    pair = np.repeat(np.arange(matches.num_pairs), matches.ptr.diff().numpy())
    points = [view.double().numpy() for view in (matches.keypoints0, matches.keypoints1)]
    near = voters_of(matches)
    brighter = [
        brightness((gray[0][b], gray[1][b]), tuple(view[pair == b] for view in points)) if (pair == b).any() else 0
        for b in range(matches.num_pairs)
    ]
    names = [*(f"{name} of view 0" for name in NAMES), *(f"{name} of view 1" for name in NAMES), "brighter", "beyond"]
    for row in range(matches.num_matches) if rows is None else rows:
        b = pair[row]
        first, count = ranges[b]
        assert (float(found.first[row]), int(found.num_columns[row])) == (first, count)
        images, places = (gray[0][b], gray[1][b] - brighter[b]), (points[0][row], points[1][row])
        expected = measure_match(images, places, first, count, slope_at(row, *points, near[row]))
        values = expected.values
        wrong = np.flatnonzero(~(abs(found.values[row].numpy() - values) <= ATOL))  # NaN too
        told = [(names[k], float(found.values[row, k]), values[k]) for k in wrong if expected.clear or k not in OFFSETS]
        assert not told, f"match {row} at {places}: {told}"
        if expected.clear:
            assert float(found.offset[row]) == pytest.approx(expected.offset, abs=ATOL)
        for given, curve in zip((found.curve0, found.curve1), expected.curves, strict=True):
            np.testing.assert_allclose(given[row, :, :count], curve, rtol=0, atol=ATOL)
            assert not given[row, :, count:].any()


def measure(matches: Matches, *views: list[Tensor], backend: str = "auto") -> ImageEvidence:
    return measure_images(*views, matches, build_match_graphs(matches), backend=backend)  # type: ignore[arg-type]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("whole", [True, False])
def test_windows_one_by_one(whole: bool, dtype: torch.dtype) -> None:
    matches = random_pairs(0, (30,), whole=whole, dtype=dtype)
    views = [[view] for view in textured_views(0)]
    assert_same(measure(matches, *views), matches, views)


@pytest.mark.parametrize("lengths", [(), (0,), (1, 0)])
def test_hardly_any_matches(lengths: tuple[int, ...]) -> None:
    matches = random_pairs(7, lengths)
    views = [[view] * len(lengths) for view in textured_views(7)]
    assert_same(measure(matches, *views), matches, views)


def test_pairs_of_any_size_and_kind_with_keypoints_outside() -> None:
    matches = random_pairs(1, (14, 0, 12, 1, 9))
    left, right = matches.keypoints0.clone(), matches.keypoints1.clone()
    left[2], right[3] = torch.tensor([1e4, 30.0]), torch.tensor([20.0, -1e4])  # 1e4 px: far beyond the search range
    left[5], right[6] = torch.tensor([[1e20, -1e20], [-1e20, 1e20]])  # no int64 holds that
    left[15], right[15] = torch.tensor([-4.25, 63.0]), torch.tensor([90.5, -6.75])
    left[16, 0], right[17, 1] = WIDTH - 1, HEIGHT - 1  # on the last pixels
    matches = replace(matches, keypoints0=left, keypoints1=right)
    gray, small = textured_views(1), textured_views(2, 33, 47)
    colour = [torch.cat([view, 255 - view // 2, view // 3 + 60]) for view in gray]  # (3, H, W)
    kinds = [gray, gray, [view.float() / 255 for view in small], gray, [view.double() / 255 for view in colour]]
    views = [list(images) for images in zip(*kinds, strict=True)]
    assert_same(measure(matches, *views), matches, views)
    views[1][4] = colour[1]
    assert_same(measure(matches, *views), matches, views, range(27, 36))


def test_margins_end_at_six() -> None:
    rng = np.random.default_rng(3)
    texture = torch.from_numpy(gaussian_filter(rng.normal(0, 1, (HEIGHT, WIDTH)), 0.8) * 130 + 128)
    image = texture.clip(0, 255).to(torch.uint8)[None]
    left = torch.from_numpy(rng.integers(20, 40, (12, 2))).double() + torch.tensor([15.0, 0.0])
    matches = Matches(left, left - torch.tensor([6.0, 0.0]), torch.tensor([0, 12]))
    views = [[image], [image.roll(-6, 2)]]
    found = measure(matches, *views)
    assert_same(found, matches, views)
    assert all((curve == 6).any() for curve in (found.curve0, found.curve1))
    assert all((side[:, MARGIN] > 5.5).any() for side in found.values[:, :-2].split(SIDE, 1))


def test_wrong_matches_see_the_nearest_of_equal_rivals() -> None:
    rng = np.random.default_rng(4)
    tile = 100 + gaussian_filter(rng.normal(0, 40, (HEIGHT, 9)), 1, mode="wrap")
    image = torch.from_numpy(np.tile(tile, (1, 9))[:, :WIDTH].round()).to(torch.uint8)[None]
    left = torch.from_numpy(rng.integers(5, 55, (24, 2))).double() + torch.tensor([20.0, 0.0])
    disparity = torch.from_numpy(rng.choice([9.0, 18.0, 13.0, 22.0, 27.0], 24))
    matches = Matches(left, left - torch.stack([disparity, 0 * disparity], 1), torch.tensor([0, 24]))
    views = [[image], [image]]  # every nine pixels the same
    found = measure(matches, *views)
    assert_same(found, matches, views)
    distance = found.values[:, DISTANCE]
    assert (distance[disparity % 9 == 0] == 0).all()
    assert (distance[disparity % 9 == 4].expm1().round() == 4).all()


def test_images_without_texture_tell_nothing() -> None:
    matches = random_pairs(2, (20,))
    views = [[torch.full((1, HEIGHT, WIDTH), level, dtype=torch.uint8)] for level in (77, 101)]
    found = measure(matches, *views)
    assert_same(found, matches, views)
    for name in ("near", "likeness", "distance", "half_above", "variance", "gradient"):
        columns = [k for k, other in enumerate(NAMES) if other == name]
        assert not found.values[:, columns].any()


def test_matches_far_beyond_the_range_and_their_rivals() -> None:
    base = random_pairs(5, (40,))
    moved = base.keypoints0.clone()
    moved[:6, 0] += torch.tensor([70.0, 95, 120, 150, 200, 400], dtype=torch.float64)
    matches = replace(base, keypoints0=moved)
    views = [[view] for view in textured_views(5)]
    found = measure(matches, *views)
    assert_same(found, matches, views, range(6))
    assert found.values[:, -1].max() == 5
    assert found.values[:, SIDE:-2][:, DISTANCE].max() == pytest.approx(np.log1p(100))


def test_many_matches_of_one_pair() -> None:
    matches = random_pairs(6, (3, 400))
    left, right = textured_views(6)
    views = [[left, left], [right, right]]
    assert_same(measure(matches, *views), matches, views, [0, 2, 3, 194, 195, 196, 386, 387, 402])


@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.parametrize("levels", [(10,), (10, 70), (10, 70, 500), (-300, 90, 100), (0, 130, 260)])
def test_search_ranges_are_those_of_votes_one_by_one(levels: tuple[int, ...], whole: bool) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        lengths = (60, 0, 11, 4, 120, 1)
        count = sum(lengths)
        left = rng.random((count, 2)) * [300, 100]
        level = np.array(levels)[(left[:, 0] * len(levels) / 300).astype(int)]
        disparity = np.where(rng.random(count) < 0.2, rng.random(count) * 700 - 300, level + rng.normal(0, 1.2, count))
        right = left - np.stack([disparity, rng.normal(0, 1, count)], 1)
        views = [torch.from_numpy(view.round() if whole else view) for view in (left, right)]
        matches = Matches(*views, torch.tensor([0, *lengths]).cumsum(0))
        assert search_ranges(matches, build_match_graphs(matches)) == ranges_of(matches)


@pytest.mark.parametrize(
    ("surfaces", "expected"),
    [
        ([(20, 31)], (16, 9)),  # four on either side
        ([(0, 31), (195, 31)], (-30, 256)),  # 29.25 on either side
        ([(0, 31), (196, 31)], (-3, 256)),  # 29.4 are too many; three places before the first match must do
        ([(0, 31), (400, 20)], (-3, 256)),
        ([(0, 20), (400, 31)], (397, 256)),
        ([(0, 12), (251, 12), (505, 14)], (502, 256)),  # 251 has not three places behind it, if 0 has three before
        ([(0, 12), (249, 12), (505, 14)], (-3, 256)),
        ([(20, 8), (800, 1)], (16, 9)),  # one match alone has no vote
        ([(20, 7), (200, 1)], (-6, 220)),  # seven are too few to be believed; all span 0.93 * 180, 25.1 on either side
    ],
)
def test_search_ranges_of_level_surfaces(surfaces: list[tuple[int, int]], expected: tuple[int, int]) -> None:
    matches = level_surfaces(surfaces)
    assert search_ranges(matches, build_match_graphs(matches)) == [expected]


@pytest.mark.parametrize(("row_offset", "expected"), [(1.5, (16, 9)), (-1.5, (16, 9)), (1.625, (17, 256))])
def test_matches_off_their_rows_have_no_vote(row_offset: float, expected: tuple[int, int]) -> None:
    matches = level_surfaces([(20, 12), (800, 1)], row_offset)
    assert search_ranges(matches, build_match_graphs(matches)) == [expected]
