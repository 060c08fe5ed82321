"""Rendered stereo pairs with exact sub-pixel disparity and occlusion.

Every surface is intersected in closed form with the rays of both views, and its procedural texture is evaluated at the
point that a ray meets; no image is ever resampled.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from tensor_stereo.configs import SyntheticConfig
from tensor_stereo.datasets.files import StrPath
from tensor_stereo.datasets.images import write_image
from tensor_stereo.datasets.pfm import write_pfm
from tensor_stereo.datasets.synthetic.scenes import build_scene
from tensor_stereo.datasets.synthetic.surfaces import Scene
from tensor_stereo.datasets.synthetic.textures import Float
from tensor_stereo.types import StereoPair

_DEFAULT_CONFIG = SyntheticConfig()
_SAME_POINT_PX = 1e-6  # rays of both views to one point agree within rounding, 1e-8 px at grazing incidence
_RAYS_AT_ONCE = 65_536  # their arrays stay in the cache


@dataclass(frozen=True, eq=False)
class Rendering:
    """Both views of a scene, (H, W).

    Attributes:
        image0: (1, H, W) uint8, what the sensor of view 0 (left) reads.
        image1: (1, H, W) uint8, view 1; its gain, offset and noise are its own.
        clean0: float32 grey levels of view 0 before gain, offset, noise and rounding.
        clean1: float32 grey levels of view 1, likewise.
        disparity0: float32, x0 - x1 in px at the pixel centres of view 0, also of points that view 1 does not see.
        disparity1: float32, x0 - x1 in px at the pixel centres of view 1.
        occluded0: bool, True where view 1 does not see the point at the pixel centre of view 0: something hides it, or
            it lies to the side of the outermost pixel centres.
        occluded1: bool, True where view 0 does not see the point at the pixel centre of view 1.
    """

    image0: Tensor
    image1: Tensor
    clean0: Tensor
    clean1: Tensor
    disparity0: Tensor
    disparity1: Tensor
    occluded0: Tensor
    occluded1: Tensor


def render_scene(seed: int | tuple[int, ...], config: SyntheticConfig = _DEFAULT_CONFIG) -> Rendering:
    """Render both views of a random scene: slanted planes, round and thin objects, weak and repeated texture.

    Args:
        seed: what scene, textures and noise follow from, and nothing else; equal seeds give equal bits, in any order
            and from any thread. Its last number also picks room, street, shelf or yard in turn, and whether objects
            are darker or brighter than their background.
        config: size and difficulty. Textures are band-limited at 320 x 240 and above.

    Returns:
        Images, exact disparity and exact occlusion of both views, on the CPU. No gradient.

    Raises:
        ValueError: if a seed is negative or missing.

    Example:
        >>> rendering = render_scene((0, 3))
        >>> rendering.disparity1.shape, rendering.disparity1.dtype
        (torch.Size([300, 400]), torch.float32)
    """
    scene_rng, noise_rng, number = _generators(seed)
    scene = build_scene(scene_rng, number, config)
    clean0, clean1 = _integrate(scene, 0, config), _integrate(scene, 1, config)
    image0 = _expose(noise_rng, clean0, config.noise_levels, gain=1.0, offset_levels=0.0)
    image1 = _expose(noise_rng, clean1, config.noise_levels, gain=config.gain, offset_levels=config.offset_levels)
    disparity0, occluded0 = _measure(scene, 0, config)
    disparity1, occluded1 = _measure(scene, 1, config)
    return Rendering(
        image0=torch.from_numpy(image0)[None],
        image1=torch.from_numpy(image1)[None],
        clean0=torch.from_numpy(clean0),
        clean1=torch.from_numpy(clean1),
        disparity0=torch.from_numpy(disparity0),
        disparity1=torch.from_numpy(disparity1),
        occluded0=torch.from_numpy(occluded0),
        occluded1=torch.from_numpy(occluded1),
    )


def render_pair(
    seed: int | tuple[int, ...], config: SyntheticConfig = _DEFAULT_CONFIG, *, name: str = ""
) -> StereoPair:
    """Render one pair with ground truth for view 0; seeds, settings and errors as in :func:`render_scene`.

    Args:
        seed: what the pair follows from.
        config: size and difficulty.
        name: of the pair; made from ``seed`` when empty.

    Returns:
        The pair on the CPU: one channel, disparity known everywhere.

    Example:
        >>> pair = render_pair((0, 3))
        >>> pair.name, pair.image0.shape
        ('synthetic-0-3', torch.Size([1, 300, 400]))
    """
    rendering = render_scene(seed, config)
    return StereoPair(
        name=name or "-".join(["synthetic", *map(str, _numbers(seed))]),
        image0=rendering.image0,
        image1=rendering.image1,
        disparity_gt=rendering.disparity0,
        occluded=rendering.occluded0,
        dataset="synthetic",
    )


class SyntheticDataset(Dataset[StereoPair]):
    """Map-style data set of rendered pairs, each rendered at every access; pair k follows from (seed, k) alone.

    Args:
        num_pairs: length.
        seed: of the whole set.
        config: size and difficulty.

    Raises:
        ValueError: if ``num_pairs`` or ``seed`` is negative.

    Example:
        >>> dataset = SyntheticDataset(2)
        >>> [dataset[k].name for k in range(len(dataset))]
        ['synthetic-00', 'synthetic-01']
    """

    def __init__(self, num_pairs: int = 8, *, seed: int = 0, config: SyntheticConfig = _DEFAULT_CONFIG) -> None:
        if num_pairs < 0:
            raise ValueError(f"num_pairs must not be negative, got {num_pairs}")
        _numbers(seed)
        self.num_pairs = num_pairs
        self.seed = seed
        self.config = config

    def __len__(self) -> int:
        return self.num_pairs

    def __getitem__(self, index: int) -> StereoPair:
        k = operator.index(index)
        if not -self.num_pairs <= k < self.num_pairs:
            raise IndexError(f"index must lie within the {self.num_pairs} pairs, got {index}")
        k %= self.num_pairs
        return render_pair((self.seed, k), self.config, name=f"synthetic-{k:02d}")


def write_synthetic(
    folder: StrPath, num_pairs: int = 8, *, seed: int = 0, config: SyntheticConfig = _DEFAULT_CONFIG
) -> Path:
    """Write rendered pairs as PNG images and PFM maps, with the list of them that a manifest is built from.

    Args:
        folder: made if it is not there.
        num_pairs: pairs of :class:`SyntheticDataset` to write.
        seed: of that set.
        config: of that set.

    Returns:
        ``folder/synthetic.csv``, for :func:`tensor_stereo.datasets.build_manifest`.

    Raises:
        OSError: if a file cannot be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_synthetic(folder, 1).read_text().splitlines()[1]
        'synthetic-00,synthetic-00-0.png,synthetic-00-1.png,synthetic-00.pfm'
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["scene,image0,image1,disparity_gt"]
    dataset = SyntheticDataset(num_pairs, seed=seed, config=config)
    for pair in (dataset[k] for k in range(num_pairs)):
        names = [f"{pair.name}-0.png", f"{pair.name}-1.png", f"{pair.name}.pfm"]
        for name, image in zip(names, (pair.image0, pair.image1), strict=False):
            write_image(folder / name, image)
        if pair.disparity_gt is not None:
            write_pfm(folder / names[2], pair.disparity_gt.numpy())
        lines.append(",".join([pair.name, *names]))
    path = folder / "synthetic.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _numbers(seed: int | tuple[int, ...]) -> tuple[int, ...]:
    numbers = tuple(operator.index(number) for number in (seed if isinstance(seed, tuple) else (seed,)))
    if not numbers or min(numbers) < 0:
        raise ValueError(f"seed must be one or more numbers that are not negative, got {seed}")
    return numbers


