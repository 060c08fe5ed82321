"""Real pairs that are not rectified, with depth and camera pose of both views (Ummenhofer et al. 2017).

The truth of a match follows from the depth of view 0 at its keypoint, and only where the depth of view 1 agrees.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from tensor_stereo.configs import MatchingConfig
from training.putatives import FIXED, MIN_MATCHES, Putatives, disturb, draw_config, match
from training.scenes import Scene
from training.view_pairs import (
    Float,
    Located,
    ViewPair,
    change_viewpoint,
    expose_pair,
    frontal_scale,
    judge,
    nearest_pixels,
)
from training.viewpoints import choose_settings, draw_viewpoint

DOMAIN = "views"
VARIANTS = 14
_SHARES = (0.4, 0.5, 0.1)  # of the kinds of viewpoints that change view 1, from near to far
_HIDING = 0.03  # how much nearer what hides a point is at least, relative to its depth
_SMOOTH = 0.02  # relative difference of neighbouring depths between which may be interpolated


class Trust(NamedTuple):
    """How far the truth of a pair reaches."""

    depth: float  # largest relative difference of the depths of one point
    least_error_px: float  # the smallest tolerance that the truth can judge


# Correct matches of SIFT lie up to 2 px off the truth of the first pair. The poses of the second are off: warped onto
# view 0 by the truth, its view 1 fits best 1.8 px from its place, and correct matches lie up to 4 px off.
_TRUST = {"mvs_test_00000": Trust(0.005, 2.0), "sun3d_train_0.1m_to_0.2m_00000": Trust(0.02, 5.0)}


class Camera(NamedTuple):
    """Depth (H, W) before a camera, 0 where unknown; matrix K (3, 3), rotation (3, 3) and shift (3,) from the world."""

    depth: Float
    matrix: Float
    rotation: Float
    shift: Float


def list_view_scenes(training_data: Path) -> list[Scene]:
    """The pairs below the folder of the training data."""
    folders = (training_data / "demon_pairs" / name for name in _TRUST)
    return [Scene(folder.name, DOMAIN, None, folder) for folder in folders if folder.is_dir()]


def find_in_views(scene: Scene, number: int) -> list[Putatives]:
    """Putatives of a pair, which is the ``number``-th scene: three settings both ways, and random variants."""
    trust, found = _TRUST[scene.name], []
    directions = read_directions(scene.source, trust)
    for pair in directions:
        for detector in ("sift", "fast", "gftt"):
            matches = match(*pair[:2], replace(FIXED, detector=detector, matching=MatchingConfig()))
            found.append((f"{detector} {DOMAIN}", pair, matches))
    for variant in range(VARIANTS):
        rng = np.random.default_rng([7, number, variant])
        pair, turn_deg, scale = cut(directions[variant % 2], rng), 0.0, 1.0
        if rng.random() < 0.6:
            viewpoint = draw_viewpoint(rng, _SHARES)
            pair, turn_deg, scale = change_viewpoint(pair, viewpoint), viewpoint.turn_deg, viewpoint.scale
        if rng.random() < 0.5:
            pair = expose_pair(pair, rng)
        config, backend, _ = draw_config(rng, None, choose_settings(turn_deg, scale))
        matches = disturb(match(*pair[:2], config), pair.image1.shape, rng)
        found.append((f"{config.detector}-{backend} {DOMAIN}", pair, matches))
    return [
        judge(scene, DOMAIN, kind, pair, matches, fixed=False, least_error_px=trust.least_error_px)
        for kind, pair, matches in found
        if matches.num_matches >= MIN_MATCHES
    ]


def read_directions(folder: Path, trust: Trust) -> tuple[ViewPair, ViewPair]:
    """View 0 against view 1, and view 1 against view 0."""
    matrix, poses = np.loadtxt(folder / "cam.txt"), np.loadtxt(folder / "poses.txt").reshape(2, 3, 4)
    images = [cv2.imread(str(folder / f"000{view}.jpg"), cv2.IMREAD_GRAYSCALE) for view in (0, 1)]
    depths = [np.load(folder / f"000{view}.npy").astype(np.float64) for view in (0, 1)]
    cameras = [Camera(depth, matrix, pose[:, :3], pose[:, 3]) for depth, pose in zip(depths, poses, strict=True)]
    return _pair(images, cameras, trust), _pair(images[::-1], cameras[::-1], trust)


def cut(pair: ViewPair, rng: np.random.Generator) -> ViewPair:
    """The pair resized, and each view cropped, each with some probability."""
    scale = float(np.exp(rng.uniform(np.log(0.7), np.log(1.5)))) if rng.random() < 0.5 else 1.0
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    corners, images = [], []
    for image in pair[:2]:
        resized = cv2.resize(image, None, fx=scale, fy=scale, interpolation=how)
        part = rng.uniform(0.6, 1, 2) if rng.random() < 0.4 else np.ones(2)
        rows, columns = (part * resized.shape).astype(int)
        y, x = (
            int(rng.integers(0, full - kept + 1)) for full, kept in zip(resized.shape, (rows, columns), strict=True)
        )
        images.append(np.ascontiguousarray(resized[y : y + rows, x : x + columns]))
        corners.append(np.array([x, y]))

    def locate(points: Float) -> Located:
        whole = pair.locate((points + corners[0] + 0.5) / scale - 0.5)
        return whole._replace(partners=(whole.partners + 0.5) * scale - 0.5 - corners[1])

    return ViewPair(*images, locate)


def _pair(images: list, cameras: list[Camera], trust: Trust) -> ViewPair:
    camera0, camera1 = cameras
    rotation = camera1.rotation @ camera0.rotation.T
    shift = camera1.shift - rotation @ camera0.shift
    forward = float((-rotation.T @ shift)[2])  # where camera 1 stands along the axis of camera 0

    def locate(points: Float) -> Located:
        depth0 = _sample_depth(camera0.depth, points)
        rays = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(camera0.matrix).T
        there = (rays * depth0[:, None]) @ rotation.T + shift
        there[there[:, 2] <= 0] = np.nan
        partners = (there @ camera1.matrix.T)[:, :2] / there[:, 2:]
        height, width = camera1.depth.shape
        inside = ((partners > -0.5) & (partners < np.array([width, height]) - 0.5)).all(1)
        x, y = nearest_pixels(np.where(inside[:, None], partners, 0), camera1.depth.shape)
        nearer = 1 - camera1.depth[y, x] / there[:, 2]  # 1 where unknown
        hidden = inside & (nearer > _HIDING) & (nearer < 1)
        partners[inside & ~hidden & ~(np.abs(nearer) <= trust.depth)] = np.nan
        return Located(partners, frontal_scale(depth0, there[:, 2], forward), hidden)

    return ViewPair(*images, locate)


def _sample_depth(depth: Float, points: Float) -> Float:
    """(M,) depth at points, NaN where unknown: between smooth neighbours that of a plane, else that of the nearest."""
    x, y = nearest_pixels(points, depth.shape)
    nearest = depth[y, x]
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0).astype(np.float32)
    places = points.astype(np.float32)[None]
    between = cv2.remap(inverse, places, None, cv2.INTER_LINEAR)[0].astype(np.float64)
    spread = cv2.dilate(depth, np.ones((3, 3))) / np.maximum(cv2.erode(depth, np.ones((3, 3))), 1e-9) - 1
    smooth = (spread[y, x] < _SMOOTH) & (between > 0)
    found = np.where(smooth, 1 / np.where(smooth, between, 1), nearest)
    return np.where(nearest > 0, found, np.nan)
