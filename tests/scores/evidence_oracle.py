"""What images say about matches by its definition: windows sampled and compared one by one, float64 throughout."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

RADIUS = 7
ROW, COLUMN = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1]


def search_range(disparity: np.ndarray, row_offset: np.ndarray, voters: list[list[int]]) -> tuple[int, int]:
    """First and number of the disparities to search in one pair; ``voters``: neighbours in view 0, then in view 1."""
    if not len(disparity):
        return 0, 0
    level = abs(row_offset) <= 1.5
    votes = [
        sum(level[i] and level[j] and abs(disparity[i] - disparity[j]) <= 2 for j in near)
        for i, near in enumerate(voters)
    ]
    supported = disparity[np.array(votes) >= 3]
    believed = np.sort(supported if len(supported) >= 8 else disparity)
    low, high = np.quantile(believed, [0.01, 0.99])
    margin = max(4, 0.15 * (high - low))
    first, last = int(np.floor(low - margin)), int(np.ceil(high + margin))
    if last - first + 1 <= 256:
        return first, last - first + 1
    begins = np.floor(believed) - 3  # a match has three places on either side
    held = [
        ((believed >= value) & (believed < begin + 253)).sum() for value, begin in zip(believed, begins, strict=True)
    ]
    return int(begins[np.argmax(held)]), 256


def slope_at(i: int, left: np.ndarray, right: np.ndarray, voters: list[int]) -> np.ndarray:
    """(2,) slope of the disparity around match i, midway; ``voters``: its neighbours in view 0, then in view 1."""
    middle, disparity = (left + right) / 2, left[:, 0] - right[:, 0]
    way, gap = middle[voters] - middle[i], disparity[voters] - disparity[i]
    length = np.hypot(*way.T)
    say = np.where(abs(gap) <= 2 + length / 2, 1 / (1 + (gap / (1 + length / 5)) ** 2), 0)
    for _ in range(4):
        weight = say / (1 + (length / 40) ** 2)
        slope = np.linalg.solve((way.T * weight) @ way + 40 * np.eye(2), (way.T * weight) @ gap)
        say = (1 + (gap - way @ slope) ** 2) ** -2
    return slope.clip(-0.5, 0.5)


def brightness(images: tuple[np.ndarray, np.ndarray], points: tuple[np.ndarray, np.ndarray]) -> float:
    """Median, over the matches of a pair, of how much brighter 5 x 5 px around the keypoints of view 1 are."""
    levels = []
    for image, keypoints in zip(images, points, strict=True):
        height, width = image.shape
        x, y = (np.round(k).clip(0, size - 1).astype(int) for k, size in zip(keypoints.T, (width, height), strict=True))
        levels.append([image[max(b - 2, 0) : b + 3, max(a - 2, 0) : a + 3].mean() for a, b in zip(x, y, strict=True)])
    return float(np.median(np.subtract(levels[1], levels[0])))


class Measured(NamedTuple):
    """What the images say about one match, and how clearly they name a place nearby."""

    values: np.ndarray
    curves: list[np.ndarray]  # (2, D) of either view
    offset: float
    clear: bool  # rounding does not move the places of the least SSD


def measure_match(
    images: tuple[np.ndarray, np.ndarray],
    points: tuple[np.ndarray, np.ndarray],
    first: int,
    count: int,
    slope: np.ndarray,
) -> Measured:
    """Of two grey images of one brightness."""
    own = np.round(points[0][0] - points[1][0] - first)  # column of its disparity
    sides = []
    for view, sign in ((0, -1), (1, 1)):  # growing disparity moves the place in the other view to the left, the right
        other, partner, point = images[1 - view], points[1 - view], points[view]
        window, kernels = _window(images[view], *point), _kernels(_window(images[view], *point))
        near = _compare(window, [_window(other, partner[0] + sign * k, partner[1]) for k in range(-3, 4)], kernels)
        x = point[0] + sign * (first + np.arange(count))
        row = _compare(window, [_window(other, place, point[1]) for place in x], kernels)
        shear = slope / (1 - slope[0] / 2) if view else -slope / (1 + slope[0] / 2)
        places = [partner[0] + (1 + shear[0]) * (COLUMN + sign * k) + shear[1] * ROW for k in range(-3, 4)]
        slanted = [_sample(other, place, partner[1] + ROW) for place in places]
        along = _compare(window, slanted, kernels[1:3])
        sides.append(
            _measure_view(window, kernels, near, row, (x < 0) | (x > other.shape[1] - 1), own, along, 1 + shear[0])
        )
    level0, level1 = (_window(image, *point)[4:11, 4:11].mean() for image, point in zip(images, points, strict=True))
    beyond = max(0, -own, own - (count - 1))
    last = [abs(level0 - level1) / 16, min(np.log1p(beyond), 5)]
    offset = np.mean([side.offset for side in sides])
    values = np.concatenate([sides[0].values, sides[1].values, last])
    return Measured(values, [*sides[0].curves, *sides[1].curves], offset, all(side.clear for side in sides))


def _measure_view(
    window: np.ndarray,
    kernels: list[np.ndarray],
    near: tuple[np.ndarray, np.ndarray],
    row: tuple[np.ndarray, np.ndarray],
    outside: np.ndarray,
    own: float,
    along: tuple[np.ndarray, np.ndarray],
    stretch: float,
) -> Measured:
    ssd, likeness = near  # (7 places, 8 kernels)
    at, least = ssd[3], ssd.min(0)
    column = np.arange(len(outside))
    apart = abs(column - own)
    rivals = column[(apart > 2) & ~outside]
    margin, margin_likeness, crowd, distance = np.zeros((4, 4))
    for k in range(4):
        if len(rivals):
            best = rivals[row[0][rivals, k].argmin()]
            margin[k] = np.clip(row[0][best, k] - at[k], -6, 6)
            margin_likeness[k] = likeness[3, k] - max(-1, row[1][rivals, k].max())
            crowd[k] = ((at[k] + 0.3 - row[0][rivals, k]) / 0.1 + 0.5).clip(0, 1).sum() / len(column)
            alike = rivals[row[0][rivals, k] <= row[0][best, k] + 1e-3]  # of which the nearest counts
            distance[k] = np.log1p(min(apart[alike].min(), 100)) if margin[k] < -1e-3 else 0
    variance = [(kernel * (window - (kernel * window).sum()) ** 2).sum() for kernel in kernels[:4]]
    steps = np.diff(window[3:-3], axis=1)[:, 3:-3]  # along the rows of the middle 9 x 9
    values = [(ssd - least)[:, :4].ravel(), at[:4], likeness[3, :4], margin, margin_likeness, crowd, distance]
    values += [at[4:], (at - least)[4:], np.log1p(variance), [np.log1p((steps**2).mean())]]
    places, clear = zip(*[_lowest_place(np.exp(cost)) for cost in along[0].T], strict=True)
    offsets = stretch * np.array(places)
    values += [(along[0] - along[0].min(0)).ravel(), along[0][3] - at[1:3], along[1][3], offsets]
    curve = np.where(outside, 6, np.clip((row[0] - at)[:, 2:4].T, -6, 6))
    return Measured(np.concatenate(values), [curve], offsets.mean(), all(clear))


def _lowest_place(ssd: np.ndarray) -> tuple[float, bool]:
    """Where the parabola through the least of seven values is lowest, and whether that is far from another answer."""
    alike = [k for k in range(7) if ssd[k] <= ssd.min() * 1.001]
    k = int(np.clip(min(alike, key=lambda k: abs(k - 3)), 1, 5))
    before, least, after = ssd[k - 1 : k + 2]
    bend = before - 2 * least + after
    runner_up = np.sort(ssd)[1]
    return k - 3 + np.clip((before - after) / (2 * max(bend, 0.03 * least)), -1, 1), runner_up > 1.002 * ssd.min()


def _sample(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    height, width = image.shape
    return map_coordinates(image, [y.clip(0, height - 1), x.clip(0, width - 1)], order=1)  # bilinear, border repeated


def _window(image: np.ndarray, x: float, y: float) -> np.ndarray:
    return _sample(image, x + COLUMN, y + ROW)


def _kernels(window: np.ndarray) -> list[np.ndarray]:
    """Weights with sum 1: 5 x 5, 11 x 11, pixels like the centre, twice; the left, right, upper, lower half."""
    unlike = abs(window - window[6:9, 6:9].mean()) / 12
    middle = (abs(ROW) <= 5) & (abs(COLUMN) <= 5)
    halves = [middle & side for side in (COLUMN <= 1, COLUMN >= -1, ROW <= 1, ROW >= -1)]
    similar = np.exp(-unlike - (ROW**2 + COLUMN**2) / 40) + 1e-4
    tight = np.exp(-abs(window - window[7, 7]) / 10 - (ROW**2 + COLUMN**2) / 8) + 1e-5
    kernels = [(abs(ROW) <= 2) & (abs(COLUMN) <= 2), middle, similar, tight * middle, *halves]
    return [kernel / kernel.sum() for kernel in kernels]


def _compare(window: np.ndarray, others: list[np.ndarray], kernels: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """(places, kernels) log of the zero-mean SSD, and correlation; both with noise of two squared grey levels.

    Of eight kernels the SSD of the fourth keeps the difference of the means.
    """
    found = []
    for other in others:
        for k, kernel in enumerate(kernels):
            keeps_mean = k == 3 and len(kernels) == 8
            a, b = window - (kernel * window).sum(), other - (kernel * other).sum()
            scale = np.sqrt(((kernel * a * a).sum() + 2) * ((kernel * b * b).sum() + 2))
            difference = window - other if keeps_mean else a - b
            found.append((np.log((kernel * difference**2).sum() + 2), (kernel * a * b).sum() / scale))
    ssd, likeness = np.array(found).reshape(len(others), len(kernels), 2).transpose(2, 0, 1)
    return ssd, likeness
