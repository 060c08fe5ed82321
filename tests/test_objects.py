from __future__ import annotations

from collections import Counter
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from tensor_stereo.configs import ObjectsConfig
from tensor_stereo.objects import (
    contour_images,
    group_matches,
    isolated_matches,
    label_objects,
    otsu_threshold,
    sample_nearest,
    split_group,
    trace_objects,
)
from tensor_stereo.types import Matches

EIGHT = (
    "2003/cones",
    "2003/teddy",
    *(f"2005/{s}" for s in ("Art", "Books", "Dolls", "Laundry", "Moebius", "Reindeer")),
)
SMALL = ObjectsConfig(element_px=3, min_area_px=4)  # some ten objects in a picture of blobs

grey_images = arrays(
    np.uint8,
    array_shapes(min_dims=2, max_dims=2, max_side=9),
    elements=st.one_of(st.integers(0, 255), st.sampled_from([0, 100, 255])),
)


def batch(*images: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.stack(images))[:, None]


def blobs(seed: int, height: int = 40, width: int = 50, sigma: float = 1.0) -> np.ndarray:
    """Smoothed noise: an image with many objects, holes and objects in holes."""
    noise = np.random.default_rng(seed).standard_normal((height, width))
    smooth = cv2.GaussianBlur(noise, (0, 0), sigma)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def opencv_contour_image(image: np.ndarray, element_px: int) -> np.ndarray:
    _, binary = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    element = np.ones((element_px, element_px), np.uint8)
    return cv2.morphologyEx(binary, cv2.MORPH_CLOSE, element) - cv2.morphologyEx(binary, cv2.MORPH_OPEN, element)


def brute_force_areas(image: np.ndarray, config: ObjectsConfig) -> np.ndarray:
    """Area of the smallest contour around each pixel, infinite where there is none, by a point-in-polygon test."""
    outline = opencv_contour_image(image, config.element_px)
    contours, _ = cv2.findContours(outline, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    areas = np.full(image.shape, np.inf)
    for contour in contours:
        area = cv2.contourArea(contour)
        if area >= config.min_area_px:
            for y, x in np.ndindex(*image.shape):
                if cv2.pointPolygonTest(contour, (x, y), False) >= 0:
                    areas[y, x] = min(areas[y, x], area)
    return areas


def areas_of_labels(image: np.ndarray, config: ObjectsConfig) -> np.ndarray:
    areas = [cv2.contourArea(contour.numpy()) for contour in trace_objects(torch.from_numpy(image)[None], config)]
    return np.array([np.inf, *areas])[label_objects(batch(image), config)[0].numpy()]


def rand_points(num_points: int, size: tuple[int, int], generator: torch.Generator) -> torch.Tensor:
    return torch.rand(num_points, 2, generator=generator) * torch.tensor([size[1] - 1.0, size[0] - 1.0])


def points(*rows: tuple[float, float]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float32).reshape(-1, 2)


@given(grey_images)
def test_otsu_takes_the_lowest_of_the_best_levels(image: np.ndarray) -> None:
    values, best = [int(v) for v in image.flat], (Fraction(0), 0)
    for level in sorted(set(values))[:-1]:
        below, above = [v for v in values if v <= level], [v for v in values if v > level]
        difference = Fraction(sum(below), len(below)) - Fraction(sum(above), len(above))
        best = max(best, (len(below) * len(above) * difference**2, level), key=lambda item: (item[0], -item[1]))
    assert otsu_threshold(batch(image)).tolist() == [best[1]]


@pytest.mark.parametrize("scene", EIGHT)
def test_threshold_and_contour_image_equal_opencv_on_real_pairs(data_root: Path, scene: str) -> None:
    names = ("im2.png", "im6.png") if scene.startswith("2003") else ("view1.png", "view5.png")
    for name in names:
        image = cv2.imread(str(data_root / "middlebury" / scene / name), cv2.IMREAD_GRAYSCALE)
        assert otsu_threshold(batch(image)).item() == cv2.threshold(image, 0, 255, cv2.THRESH_OTSU)[0]
        ours = contour_images(batch(image))[0, 0].numpy()
        np.testing.assert_array_equal(ours, opencv_contour_image(image, 5) > 0)


@pytest.mark.parametrize("element_px", [1, 3, 5, 9])
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (4, 3), (30, 41)])
def test_contour_image_equals_opencv_at_every_border(element_px: int, shape: tuple[int, int]) -> None:
    for seed in range(10):
        image = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
        ours = contour_images(batch(image), ObjectsConfig(element_px=element_px))[0, 0].numpy()
        np.testing.assert_array_equal(ours, opencv_contour_image(image, element_px) > 0)


