"""Matching costs of a rectified pair at every disparity: what the two images say about a map, whoever made it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]
Floats = NDArray[np.float32]
Bits = TypeVar("Bits", NDArray[np.uint8], NDArray[np.uint32])

HALO_PX = 8  # what a cost sees above and below its pixel
CENSUS_PX, CENSUS_BOX_PX = 5, 5  # compared pixels, and the box over which their differences are averaged
DETAIL_PX, DETAIL_BOX_PX = 9, 9  # box of the local mean that is taken out, and the box of the differences
_CENSUS_STEPS, _DETAIL_STEPS = 10.0, 8.0  # of a byte for one bit, and for one grey level
_MOST_LEVELS = 30  # a greater difference of grey levels is an outlier
NUM_CURVES = 2


class CostCurves(NamedTuple):
    """Costs of the pixels of view 0 in some rows, in steps of a byte.

    Attributes:
        costs: Per kind of cost (K, H', W) uint8; k stands for disparity ``first + k``.
        best: Per kind (H', W) uint8, least cost of every pixel of view 0.
        best1: Per kind (H', W) uint8, least cost of every pixel of view 1; 255 where none was looked at.
        winner1: Per kind (H', W) int16 px, disparity of that cost.
        first: Least disparity in px.
    """

    costs: list[Gray]
    best: list[Gray]
    best1: list[Gray]
    winner1: list[NDArray[np.int16]]
    first: int

    def of_rows(self, rows: slice) -> CostCurves:
        """Those of some of the rows.

        >>> image = np.zeros((6, 9), np.uint8)
        >>> cost_curves(image, image, 0, 2).of_rows(slice(1, 3)).best[0].shape
        (2, 9)
        """
        costs = [values[:, rows] for values in self.costs]
        best, best1 = ([values[rows] for values in kind] for kind in (self.best, self.best1))
        return CostCurves(costs, best, best1, [values[rows] for values in self.winner1], self.first)


def census(image: Gray) -> NDArray[np.uint32]:
    """Which of the 24 pixels around each are darker (Zabih & Woodfill, ECCV 1994), as bits; borders are repeated.

    >>> int(census(np.arange(25, dtype=np.uint8).reshape(5, 5))[2, 2]).bit_count()
    12
    """
    radius = CENSUS_PX // 2
    padded = cv2.copyMakeBorder(image, radius, radius, radius, radius, cv2.BORDER_REPLICATE)
    height, width = image.shape
    bits = np.zeros((height, width), np.uint32)
    places = [(y, x) for y in range(CENSUS_PX) for x in range(CENSUS_PX) if (y, x) != (radius, radius)]
    for k, (y, x) in enumerate(places):
        bits |= (padded[y : y + height, x : x + width] < image).astype(np.uint32) << np.uint32(k)
    return bits


def detail(image: Gray) -> Gray:
    """Grey levels less their local mean, 128 for none.

    >>> int(detail(np.full((9, 9), 7, np.uint8))[4, 4])
    128
    """
    mean = cv2.boxFilter(image, cv2.CV_32F, (DETAIL_PX, DETAIL_PX), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(np.clip(np.rint(image - mean) + 128, 0, 255).astype(np.uint8))


def cost_curves(image0: Gray, image1: Gray, first: int, count: int, stride: int = 1) -> CostCurves:
    """Costs of all pixels of every ``stride``-th row at ``count`` disparities from ``first`` on.

    Two kinds: bits in which the census differs, over a box of 5 x 5 px, which no change of brightness touches; and
    absolute differences of the grey levels less their local mean, at most 30, over a box of 9 x 9 px. Boxes share their
    sums. Beyond the border view 1 is continued by its outermost columns.

    >>> image = np.random.default_rng(0).integers(0, 256, (20, 40), dtype=np.uint8)
    >>> curves = cost_curves(image[:, :30].copy(), image[:, 6:36].copy(), 0, 9)
    >>> int(curves.costs[0][:, 10, 15].argmin())
    6
    """
    height, width = image0.shape
    found = CostCurves([], [], [], [], first)
    for slices in (_census_slices(image0, image1, first, count), _detail_slices(image0, image1, first, count)):
        rows = len(range(0, height, stride))
        costs = np.empty((count, rows, width), np.uint8)
        best, best1 = np.full((rows, width), 255, np.uint8), np.full((rows, width), 255, np.uint8)
        winner1 = np.zeros((rows, width), np.int16)
        for k, cost in enumerate(slices):
            np.rint(cost[::stride], out=cost[::stride])
            costs[k] = cost[::stride]
            np.minimum(best, costs[k], out=best)
            d = first + k
            low, high = max(0, -d), min(width, width - d)  # pixels of view 1 whose partner x + d lies in view 0
            if low < high:
                seen, own = costs[k][:, low + d : high + d], best1[:, low:high]
                np.copyto(winner1[:, low:high], d, where=seen < own)
                np.minimum(own, seen, out=own)
        found.costs.append(costs)
        found.best.append(best)
        found.best1.append(best1)
        found.winner1.append(winner1)
    return found


def _census_slices(image0: Gray, image1: Gray, first: int, count: int) -> Iterator[Floats]:
    bits0, shifted = census(image0), _shifts(census(image1), first, count)
    for bits1 in shifted:
        differ = np.bitwise_count(bits0 ^ bits1)
        yield cv2.boxFilter(differ, cv2.CV_32F, (CENSUS_BOX_PX,) * 2, borderType=cv2.BORDER_REPLICATE) * _CENSUS_STEPS


def _detail_slices(image0: Gray, image1: Gray, first: int, count: int) -> Iterator[Floats]:
    levels0, shifted = detail(image0), _shifts(detail(image1), first, count)
    for levels1 in shifted:
        differ = np.minimum(np.where(levels0 > levels1, levels0 - levels1, levels1 - levels0), np.uint8(_MOST_LEVELS))
        yield cv2.boxFilter(differ, cv2.CV_32F, (DETAIL_BOX_PX,) * 2, borderType=cv2.BORDER_REPLICATE) * _DETAIL_STEPS


def _shifts(values: Bits, first: int, count: int) -> Iterator[Bits]:
    """The values of view 1 at x - d for every pixel x of view 0, disparity by disparity."""
    width = values.shape[1]
    padded = np.pad(values, ((0, 0), (width, width)), mode="edge")
    for d in range(first, first + count):
        start = width - min(max(d, -width), width)
        yield padded[:, start : start + width]
