"""Disparity maps of many methods, right and wrong, of the scenes that train the confidence network."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from tensor_stereo.dense.matching_costs import cost_curves
from training.matching_network import MatchingNetwork, matching_costs
from training.smooth_maps import filled, guided, planes

Gray = NDArray[np.uint8]
Floats = NDArray[np.float32]
Method = Callable[[Gray, Gray, int], Floats]  # left and right view, number of disparities -> (H, W) px
Costs = Callable[[Gray, Gray, int], Floats]  # likewise -> (K, H, W)
_SPECKLES = {"speckleWindowSize": 100, "speckleRange": 2}


def semi_global(
    left: Gray, right: Gray, count: int, *, block: int, small: int, large: int, mode: int, cleaned: bool
) -> Floats:
    """OpenCV's StereoSGBM, with or without its own tests; NaN where unknown."""
    tests = {"disp12MaxDiff": 1, "uniquenessRatio": 10, **_SPECKLES} if cleaned else {"disp12MaxDiff": 1 << 20}
    matcher = cv2.StereoSGBM.create(0, count, block, small, large, mode=mode, **tests)
    return _compute(matcher, left, right, count)


def block_matching(left: Gray, right: Gray, count: int, *, block: int, cleaned: bool) -> Floats:
    """OpenCV's StereoBM, with or without its own tests."""
    matcher = cv2.StereoBM.create(count, block)
    if cleaned:
        matcher.setUniquenessRatio(15)
        matcher.setSpeckleWindowSize(_SPECKLES["speckleWindowSize"])
        matcher.setSpeckleRange(_SPECKLES["speckleRange"])
        matcher.setDisp12MaxDiff(1)
    else:
        matcher.setUniquenessRatio(0)
        matcher.setTextureThreshold(0)
    return _compute(matcher, left, right, count)


def _compute(matcher: cv2.StereoMatcher, left: Gray, right: Gray, count: int) -> Floats:
    padded = [cv2.copyMakeBorder(view, 0, 0, count, 0, cv2.BORDER_REPLICATE) for view in (left, right)]
    found = matcher.compute(*padded)[:, count:].astype(np.float32) / 16
    return np.where(found >= 0, found, np.nan).astype(np.float32)


def classic_costs(left: Gray, right: Gray, count: int, *, kind: int) -> Floats:
    """(K, H, W) of the census (0) or of the grey levels (1)."""
    return cost_curves(left, right, 0, count).costs[kind].astype(np.float32)


def winner_takes_all(costs: Floats) -> Floats:
    """The least cost of each pixel, to parts of a px by a parabola."""
    best = costs.argmin(0)
    inner = np.clip(best, 1, len(costs) - 2)
    below, here, above = (np.take_along_axis(costs, (inner + k)[None], 0)[0] for k in (-1, 0, 1))
    curve = below - 2 * here + above
    part = np.where(curve > 0, (below - above) / (2 * np.maximum(curve, 1e-6)), 0)
    return np.where(best == inner, best + np.clip(part, -0.5, 0.5), best).astype(np.float32)


def winners(left: Gray, right: Gray, count: int, *, costs: Costs) -> Floats:
    return winner_takes_all(costs(left, right, count))


def guided_winners(left: Gray, right: Gray, count: int, *, costs: Costs) -> Floats:
    return winner_takes_all(guided(costs(left, right, count), left))


def filled_winners(left: Gray, right: Gray, count: int, *, costs: Costs) -> Floats:
    return filled(*both_maps(partial(guided_winners, costs=costs), left, right, count))


def fitted_planes(left: Gray, right: Gray, count: int, *, costs: Costs) -> Floats:
    return planes(winners(left, right, count, costs=costs), left)


_SGBM = partial(semi_global, block=5, small=200, large=800)
_3WAY, _HH = cv2.STEREO_SGBM_MODE_SGBM_3WAY, cv2.STEREO_SGBM_MODE_HH
_CENSUS, _LEVELS = (partial(classic_costs, kind=kind) for kind in (0, 1))
CLASSIC: dict[str, Method] = {
    "sgbm": partial(_SGBM, mode=cv2.STEREO_SGBM_MODE_SGBM, cleaned=False),
    "sgbm, cleaned": partial(_SGBM, mode=cv2.STEREO_SGBM_MODE_SGBM, cleaned=True),
    "sgbm, 3way": partial(semi_global, block=3, small=72, large=288, mode=_3WAY, cleaned=False),
    "sgbm, hh": partial(semi_global, block=7, small=392, large=1568, mode=_HH, cleaned=False),
    "bm": partial(block_matching, block=15, cleaned=False),
    "bm, 9": partial(block_matching, block=9, cleaned=False),
    "bm, cleaned": partial(block_matching, block=15, cleaned=True),
    "census": partial(winners, costs=_CENSUS),
    "levels": partial(winners, costs=_LEVELS),
    "filled": partial(filled_winners, costs=_CENSUS),
    "planes": partial(fitted_planes, costs=_LEVELS),
}
ALTERED = "altered"  # truth, for training only
_FAMILIES = {"census": "wta", "levels": "wta", "network": "network", "filled": "filled", "planes": "filled"}
METHODS = (*CLASSIC, "network", "network, guided")
FAMILIES = ("sgbm", "bm", *dict.fromkeys(_FAMILIES.values()), ALTERED)


def make_methods(network: MatchingNetwork) -> dict[str, Method]:
    """All of ``METHODS``, those of a matching network too."""
    costs = partial(matching_costs, network)
    return CLASSIC | {
        "network": partial(winners, costs=costs),
        "network, guided": partial(guided_winners, costs=costs),
    }


def family(method: str) -> str:
    """Methods that are left out together, one of ``FAMILIES``.

    >>> family("sgbm, hh"), family("census")
    ('sgbm', 'wta')
    """
    name = method.split(",")[0]
    return _FAMILIES.get(name, name)


def both_maps(run: Method, left: Gray, right: Gray, count: int) -> tuple[Floats, Floats]:
    """The maps of view 0 and of view 1, the second from mirrored images."""
    mirrored = run(np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1]), count)
    return run(left, right, count), np.ascontiguousarray(mirrored[:, ::-1])
