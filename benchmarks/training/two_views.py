"""Putative matches of views that are not rectified, with truth, for the training of the learned score.

Planar pairs show an image and its warp by a homography; turned ones a real left view and the warp of its real right
view; moving ones a rendered scene from two places. Real pairs with depth come from ``view_scenes.py``. Keypoints are
detected and matched again in the new images, without gates on rows and disparities. Seeds follow from the variant and
from the place of the scene in the list; those of the fixed pairs from the name of the scene.
"""

from __future__ import annotations

import zlib
from dataclasses import replace

import cv2
import numpy as np

from shared.homographies import Viewpoint
from tensor_stereo.configs import Detector, MatchingConfig
from training.alterations import reshape
from training.moving import render_motion
from training.putatives import FIXED, MIN_MATCHES, Putatives, disturb, draw_config, match
from training.scenes import Scene, Views, draw_synthetic_config, read_views
from training.view_pairs import ViewPair, change_viewpoint, expose_pair, judge, pair_rectified, pair_with_itself
from training.view_scenes import DOMAIN as VIEWS
from training.view_scenes import find_in_views
from training.viewpoints import choose_settings, draw_far, draw_hand_held, draw_near, draw_viewpoint

PLANAR = {"middlebury": 8, "eth3d": 8, "kitti": 1, "rendered": 3, "synthetic": 1}
TURNED = {"middlebury": 8, "eth3d": 8, "kitti": 3, "rendered": 3, "synthetic": 0}
MOVING = {"synthetic": 4}
_SHARES = {"planar": (0.15, 0.15, 0.70), "turned": (0.30, 0.40, 0.30)}  # of the kinds of viewpoints, from near to far
_LEAST_NOISE = 1.0  # grey levels, of planar pairs: their views would else share their noise


def find_two_views(scene: Scene, number: int) -> list[Putatives]:
    """All putatives of one scene, which is the ``number``-th."""
    if scene.domain == VIEWS:
        return find_in_views(scene, number)
    views, found = read_views(scene), []
    if scene.fold is not None:
        for domain in ("planar", "turned"):
            found += [_find_fixed(scene, views, domain, detector) for detector in ("sift", "fast")]
    domains = ["planar"] * PLANAR[scene.domain] + ["turned"] * TURNED[scene.domain]
    for variant, domain in enumerate(domains):
        rng = np.random.default_rng([6, number, variant])
        found += _find_variant(scene, reshape(views, rng), domain, rng)
    for variant in range(MOVING.get(scene.domain, 0)):
        found += _find_moving(scene, np.random.default_rng([8, number, variant]), number + variant)
    return found


def _find_fixed(scene: Scene, views: Views, domain: str, detector: Detector) -> Putatives:
    """One of those that cross-validation looks at: SIFT from anywhere or by hand, FAST from close by."""
    rng = np.random.default_rng([zlib.crc32(scene.name.encode()), domain == "planar", detector == "sift"])
    draw = draw_near if detector == "fast" else draw_far if domain == "planar" else draw_hand_held
    pair = _make_pair(views, domain, draw(rng), rng)
    matches = match(*pair[:2], replace(FIXED, detector=detector, matching=MatchingConfig()))
    least_error_px = _least_error_px(scene, domain)
    return judge(scene, domain, f"{detector} {domain}", pair, matches, fixed=True, least_error_px=least_error_px)


def _find_variant(scene: Scene, views: Views, domain: str, rng: np.random.Generator) -> list[Putatives]:
    """One of the others; none if it has hardly a match."""
    if domain == "turned" and not np.isfinite(views.disparity0).any():
        return []
    viewpoint = draw_viewpoint(rng, _SHARES[domain])
    pair = _make_pair(views, domain, viewpoint, rng)
    settings = choose_settings(viewpoint.turn_deg, viewpoint.scale, viewpoint.tilt_deg)
    config, backend, _ = draw_config(rng, None, settings)
    matches = disturb(match(*pair[:2], config), pair.image1.shape, rng)
    if matches.num_matches < MIN_MATCHES:
        return []
    kind, least_error_px = f"{config.detector}-{backend} {domain}", _least_error_px(scene, domain)
    return [judge(scene, domain, kind, pair, matches, fixed=False, least_error_px=least_error_px)]


def _find_moving(scene: Scene, rng: np.random.Generator, number: int) -> list[Putatives]:
    """One of a scene of its own that a camera sees from two places; none if it has hardly a match."""
    pair, pose = render_motion(rng, number, draw_synthetic_config(rng))
    pair = expose_pair(pair, rng, least_noise=_LEAST_NOISE / 2)
    config, backend, _ = draw_config(rng, None, choose_settings(pose.turn_deg, pose.zoom))
    matches = disturb(match(*pair[:2], config), pair.image1.shape, rng)
    if matches.num_matches < MIN_MATCHES:
        return []
    return [
        judge(scene, "moving", f"{config.detector}-{backend} moving", pair, matches, fixed=False, least_error_px=0.0)
    ]


def _make_pair(views: Views, domain: str, viewpoint: Viewpoint, rng: np.random.Generator) -> ViewPair:
    """View 0 and the warp of itself, or of view 1, with exposure, blur and noise."""
    pair = change_viewpoint(pair_with_itself(views.image0) if domain == "planar" else pair_rectified(views), viewpoint)
    if domain == "turned":
        return expose_pair(pair, rng) if rng.random() < 0.5 else pair
    if rng.random() < 0.3:
        pair = pair._replace(image1=cv2.GaussianBlur(pair.image1, (0, 0), rng.uniform(0.3, 1.0)))
    return expose_pair(pair, rng, least_noise=_LEAST_NOISE)


def _least_error_px(scene: Scene, domain: str) -> float:
    return 0.0 if domain == "planar" else scene.least_error_px  # a homography is exact
