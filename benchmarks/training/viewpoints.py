"""Random viewpoints, from one that is hardly off to any, and the detectors that may still match from there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from shared.homographies import Viewpoint
from tensor_stereo.configs import Detector

Settings: TypeAlias = tuple[tuple[Detector, str, float], ...]

# detector, implementation, share of the variants; none reads a map of disparities
NEAR: Settings = (
    ("sift", "opencv", 0.30),
    ("fast", "opencv", 0.25),
    ("gftt", "opencv", 0.20),
    ("sift", "kornia", 0.10),
    ("gftt", "kornia", 0.12),
    ("surf", "mahotas", 0.03),
)
FAR: Settings = (  # windows neither turn nor scale: they hardly find a correct match
    ("sift", "opencv", 0.74),
    ("sift", "kornia", 0.18),
    ("fast", "opencv", 0.03),
    ("gftt", "opencv", 0.03),
    ("surf", "mahotas", 0.02),
)
_FAR_TURN_DEG, _FAR_TILT_DEG, _FAR_SCALE = 15.0, 40.0, 1.28


def draw_viewpoint(rng: np.random.Generator, shares: Sequence[float]) -> Viewpoint:
    """One of the three kinds below; ``shares`` are their probabilities."""
    return (draw_near, draw_hand_held, draw_far)[rng.choice(3, p=shares)](rng)


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


def choose_settings(turn_deg: float, scale: float, tilt_deg: float = 0.0) -> Settings:
    """Which detectors to draw from, given how far view 1 is turned, scaled and tilted."""
    is_far = abs(turn_deg) > _FAR_TURN_DEG or tilt_deg > _FAR_TILT_DEG or max(scale, 1 / scale) > _FAR_SCALE
    return FAR if is_far else NEAR
