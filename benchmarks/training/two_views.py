"""Putative matches of views that are not rectified, with truth, for the training of the learned score.

Planar pairs show an image and its warp by a homography; turned ones a real left view and the warp of its real right
view. Keypoints are detected and matched again in the warped images, without gates on rows and disparities. Seeds follow
from the variant and from the place of the scene in the list; those of the fixed pairs from the name of the scene.
"""

from __future__ import annotations

import zlib
from dataclasses import replace

import cv2
import numpy as np

from shared.homographies import Viewpoint, local_scale, transform
from tensor_stereo.configs import MatchingConfig
from tensor_stereo.types import Matches
from training.alterations import expose, reshape
from training.putatives import FIXED, MIN_MATCHES, Putatives, disturb, draw_config, match
from training.scenes import Scene, Views, read_views
from training.view_pairs import FAR, NEAR, Float, ViewPair, judge

PLANAR = {"middlebury": 8, "eth3d": 8, "kitti": 1, "rendered": 3, "synthetic": 1}
TURNED = {"middlebury": 8, "eth3d": 8, "kitti": 3, "rendered": 3, "synthetic": 0}
LEAST_NOISE = 1.0  # grey levels, of planar pairs: their views would else share their noise


def find_two_views(scene: Scene, number: int) -> list[Putatives]:
    """All putatives of one scene, which is the ``number``-th."""
    views, found = read_views(scene), []
    if scene.fold is not None:
        found += [
            _find_fixed(scene, views, planar=planar, sift=sift) for planar in (True, False) for sift in (True, False)
        ]
    for variant in range(PLANAR[scene.domain] + TURNED[scene.domain]):
        rng = np.random.default_rng([6, number, variant])
        found.append(_find_variant(scene, views, rng, planar=variant < PLANAR[scene.domain]))
    return [one for one in found if one is not None]


def _find_fixed(scene: Scene, views: Views, *, planar: bool, sift: bool) -> Putatives:
    """Those that cross-validation looks at: SIFT from anywhere, FAST from close by."""
    rng = np.random.default_rng([zlib.crc32(scene.name.encode()), planar, sift])
    viewpoint = draw_far(rng) if planar and sift else draw_hand_held(rng) if sift else draw_near(rng)
    make = warp_left if planar else warp_right
    pair = make(views, viewpoint, rng)
    detector = "sift" if sift else "fast"
    matches = match(*pair[:2], replace(FIXED, detector=detector, matching=MatchingConfig()))
    return _judge(scene, detector, pair, matches, planar=planar, fixed=True)


def _find_variant(scene: Scene, views: Views, rng: np.random.Generator, *, planar: bool) -> Putatives | None:
    altered = reshape(views, rng)
    if not planar and not np.isfinite(altered.disparity0).any():
        return None
    shares = (0.15, 0.15, 0.70) if planar else (0.30, 0.40, 0.30)
    viewpoint = (draw_near, draw_hand_held, draw_far)[rng.choice(3, p=shares)](rng)
    pair = (warp_left if planar else warp_right)(altered, viewpoint, rng)
    config, backend, _ = draw_config(rng, None, FAR if is_far(viewpoint) else NEAR)
    matches = disturb(match(*pair[:2], config), pair.image1.shape, rng)
    if matches.num_matches < MIN_MATCHES:
        return None
    return _judge(scene, f"{config.detector}-{backend}", pair, matches, planar=planar, fixed=False)


def _judge(scene: Scene, detector: str, pair: ViewPair, matches: Matches, *, planar: bool, fixed: bool) -> Putatives:
    domain = "planar" if planar else "turned"
    least_error_px = 0.0 if planar else scene.least_error_px  # a homography is exact
    return judge(scene, domain, f"{detector} {domain}", pair, matches, fixed=fixed, least_error_px=least_error_px)


def draw_near(rng: np.random.Generator) -> Viewpoint:
    """A rig that is hardly off, or a second shot from almost the same place."""
    return Viewpoint(
        turn_deg=rng.normal(0, 2),
        scale=np.exp(rng.normal(0, 0.03)),
        tilt_deg=rng.uniform(0, 8),
        tilt_axis_deg=rng.uniform(0, 360),
        shift=tuple(rng.uniform(-0.04, 0.04, 2)),
    )


def draw_hand_held(rng: np.random.Generator) -> Viewpoint:
    """A camera in somebody's hand."""
    return Viewpoint(
        turn_deg=rng.uniform(-30, 30),
        scale=np.exp(rng.normal(0, 0.12)),
        tilt_deg=rng.uniform(0, 25),
        tilt_axis_deg=rng.uniform(0, 360),
        shift=tuple(rng.uniform(-0.12, 0.12, 2)),
    )


def draw_far(rng: np.random.Generator) -> Viewpoint:
    """Any rotation and any scale from .5 to 2, each in half of the cases; tilts up to 50 degrees."""
    return Viewpoint(
        turn_deg=rng.uniform(-180, 180) if rng.random() < 0.5 else rng.normal(0, 8),
        scale=np.exp(rng.uniform(np.log(0.5), np.log(2)) if rng.random() < 0.5 else rng.normal(0, 0.1)),
        tilt_deg=rng.uniform(0, 50),
        tilt_axis_deg=rng.uniform(0, 360),
        shift=tuple(rng.uniform(-0.2, 0.2, 2)),
    )


def is_far(viewpoint: Viewpoint) -> bool:
    """Whether windows that neither turn nor scale would hardly match."""
    return abs(viewpoint.turn_deg) > 15 or abs(np.log(viewpoint.scale)) > 0.25 or viewpoint.tilt_deg > 40


def warp_left(views: Views, viewpoint: Viewpoint, rng: np.random.Generator) -> ViewPair:
    """View 0 and its warp, each with its own exposure and noise."""
    matrix = viewpoint.homography(views.image0.shape)

    def locate(points: Float) -> tuple[Float, Float]:
        return transform(matrix, points), local_scale(matrix, points)

    warped = viewpoint.show(views.image0)
    if rng.random() < 0.3:
        warped = cv2.GaussianBlur(warped, (0, 0), rng.uniform(0.3, 1.0))
    return ViewPair(*expose(views.image0, warped, rng, least_noise=LEAST_NOISE), locate)


def warp_right(views: Views, viewpoint: Viewpoint, rng: np.random.Generator) -> ViewPair:
    """View 0 and the warp of the rectified view 1; disparity counts at the nearest pixel."""
    matrix = viewpoint.homography(views.image1.shape)

    def locate(points: Float) -> tuple[Float, Float]:
        height, width = views.disparity0.shape
        x, y = np.rint(points).astype(int).clip(0, [width - 1, height - 1]).T
        disparity = np.where(np.isfinite(views.disparity0), views.disparity0, np.nan)[y, x]
        rectified = points - np.stack([disparity, np.zeros(len(points))], 1)
        return transform(matrix, rectified), local_scale(matrix, rectified)

    images = views.image0, viewpoint.show(views.image1)
    return ViewPair(*(expose(*images, rng) if rng.random() < 0.5 else images), locate)
