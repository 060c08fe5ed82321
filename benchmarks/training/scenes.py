"""The scenes that train and cross-validate the learned score; the paper's eight are not among them.

Middlebury 2001, 2006 and MiddEval3 (quarter size), ETH3D and KITTI 2015; the rendered pairs of FlyingThings3D, Monkaa
and TartanAir (Mayer et al. 2016, Wang et al. 2020); and this library's own renderings of many sizes.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shared.scenes import EIGHT
from tensor_stereo.configs import SyntheticConfig
from tensor_stereo.datasets import PairFiles, find_pairs, read_disparity_png, read_pair, read_pfm
from tensor_stereo.datasets.synthetic.rendering import render_scene
from tensor_stereo.features import to_gray

Gray = NDArray[np.uint8]

NUM_SYNTHETIC = 80
_DOMAINS = {
    "middlebury-2001": "middlebury",
    "middlebury-2006": "middlebury",
    "middeval3": "middlebury",
    "eth3d": "eth3d",
    "kitti-2015": "kitti",
}
_EXAM = {name.lower() for name in EIGHT} | {"artl"}
KITTI_LEAST_PX = 2.0  # its truth is off by about half a pixel: labels of smaller tolerances are masked
_KITTI_BLOCKS = (range(7), range(7, 18), range(22, 34))  # frames of drives that look alike; the rest is the last fold
FOLDS = (
    ("Aloe", "Midd1", "venus", "Vintage"),
    ("Baby1", "Monopoly", "Plastic", "poster"),
    ("Cloth1", "Lampshade1", "sawtooth", "Recycle", "playground_1l"),
    ("Flowerpots", "Rocks1", "Wood1", "barn1"),
)  # each network of the cross-validation is trained without the scenes, and without the drives, of one fold
NUM_FOLDS = len(FOLDS)


class Views(NamedTuple):
    """Grey images (H, W) uint8 and disparities (H, W) float32 px, NaN where unknown; None if not published."""

    image0: Gray
    image1: Gray
    disparity0: NDArray[np.float32]
    disparity1: NDArray[np.float32] | None


class Scene(NamedTuple):
    """Where a scene comes from.

    ``source`` holds the files of a reader; the paths of left view, right view and truth; the number of a rendering; or
    the folder of two views that are not rectified, which ``view_scenes.py`` lists and reads.
    """

    name: str
    domain: str  # middlebury, eth3d, kitti, rendered, synthetic or views
    fold: int | None  # that leaves it out; None: it is always in training
    source: PairFiles | tuple[Path, Path, Path] | int | Path

    @property
    def least_error_px(self) -> float:
        """The smallest tolerance that the truth can judge."""
        return KITTI_LEAST_PX if self.domain == "kitti" else 0.0


def list_scenes(data: Path, more: Path) -> list[Scene]:
    """All scenes below two folders, without the paper's, and the synthetic ones."""
    scenes = []
    for root in (data, more):
        for files in find_pairs(root):
            domain = _DOMAINS.get(files.dataset)
            if domain is not None and files.scene.lower() not in _EXAM:  # MiddEval3 has some of them, in other sizes
                scenes.append(Scene(files.scene, domain, fold_of(files.scene), files))
    scenes += [Scene(*found) for found in _rendered(more)]
    scenes += [Scene(f"synthetic-{k}", "synthetic", None, k) for k in range(NUM_SYNTHETIC)]
    return scenes


def read_views(scene: Scene) -> Views:
    if isinstance(scene.source, int):
        return _render(scene.source)
    if isinstance(scene.source, tuple):
        left, right, truth = scene.source
        disparity0 = np.load(truth) if truth.suffix == ".npy" else read_pfm(truth)
        return Views(*(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in (left, right)), np.abs(disparity0), None)
    files, pair = scene.source, read_pair(scene.source)
    gray0, gray1 = (to_gray(image[None])[0, 0].numpy() for image in (pair.image0, pair.image1))
    twin = {"disp1.png": "disp5.png", "disp2.png": "disp6.png"}.get(files.disparity_gt.name)
    disparity1 = None if twin is None else read_disparity_png(files.disparity_gt.with_name(twin), files.gt_scale)
    return Views(gray0, gray1, pair.disparity_gt.numpy(), disparity1)


def fold_of(name: str) -> int | None:
    """The fold that leaves a scene out; None if it is always in training.

    >>> fold_of("Aloe"), fold_of("000040_10"), fold_of("synthetic-3")
    (0, 3, None)
    """
    frame = re.fullmatch(r"(\d{6})_10", name)
    if frame is not None:
        number = int(frame[1])
        return next((k for k, block in enumerate(_KITTI_BLOCKS) if number in block), len(_KITTI_BLOCKS))
    return next((k for k, names in enumerate(FOLDS) if name in names), None)


def _rendered(root: Path) -> list[tuple[str, str, None, tuple[Path, Path, Path]]]:
    found = []
    for truth in sorted((root / "sceneflow").rglob("disparity/left/*.pfm")):
        views = [truth.parents[2] / side / f"{truth.stem}.png" for side in ("left", "right")]
        name = "-".join([*truth.relative_to(root).parts[1:3], truth.stem])
        found.append((name, "rendered", None, (*views, truth)))
    for truth in sorted((root / "tartanair").rglob("*_left_disp.npy")):
        left = truth.with_name(truth.name.replace("_disp.npy", ".png"))
        views = [left, left.with_name(left.name.replace("left", "right"))]
        found.append((f"tartanair-{truth.stem[:6]}", "rendered", None, (*views, truth)))
    return found


def draw_synthetic_config(rng: np.random.Generator) -> SyntheticConfig:
    """Random size and difficulty of a rendering."""
    width = int(rng.choice([400, 450, 520, 640, 800]))
    nearest = float(rng.uniform(2, 14))
    return SyntheticConfig(
        width_px=width,
        height_px=int(width * rng.uniform(0.7, 0.85)),
        min_disparity_px=nearest,
        max_disparity_px=nearest + float(rng.uniform(0.06, 0.24)) * width,
        noise_levels=float(rng.uniform(0.5, 4)),
        gain=float(rng.uniform(0.85, 1.15)),
        offset_levels=float(rng.uniform(-8, 8)),
    )


def _render(number: int) -> Views:
    scene = render_scene((77, number), draw_synthetic_config(np.random.default_rng([77, number])))
    return Views(
        scene.image0[0].numpy(), scene.image1[0].numpy(), scene.disparity0.numpy(), scene.disparity1.numpy()
    )  # fmt: skip
