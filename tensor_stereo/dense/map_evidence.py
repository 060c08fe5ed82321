"""What a confidence network sees of every pixel of a disparity map: of the map itself, and of the two images.

Nothing depends on which method made the map, on a change of brightness of one view, or on a common shift of all
disparities, but for what leaves the images.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tensor_stereo.dense.matching_costs import HALO_PX, NUM_CURVES, CostCurves, Floats, Gray, cost_curves

Planes = list[NDArray[np.floating[Any]]]

MAX_DISPARITIES = 256  # that are searched
_RANGE_QUANTILE, _RANGE_MARGIN, _LEAST_MARGIN_PX = 0.01, 0.15, 8  # disparities searched beyond those of the map
_SPREADS = (1, 2, 5, 10)  # of 5 x 5 pixels that are compared, in steps of the grid
_BOXES = (5, 11, 21, 41)  # for mean and spread of the disparities, in steps of the grid
_PLANE_BOXES = (11, 41)  # for a plane through the disparities
_PLANE_TILT = 1e-3  # of one pixel's weight, so that a single column or row has a plane too
_AGREE_PX = 1.0
_BAND_BYTES = 2**27  # of the costs that are held at a time
_RIVAL_PX = 1  # disparities as near to the estimate are no rivals
_AS_GOOD = 8  # steps of a byte by which the cost of a rival may be higher
_FAR_PX = 64.0  # distances to the border beyond which they do not matter
_NUM_OF_MAP = 1 + len(_SPREADS) + 3 * len(_BOXES) + 4 * len(_PLANE_BOXES)
_NUM_OF_COSTS = 9
NUM_PLACE, NUM_GREY, NUM_OTHER = 5, 5, 4
NUM_PLANES = _NUM_OF_MAP + NUM_PLACE + NUM_CURVES * _NUM_OF_COSTS + NUM_GREY + NUM_OTHER + 1


def measure_map(
    disparity: Floats, image0: Gray, image1: Gray, disparity1: Floats | None = None, stride: int = 1
) -> Floats:
    """Planes of one map, on every ``stride``-th pixel.

    Args:
        disparity: (H, W) px of view 0, NaN where unknown.
        image0: (H, W) grey levels of view 0.
        image1: (H, W) of view 1.
        disparity1: (H, W) px of view 1, NaN where unknown; None: not known.
        stride: Distance of the pixels that are judged, from pixel (0, 0) on.

    Returns:
        (:data:`NUM_PLANES`, H', W') float32: of the map, of its place, of both costs, of the grey levels, of the map of
        view 1, and the logarithm of the stride. Unknown pixels have some values too, which mean nothing.

    >>> flat = np.full((40, 60), 3, np.float32)
    >>> measure_map(flat, np.zeros((40, 60), np.uint8), np.zeros((40, 60), np.uint8)).shape[0] == NUM_PLANES
    True
    """
    width = disparity.shape[1]
    disparity = np.clip(disparity, -width, width)  # partners farther off are outside of view 1 all the same
    grid = np.ascontiguousarray(disparity[::stride, ::stride])
    known = np.isfinite(grid)
    filled = np.where(known, grid, np.float32(0)).astype(np.float32)
    columns = np.arange(0, width, stride, dtype=np.float32)
    planes: Planes = [
        *_of_map(filled, known),
        *_of_place(filled, known, columns, stride, width),
        *_of_costs(filled, known, columns, stride, image0, image1, search_range(disparity)),
        *_of_grey(image0, image1, filled, columns, stride),
        *_of_other(filled, columns, disparity1, stride),
        np.full_like(filled, np.log2(stride) / 2),
    ]
    return np.stack(planes, dtype=np.float32, casting="same_kind")


def search_range(disparity: Floats) -> tuple[int, int]:
    """First disparity and number of disparities that are searched: those of the map, and some more.

    Of a wider range the :data:`MAX_DISPARITIES` that hold most pixels are searched.

    >>> search_range(np.linspace(10, 50, 99, dtype=np.float32)[None])
    (2, 57)
    """
    known = disparity[np.isfinite(disparity)]
    if not known.size:
        return 0, 1
    low, high = np.quantile(known, [_RANGE_QUANTILE, 1 - _RANGE_QUANTILE])
    margin = max(_LEAST_MARGIN_PX, _RANGE_MARGIN * (high - low))
    first, last = int(np.floor(low - margin)), int(np.ceil(high + margin))
    count = last + 1 - first
    if count <= MAX_DISPARITIES:
        return first, count
    histogram = np.bincount(np.clip(np.rint(known) - first, 0, count - 1).astype(np.int64), minlength=count)
    inside = np.convolve(histogram, np.ones(MAX_DISPARITIES, np.int64), "valid")
    return first + int(inside.argmax()), MAX_DISPARITIES


def _of_map(filled: Floats, known: NDArray[np.bool_]) -> Planes:
    """Whether it is known, how many pixels around agree, how many are known, distance to their mean, their spread."""
    weight = known.astype(np.float32)
    planes: Planes = [weight]
    height, width = filled.shape
    apart = np.where(known, filled, np.float32(np.inf))
    for spread in _SPREADS:
        reach = 2 * spread
        padded = cv2.copyMakeBorder(apart, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=np.inf)
        agree = np.zeros((height, width), np.uint8)
        for y in range(-reach, reach + 1, spread):
            for x in range(-reach, reach + 1, spread):
                if (y, x) != (0, 0):
                    other = padded[reach + y : reach + y + height, reach + x : reach + x + width]
                    agree += np.abs(other - filled) <= _AGREE_PX
        planes.append(agree.astype(np.float32) / 24)
    centre = np.float32(filled[known].mean()) if known.any() else np.float32(0)
    level = np.where(known, filled - centre, np.float32(0))  # so that squares keep their digits
    for box in _BOXES:
        total, first, second = (
            cv2.boxFilter(values, cv2.CV_32F, (box, box), normalize=False, borderType=cv2.BORDER_CONSTANT)
            for values in (weight, level, level * level)
        )
        count = np.maximum(total, 1)
        mean = first / count
        spread_px = np.sqrt(np.maximum(second / count - mean * mean, 0))
        planes += [total / (box * box), np.tanh((level - mean) / 2), np.log1p(spread_px)]
    for box in _PLANE_BOXES:
        planes += _of_plane(level, weight, box)
    return planes


def _of_plane(level: Floats, weight: Floats, box: int) -> Planes:
    """The least-squares plane of a box: distance to it, spread around it, and its slopes."""
    one = np.ones(box, np.float64)
    ramp = np.arange(box) - box // 2.0

    def total(values: Floats, along_x: NDArray[np.float64], along_y: NDArray[np.float64]) -> Floats:
        return np.asarray(cv2.sepFilter2D(values, cv2.CV_32F, along_x, along_y, borderType=cv2.BORDER_CONSTANT))

    count = np.maximum(total(weight, one, one), 1)
    mean_x, mean_y, mean_xx, mean_xy, mean_yy = (
        total(weight, *along) / count
        for along in ((ramp, one), (one, ramp), (ramp**2, one), (ramp, ramp), (one, ramp**2))
    )
    mean, mean_dx, mean_dy = (total(level, *along) / count for along in ((one, one), (ramp, one), (one, ramp)))
    mean_dd = total(level * level, one, one) / count
    tilt = np.float32(_PLANE_TILT)
    xx, yy, xy = mean_xx - mean_x**2 + tilt, mean_yy - mean_y**2 + tilt, mean_xy - mean_x * mean_y
    dx, dy = mean_dx - mean * mean_x, mean_dy - mean * mean_y
    scale = 1 / np.maximum(xx * yy - xy * xy, tilt * tilt)
    slope_x, slope_y = scale * (yy * dx - xy * dy), scale * (xx * dy - xy * dx)
    here = mean - slope_x * mean_x - slope_y * mean_y
    spread_px = np.sqrt(np.maximum(mean_dd - mean * mean - slope_x * dx - slope_y * dy, 0))
    return [np.tanh((level - here) / 2), np.log1p(spread_px), np.tanh(2 * slope_x), np.tanh(2 * slope_y)]


def _of_place(filled: Floats, known: NDArray[np.bool_], columns: Floats, stride: int, width: int) -> Planes:
    """Is something nearer seen at the same place of view 1, does it leave the view, and how far are the borders?"""
    partner = columns - filled
    cell = np.clip(np.rint(partner / stride), 0, filled.shape[1] - 1).astype(np.int64)
    inside = known & (partner >= 0) & (partner <= width - 1)
    rows = np.broadcast_to(np.arange(len(filled))[:, None], filled.shape)
    nearest = np.full(filled.shape, -np.inf, np.float32)
    np.maximum.at(nearest, (rows[inside], cell[inside]), filled[inside])
    hidden = np.where(inside, nearest[rows, cell] - filled, np.float32(0))
    place = np.broadcast_to(columns, filled.shape)
    to_border = np.minimum(place, width - 1 - place)
    return [
        np.tanh(hidden / 2).astype(np.float32),
        inside.astype(np.float32),
        np.clip(partner, -_FAR_PX, _FAR_PX) / _FAR_PX,
        np.clip(place, 0, _FAR_PX) / _FAR_PX,
        np.clip(to_border, 0, _FAR_PX) / _FAR_PX,
    ]


def _of_costs(
    filled: Floats,
    known: NDArray[np.bool_],
    columns: Floats,
    stride: int,
    image0: Gray,
    image1: Gray,
    searched: tuple[int, int],
) -> Planes:
    """The costs in bands of rows, so that memory is bounded: nothing depends on where a band ends."""
    height, width = image0.shape
    rows = max(1, _BAND_BYTES // (NUM_CURVES * searched[1] * width))  # of the grid
    bands = []
    for top in range(0, len(filled), rows):
        part = slice(top, min(top + rows, len(filled)))
        first = max(0, top * stride - HALO_PX) // stride * stride  # a row of the grid
        last = min(height, (part.stop - 1) * stride + 1 + HALO_PX)
        curves = cost_curves(image0[first:last], image1[first:last], *searched, stride)
        skipped = top - first // stride
        shown = curves.of_rows(slice(skipped, skipped + part.stop - top))
        bands.append(_of_curves(filled[part], known[part], columns, stride, shown))
    return [np.concatenate(parts) for parts in zip(*bands, strict=True)]


def _of_curves(filled: Floats, known: NDArray[np.bool_], columns: Floats, stride: int, curves: CostCurves) -> Planes:
    """Per kind of cost: at the estimate and beside it, of its best rivals in both views, and where the winners lie."""
    planes: Planes = []
    width = curves.best[0].shape[1]
    at = slice(None, None, stride)
    count = len(curves.costs[0])
    offset = np.where(known, filled, curves.first) - curves.first
    searched = (offset > -0.5) & (offset < count - 0.5)
    nearest = np.rint(offset).astype(np.int64)
    partner = np.clip(np.rint(columns - filled), 0, width - 1).astype(np.int64)
    rows = np.arange(len(filled))[:, None]
    for costs, best, best1, winner1 in zip(*curves[:4], strict=True):
        on_grid = costs[:, :, at]
        here, before, after = (_interpolate(on_grid, offset + shift) for shift in (0.0, -1.0, 1.0))
        rival = np.full(filled.shape, 255, np.uint8)
        as_good = np.zeros(filled.shape, np.int16)
        limit = np.clip(here + _AS_GOOD, 0, 255).astype(np.uint8)
        winner, least = np.zeros(filled.shape, np.int16), np.full(filled.shape, 255, np.uint8)
        for k in range(count):
            cost = np.ascontiguousarray(on_grid[k])
            np.copyto(winner, k, where=cost < least)
            np.minimum(least, cost, out=least)
            is_rival = np.abs(nearest - k) > _RIVAL_PX
            np.minimum(rival, cost, out=rival, where=is_rival)
            as_good += is_rival & (cost <= limit)
        here = np.where(searched, here, np.float32(255))  # what was not searched is not trusted
        planes += [
            here / 64,
            (here - best[:, at]) / 32,
            np.clip(rival - here, -128, 128) / 32,
            np.log1p(as_good).astype(np.float32),
            (before - here) / 16,
            (after - here) / 16,
            np.tanh(np.abs(winner - offset) / 2).astype(np.float32),
            np.clip(here - best1[rows, partner], -128, 128) / 32,
            np.tanh(np.abs(winner1[rows, partner] - filled) / 2),
        ]
    return planes


def _interpolate(costs: Gray, place: NDArray[np.floating]) -> Floats:
    """(H, W) costs between two disparities, those at the ends beyond them."""
    place = np.clip(place, 0, len(costs) - 1)
    low = np.floor(place).astype(np.int64)
    high = np.minimum(low + 1, len(costs) - 1)
    share = (place - low).astype(np.float32)
    below, above = (np.take_along_axis(costs, k[None], 0)[0].astype(np.float32) for k in (low, high))
    return np.asarray(below + share * (above - below))


def _of_grey(image0: Gray, image1: Gray, filled: Floats, columns: Floats, stride: int) -> Planes:
    """Texture around the pixel, its slope along the row, and the difference of the grey levels at the estimate."""
    levels = image0.astype(np.float32)
    planes: Planes = []
    for box in (5, 15):
        mean, square = (cv2.blur(v, (box, box), borderType=cv2.BORDER_REPLICATE) for v in (levels, levels * levels))
        spread = np.sqrt(np.maximum(square - mean * mean, 0))
        planes.append(np.log1p(spread[::stride, ::stride]))
        if box == 15:
            planes.append(np.clip((levels - mean) / (spread + 4), -3, 3)[::stride, ::stride])
    slope = cv2.Sobel(levels, cv2.CV_32F, 1, 0, ksize=3, borderType=cv2.BORDER_REPLICATE)[::stride, ::stride] / 8
    planes.append(np.log1p(np.abs(slope)))
    rows = np.arange(0, image0.shape[0], stride, dtype=np.float32)[:, None]
    x = (columns - filled).astype(np.float32)
    y = np.broadcast_to(rows, x.shape)
    partner = _remap(image1.astype(np.float32), x, y)
    difference = levels[::stride, ::stride] - partner
    planes.append(np.log1p(np.abs(difference - np.float32(np.median(difference)))))
    return planes


def _of_other(filled: Floats, columns: Floats, disparity1: Floats | None, stride: int) -> Planes:
    """Is there a map of view 1, does it know the partner, and how far are both disparities apart?"""
    if disparity1 is None:
        return [np.zeros_like(filled)] * NUM_OTHER
    rows = np.arange(0, disparity1.shape[0], stride)[:, None]
    partner = np.clip(np.rint(columns - filled), 0, disparity1.shape[1] - 1).astype(np.int64)
    other = disparity1[rows, partner]
    known = np.isfinite(other)
    gap = np.abs(np.where(known, other, filled) - filled)
    return [np.ones_like(filled), known.astype(np.float32), np.tanh(gap).astype(np.float32), np.tanh(gap / 4)]


def _remap(image: Floats, x: Floats, y: Floats) -> Floats:
    return np.asarray(cv2.remap(image, x, np.ascontiguousarray(y), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