@pytest.mark.parametrize("seed", range(6))
def test_label_is_the_smallest_contour_around_the_pixel(seed: int) -> None:
    image = blobs(seed)
    expected = brute_force_areas(image, SMALL)
    np.testing.assert_array_equal(areas_of_labels(image, SMALL), expected)
    assert len(np.unique(expected)) > 3


def test_label_is_the_smallest_contour_around_real_pixels(data_root: Path) -> None:
    image = cv2.imread(str(data_root / "middlebury/2005/Art/view1.png"), cv2.IMREAD_GRAYSCALE)[200:320, 300:460]
    expected = brute_force_areas(image, ObjectsConfig())
    np.testing.assert_array_equal(areas_of_labels(image, ObjectsConfig()), expected)
    assert len(np.unique(expected)) > 3


@pytest.mark.parametrize("turn", [np.transpose, np.fliplr, np.flipud, np.rot90])
def test_objects_turn_with_the_image(turn) -> None:
    for seed in range(5):
        image = blobs(seed)
        turned = areas_of_labels(np.ascontiguousarray(turn(image)), SMALL)
        np.testing.assert_array_equal(turned, turn(areas_of_labels(image, SMALL)))


def test_labels_number_the_contours_from_large_to_small() -> None:
    image = blobs(3)
    contours = trace_objects(torch.from_numpy(image)[None], SMALL)
    areas = [cv2.contourArea(contour.numpy()) for contour in contours]
    assert areas == sorted(areas, reverse=True)
    assert min(areas) >= SMALL.min_area_px
    labels = label_objects(batch(image), SMALL)[0]
    assert labels.dtype == torch.int32
    assert labels.min() == 0
    assert labels.max() == len(contours)
    for number, contour in enumerate(contours, start=1):
        x, y = contour.long().unbind(1)
        assert (labels[y, x] >= number).all()
        steps = contour.roll(-1, 0) - contour
        assert (steps.abs().amax(1) == 1).all()  # a closed chain of neighbouring pixels


def test_ties_are_numbered_from_top_to_bottom_then_left_to_right() -> None:
    image = torch.zeros(1, 1, 40, 60, dtype=torch.uint8)
    for number, (y, x) in enumerate([(28, 5), (4, 40), (4, 5)]):
        image[..., y : y + 8, x : x + 8] = 255 - number
    config = ObjectsConfig(element_px=9, min_area_px=4)  # opening removes the squares, so they are their own contours
    assert label_objects(image, config)[0, [4, 4, 28], [5, 40, 5]].tolist() == [1, 2, 3]


def test_area_below_the_least_is_no_object() -> None:
    image = torch.zeros(1, 1, 30, 30, dtype=torch.uint8)
    image[..., 10:18, 10:18] = 255  # its contour encloses 7 x 7
    assert label_objects(image, ObjectsConfig(element_px=9, min_area_px=49)).any()
    assert not label_objects(image, ObjectsConfig(element_px=9, min_area_px=49.5)).any()


@pytest.mark.parametrize("value", [0, 1, 128, 255])
@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (20, 30)])
def test_constant_image_has_no_object(value: int, shape: tuple[int, int]) -> None:
    image = torch.full((1, 1, *shape), value, dtype=torch.uint8)
    assert torch.equal(label_objects(image), torch.zeros(1, *shape, dtype=torch.int32))
    assert trace_objects(image[0]) == []


