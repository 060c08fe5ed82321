"""Two views that need not be rectified, with the truth between them; their matches judged by it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from shared.homographies import Viewpoint, local_scale, transform
from tensor_stereo.evaluation import errors_to_partners
from tensor_stereo.scores.tolerance import TOLERANCES_PX
from tensor_stereo.types import Matches
from training.alterations import expose
from training.putatives import Putatives
from training.scenes import Gray, Scene, Views

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]


class Located(NamedTuple):
    """Where points of view 0 truly are in view 1; NaN where unknown."""

    partners: Float  # (M, 2) px of view 1
    scale: Float  # (M,) of view 1 against view 0 there
    hidden: Bool  # (M,) something in front hides the partner


class ViewPair(NamedTuple):
    """Grey images (H, W) of two views, of any sizes, and what locates points (M, 2) px of view 0."""

    image0: Gray
    image1: Gray
    locate: Callable[[Float], Located]


def pair_rectified(views: Views) -> ViewPair:
    """Rectified views as a pair; the disparity at the nearest pixel counts."""

    def locate(points: Float) -> Located:
        x, y = nearest_pixels(points, views.disparity0.shape)
        disparity = views.disparity0[y, x].astype(np.float64)
        disparity[~np.isfinite(disparity)] = np.nan
        partners = points - np.stack([disparity, np.zeros_like(disparity)], 1)
        return Located(partners, np.ones(len(points)), np.zeros(len(points), bool))

    return ViewPair(views.image0, views.image1, locate)


def pair_with_itself(image: Gray) -> ViewPair:
    """An image beside itself, for a viewpoint to change."""

    def locate(points: Float) -> Located:
        return Located(points, np.ones(len(points)), np.zeros(len(points), bool))

    return ViewPair(image, image, locate)


def change_viewpoint(pair: ViewPair, viewpoint: Viewpoint) -> ViewPair:
    """The pair with view 1 as it looks from another viewpoint, by a homography of its image."""
    matrix = viewpoint.homography(pair.image1.shape)

    def locate(points: Float) -> Located:
        before = pair.locate(points)
        scale = before.scale * local_scale(matrix, before.partners)
        return before._replace(partners=transform(matrix, before.partners), scale=scale)

    return ViewPair(pair.image0, viewpoint.show(pair.image1), locate)


def expose_pair(pair: ViewPair, rng: np.random.Generator, *, least_noise: float = 0.0) -> ViewPair:
    """The pair with other exposure, blur and noise, by :func:`training.alterations.expose`."""
    return ViewPair(*expose(*pair[:2], rng, least_noise=least_noise), pair.locate)


def nearest_pixels(points: Float, shape: tuple[int, ...]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns and rows of the pixels of a map (H, W) that points (M, 2) read."""
    x, y = np.rint(points).astype(np.int64).T
    return x.clip(0, shape[1] - 1), y.clip(0, shape[0] - 1)


def frontal_scale(depth0: Float, depth1: Float, forward: float, zoom: float = 1.0) -> Float:
    """Scale of view 1 against view 0 on small surfaces that face view 0.

    The root of the determinant of the Jacobian of K1 (R + t n' / Z0) K0^-1, the homography of such a plane at depth Z0:
    its determinant is that of (R + t n' / Z0), which is 1 - forward / Z0, over the cube of Z1 / Z0.

    Args:
        depth0: (M,) depth of points before view 0.
        depth1: (M,) depth of the same points before view 1.
        forward: how far camera 1 stands before camera 0, along the axis of camera 0.
        zoom: focal length of view 1 over that of view 0.
    """
    return zoom * np.sqrt(np.abs((1 - forward / depth0) * (depth0 / depth1) ** 3))


def judge(
    scene: Scene, domain: str, kind: str, pair: ViewPair, matches: Matches, *, fixed: bool, least_error_px: float
) -> Putatives:
    """Putatives with the errors of the matches; those that point at a hidden partner are neither right nor wrong."""
    located = pair.locate(matches.keypoints0.numpy())
    error_px = errors_to_partners(matches, torch.from_numpy(located.partners), torch.from_numpy(located.scale))
    error_px[torch.from_numpy(located.hidden) & (error_px <= max(TOLERANCES_PX))] = torch.nan
    images = tuple(torch.from_numpy(x.copy())[None] for x in pair[:2])
    return Putatives(scene.name, domain, kind, fixed, least_error_px, matches, images, error_px)
