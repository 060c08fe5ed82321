"""Two views that need not be rectified, with the truth between them; their matches judged by it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from tensor_stereo.configs import Detector
from tensor_stereo.evaluation import errors_to_partners
from tensor_stereo.types import Matches
from training.putatives import Putatives
from training.scenes import Gray, Scene

Float = NDArray[np.float64]
Settings: TypeAlias = tuple[tuple[Detector, str, float], ...]

# detector, implementation, share of the variants; none uses a map of disparities
NEAR: Settings = (
    ("sift", "opencv", 0.30),
    ("fast", "opencv", 0.25),
    ("gftt", "opencv", 0.20),
    ("sift", "kornia", 0.10),
    ("gftt", "kornia", 0.12),
    ("surf", "mahotas", 0.03),
)
FAR: Settings = (  # windows that do not turn hardly find a correct match
    ("sift", "opencv", 0.74),
    ("sift", "kornia", 0.18),
    ("fast", "opencv", 0.03),
    ("gftt", "opencv", 0.03),
    ("surf", "mahotas", 0.02),
)


class ViewPair(NamedTuple):
    """Grey images (H, W) of two views, of any sizes, and the truth.

    ``locate`` takes points (M, 2) px of view 0 to their partners (M, 2) px of view 1 and to the scale (M,) of view 1
    against view 0 there; NaN where unknown.
    """

    image0: Gray
    image1: Gray
    locate: Callable[[Float], tuple[Float, Float]]


def judge(
    scene: Scene, domain: str, kind: str, pair: ViewPair, matches: Matches, *, fixed: bool, least_error_px: float
) -> Putatives:
    """Putatives with the errors of the matches."""
    partners, scale = (torch.from_numpy(x) for x in pair.locate(matches.keypoints0.numpy()))
    error_px = errors_to_partners(matches, partners, scale)
    images = tuple(torch.from_numpy(x.copy())[None] for x in pair[:2])
    return Putatives(scene.name, domain, kind, fixed, least_error_px, matches, images, error_px)
