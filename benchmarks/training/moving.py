"""Rendered scenes that a camera sees, moves and turns, and sees again; the truth is exact, below the pixel.

The surfaces of the package's synthetic scenes are met in closed form from any pose: they are moved into the frame of
the camera there, in which it is view 0. Light and texture stay with the surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from tensor_stereo.configs import SyntheticConfig
from tensor_stereo.datasets.synthetic.scenes import build_scene
from tensor_stereo.datasets.synthetic.surfaces import Camera, Scene
from training.scenes import Gray
from training.view_pairs import Float, Located, ViewPair, frontal_scale

_SAMPLES = 2  # rays along each axis of a pixel
_NOTHING = 128.0  # grey level where a ray meets no surface
_ROWS_AT_ONCE = 16
_SAME_POINT = 1e-6  # relative difference of the depths of one point
_CLEARANCE = 0.35  # least distance from every surface after the motion, in those before


@dataclass(frozen=True, eq=False)
class Pose:
    """Of the camera of view 1, in the frame of view 0, whose unit is the baseline of the rectified scene.

    Attributes:
        rotation: (3, 3) from the frame of view 0 to that of view 1.
        position: (3,) of the camera.
        zoom: focal length over that of view 0.
        turn_deg: rotation about the line of sight.
    """

    rotation: Float
    position: Float
    zoom: float
    turn_deg: float

    def look(self, scene: Scene) -> Scene:
        """The scene in the frame of the camera."""
        moved = [
            replace(s, center=self.rotation @ (s.center - self.position), axes=s.axes @ self.rotation.T)
            for s in scene.surfaces
        ]
        return Scene(Camera(scene.camera.focal * self.zoom, scene.camera.center), moved)


_HERE = Pose(np.eye(3), np.zeros(3), 1.0, 0.0)


def render_motion(rng: np.random.Generator, number: int, config: SyntheticConfig) -> tuple[ViewPair, Pose]:
    """A scene from two poses, without noise; ``number`` picks its kind, as of the package's rendered scenes."""
    scene = build_scene(rng, number, config)
    pose = draw_pose(rng, scene, config)
    seen, size = pose.look(scene), (config.height_px, config.width_px)

    def locate(points: Float) -> Located:
        before = _unproject(scene.camera, points, _trace(scene, points))
        there = (before - pose.position) @ pose.rotation.T
        there[there[:, 2] <= 0] = np.nan  # behind the camera
        partners = _project(seen.camera, there)
        met = seen.camera.focal / _trace(seen, np.nan_to_num(partners))
        hidden = np.abs(met / there[:, 2] - 1) > _SAME_POINT
        scale = frontal_scale(before[:, 2], there[:, 2], pose.position[2], pose.zoom)
        return Located(partners, scale, hidden)

    return ViewPair(_render(scene, _HERE, size), _render(scene, pose, size), locate), pose


def draw_pose(rng: np.random.Generator, scene: Scene, config: SyntheticConfig) -> Pose:
    """Sideways, forward or both, turned a little in half of the cases, with no surface too close."""
    near, far = config.max_disparity_px, config.min_disparity_px
    kind = rng.choice(["sideways", "forward", "mixed"])
    aside = 0.0 if kind == "forward" else rng.uniform(0.02, 0.25) * config.width_px / near
    ahead = 0.0 if kind == "sideways" else rng.uniform(0.05, 0.35) * rng.choice([-1, 1]) * scene.camera.focal / near
    angle = rng.choice([0, np.pi]) + rng.normal(0, 0.5)
    motion = np.array([aside * np.cos(angle), aside * np.sin(angle), ahead])
    middle = np.array([0.0, 0.0, scene.camera.focal / np.sqrt(near * far)])
    wander = middle[2] * np.tan(np.deg2rad([*rng.normal(0, 3, 2), 0.0]))
    faces_middle, zoom = rng.random() < 0.5, np.exp(rng.normal(0, 0.2)) if rng.random() < 0.25 else 1.0
    turn_deg = (rng.normal(0, 3), rng.uniform(-30, 30), rng.uniform(-180, 180))[rng.choice(3, p=(0.5, 0.25, 0.25))]
    for shrink in 0.8 ** np.arange(30):
        position = shrink * motion
        rotation = _face(middle + wander - faces_middle * position, turn_deg)
        pose = Pose(rotation, position, float(zoom), float(turn_deg))
        if _is_clear(scene, pose):
            return pose
    raise ValueError("surfaces are too close to the camera of view 0")


def _face(direction: Float, turn_deg: float) -> Float:
    """Rotation into the frame of a camera that looks along a direction and is turned about it."""
    away = direction / np.linalg.norm(direction)
    right = np.cross((0.0, 1.0, 0.0), away)
    right /= np.linalg.norm(right)
    turn, _ = cv2.Rodrigues(np.array([0.0, 0.0, np.deg2rad(turn_deg)]))
    rotation: Float = turn @ np.stack([right, np.cross(away, right), away])
    return rotation


def _is_clear(scene: Scene, pose: Pose) -> bool:
    """Whether all of every surface stays before the camera, and the camera on its side of whole planes."""
    for before, after in zip(scene.surfaces, pose.look(scene).surfaces, strict=True):
        if before.outline is not None and after.outline is not None:
            left = after.outline[:, 2].min() / before.outline[:, 2].min()
        else:
            left = (before.normal @ (pose.position - before.center)) / -(before.normal @ before.center)
        if left < _CLEARANCE:
            return False
    return True


def _render(scene: Scene, pose: Pose, size: tuple[int, int]) -> Gray:
    """(H, W) mean over a grid of rays through each pixel; a surface shades a point alike from everywhere."""
    (height, width), n, seen = size, _SAMPLES, pose.look(scene)
    offset, bands = (1 / n - 1) / 2, []
    x = np.arange(width * n) / n + offset
    for top in range(0, height, _ROWS_AT_ONCE):
        rows = min(_ROWS_AT_ONCE, height - top)
        y = top + np.arange(rows * n) / n + offset
        rays = np.stack([np.tile(x, len(y)), y.repeat(len(x))], 1)
        disparity, index = seen.trace(0, *rays.T)
        met = np.isfinite(disparity)
        points = _unproject(seen.camera, rays[met], disparity[met]) @ pose.rotation + pose.position
        levels = np.full(len(rays), _NOTHING)
        levels[met] = scene.shade(0, *_project(scene.camera, points).T, scene.camera.focal / points[:, 2], index[met])
        bands.append(levels.reshape(rows, n, width, n).mean((1, 3)))
    return np.clip(np.rint(np.concatenate(bands)), 0, 255).astype(np.uint8)


def _trace(scene: Scene, points: Float) -> Float:
    """(M,) disparity at points (M, 2) in any order."""
    order, found = np.argsort(points[:, 1]), np.empty(len(points))
    found[order] = scene.trace(0, *points[order].T)[0]
    return found


def _unproject(camera: Camera, points: Float, disparity: Float) -> Float:
    rays = np.column_stack([points - camera.center, np.full(len(points), camera.focal)])
    return rays / disparity[:, None]


def _project(camera: Camera, points: Float) -> Float:
    return points[:, :2] / points[:, 2:] * camera.focal + camera.center