def _generators(seed: int | tuple[int, ...]) -> tuple[np.random.Generator, np.random.Generator, int]:
    """Independent generators of the scene and of the noise, and the number of the scene."""
    numbers = _numbers(seed)
    # the length sets (0,) apart from (0, 0), which a seed sequence pads with zeros
    scene, noise = np.random.SeedSequence([*numbers, len(numbers)]).spawn(2)
    return np.random.default_rng(scene), np.random.default_rng(noise), numbers[-1]


def _integrate(scene: Scene, view: int, config: SyntheticConfig) -> NDArray[np.float32]:
    """(H, W) grey levels of one view: the mean over a square grid of rays through each pixel, as a sensor collects."""
    n, width = config.samples_per_px, config.width_px
    offset = (1 / n - 1) / 2  # of a pixel's first ray from its centre
    x = (np.arange(width * n, dtype=np.float32) / n + offset).astype(np.float32)
    num_rows = max(1, _RAYS_AT_ONCE // (n * len(x)))
    bands = []
    for top in range(0, config.height_px, num_rows):
        height = min(num_rows, config.height_px - top)
        y = (top + np.arange(height * n) / n + offset).astype(np.float32)
        rays = np.tile(x, len(y)), y.repeat(len(x))
        levels = scene.shade(view, *rays, *scene.trace(view, *rays))
        bands.append(levels.reshape(height, n, width, n).mean((1, 3)))
    return np.concatenate(bands)


def _measure(scene: Scene, view: int, config: SyntheticConfig) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(H, W) disparity at the pixel centres of one view, and whether the other view misses the points."""
    shape = config.height_px, config.width_px
    y, x = (grid.ravel().astype(np.float64) for grid in np.indices(shape))
    disparity, _ = scene.trace(view, x, y)
    other_x = x + disparity if view else x - disparity
    other, _ = scene.trace(1 - view, other_x, y)
    hidden = np.abs(other - disparity) > _SAME_POINT_PX
    outside = (other_x < 0) | (other_x > config.width_px - 1)
    return disparity.astype(np.float32).reshape(shape), (hidden | outside).reshape(shape)


def _expose(
    rng: np.random.Generator, clean: Float, noise_levels: float, *, gain: float, offset_levels: float
) -> NDArray[np.uint8]:
    levels = gain * clean + offset_levels + rng.normal(0, noise_levels, clean.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)