def test_batch_equals_loop() -> None:
    images = batch(*[blobs(seed, sigma=0.7 + seed / 10) for seed in range(7)])
    labels = label_objects(images, SMALL)
    assert (labels.amax((1, 2)) > 0).all()
    assert torch.equal(labels, torch.cat([label_objects(image[None], SMALL) for image in images]))
    assert label_objects(images[:0]).shape == (0, 40, 50)


def test_thread_count_changes_nothing() -> None:
    images, threads = batch(*[blobs(seed) for seed in range(5)]), torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        single = label_objects(images, SMALL)
        torch.set_num_threads(2)
        assert torch.equal(single, label_objects(images, SMALL))
    finally:
        torch.set_num_threads(threads)


def test_objects_name_what_is_wrong() -> None:
    image = torch.zeros(1, 1, 5, 5, dtype=torch.uint8)
    with pytest.raises(TypeError, match="images must be uint8"):
        label_objects(image.float())
    for shape in ((5, 5), (1, 3, 5, 5), (1, 1, 0, 5)):
        with pytest.raises(ValueError, match="images must have shape"):
            label_objects(torch.zeros(shape, dtype=torch.uint8))
    with pytest.raises(ValueError, match="image must have shape"):
        trace_objects(image)
    for element_px in (0, 4):
        with pytest.raises(ValueError, match=r"ObjectsConfig\.element_px must be odd"):
            label_objects(image, ObjectsConfig(element_px=element_px))
    with pytest.raises(ValueError, match="min_area_px"):
        label_objects(image, ObjectsConfig(min_area_px=-1))


def test_sample_rounds_half_to_even_as_numpy_does() -> None:
    rows = np.array([[0.5, 1.5], [1.5, 0.5], [2.5, 2.5], [0.49, 1.51], [-0.5, 3.4]])
    values = torch.arange(16).view(1, 4, 4)
    x, y = np.round(rows).astype(int).T
    assert sample_nearest(values, torch.from_numpy(rows), torch.tensor([0, 5])).tolist() == (4 * y + x).tolist()


def test_keypoint_just_outside_takes_the_border() -> None:
    values = torch.arange(6).view(1, 2, 3)
    outside = points((-1.0, -1.0), (3.0, 2.0), (2.7, -0.6), (-0.9, 1.8))
    assert sample_nearest(values, outside, torch.tensor([0, 4])).tolist() == [0, 5, 2, 3]


@pytest.mark.parametrize("far", [(-1.1, 0.0), (0.0, -1.1), (3.1, 0.0), (0.0, 2.1), (float("nan"), 0.0)])
def test_keypoint_far_outside_is_an_error_that_names_the_row(far: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match=r"keypoints must lie in their image.*row 1 "):
        sample_nearest(torch.zeros(1, 2, 3), points((0.0, 0.0), far), torch.tensor([0, 2]))


def test_maps_of_different_size_equal_a_loop() -> None:
    generator = torch.Generator().manual_seed(0)
    sizes, lengths = [(4, 9), (7, 3), (5, 5)], [20, 0, 30]
    maps = [torch.rand(size, generator=generator) for size in sizes]
    rows = [rand_points(n, size, generator) for n, size in zip(lengths, sizes, strict=True)]
    together = sample_nearest(maps, torch.cat(rows), torch.tensor([0, 20, 20, 50]))
    single = [sample_nearest([m], r, torch.tensor([0, len(r)])) for m, r in zip(maps, rows, strict=True)]
    assert torch.equal(together, torch.cat(single))


def test_sampling_nothing_keeps_the_dtype() -> None:
    empty = torch.zeros(0, 2)
    assert sample_nearest(torch.zeros(2, 3, 3, dtype=torch.int32), empty, torch.tensor([0, 0, 0])).dtype == torch.int32
    assert len(sample_nearest([], empty, torch.tensor([0]))) == 0


def test_maps_must_fit_the_pairs() -> None:
    with pytest.raises(ValueError, match=r"one map per pair \(1\), got 2"):
        sample_nearest(torch.zeros(2, 3, 3), points((0, 0)), torch.tensor([0, 1]))
    with pytest.raises(ValueError, match="map 0 must have shape"):
        sample_nearest(torch.zeros(1, 1, 3, 3), points((0, 0)), torch.tensor([0, 1]))


def random_groups(seed: int = 0) -> tuple[Matches, list[torch.Tensor], list[torch.Tensor]]:
    generator = torch.Generator().manual_seed(seed)
    views = []
    for _ in range(2):
        maps = [torch.randint(0, 4, (h, w), generator=generator, dtype=torch.int32) for h, w in ((6, 8), (9, 5))]
        rows = [rand_points(50, (6, 8), generator), rand_points(70, (9, 5), generator)]
        views.append((maps, torch.cat(rows)))
    (labels0, left), (labels1, right) = views
    return Matches(left, right, torch.tensor([0, 50, 120])), labels0, labels1


def test_group_is_the_pair_of_objects() -> None:
    matches, labels0, labels1 = random_groups()
    group = group_matches(matches, labels0, labels1)
    assert group.dtype == torch.int64
    object0, object1 = split_group(group)
    for row in range(120):
        pair = row >= 50
        for labels, keypoints, found in (
            (labels0, matches.keypoints0, object0),
            (labels1, matches.keypoints1, object1),
        ):
            x, y = keypoints[row].tolist()
            assert found[row] == labels[pair][round(y), round(x)]
    assert len({(int(a), int(b)) for a, b in zip(object0, object1, strict=True)}) == len(group.unique())


def test_swapped_views_swap_the_objects() -> None:
    matches, labels0, labels1 = random_groups()
    forward = split_group(group_matches(matches, labels0, labels1))
    backward = split_group(group_matches(matches.swap(), labels1, labels0))
    assert torch.equal(forward[0], backward[1])
    assert torch.equal(forward[1], backward[0])


def test_stacked_maps_equal_a_list_of_them() -> None:
    matches, _, _ = random_groups()
    labels = torch.randint(0, 5, (2, 9, 8), generator=torch.Generator().manual_seed(1))
    assert torch.equal(group_matches(matches, labels, labels), group_matches(matches, [*labels], [*labels]))


def test_groups_of_the_largest_labels_stay_distinct() -> None:
    largest = 2**31 - 1
    labels = torch.tensor([[[largest, 0, 1]]], dtype=torch.int32)
    rows = points((0, 0), (1, 0), (2, 0))
    group = group_matches(Matches(rows, rows.flip(0), torch.tensor([0, 3])), labels, labels)
    assert split_group(group)[0].tolist() == [largest, 0, 1]
    assert split_group(group)[1].tolist() == [1, 0, largest]


def test_labels_must_be_small_integers() -> None:
    rows = points((0, 0))
    matches, good = Matches(rows, rows, torch.tensor([0, 1])), torch.zeros(1, 1, 1, dtype=torch.int32)
    with pytest.raises(TypeError, match="labels1 must hold integers"):
        group_matches(matches, good, good.float())
    with pytest.raises(ValueError, match="labels0 must lie in"):
        group_matches(matches, good - 1, good)
    with pytest.raises(ValueError, match="keypoints1 must lie in"):
        group_matches(Matches(rows, rows + 5, torch.tensor([0, 1])), good, good)


@given(st.lists(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 2))), max_size=3))
def test_isolated_match_is_alone_between_two_objects(pairs: list[list[tuple[int, int]]]) -> None:
    group = torch.tensor([a * 2**31 + b for pair in pairs for a, b in pair], dtype=torch.int64)
    ptr = torch.tensor([0, *np.cumsum([len(pair) for pair in pairs])], dtype=torch.int64)
    expected = []
    for pair in pairs:
        joining = Counter(pair)
        expected += [joining[a, b] == 1 and a > 0 and b > 0 for a, b in pair]
    assert isolated_matches(group, ptr).tolist() == expected
