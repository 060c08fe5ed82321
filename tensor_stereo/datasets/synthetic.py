"""Rendered stereo pairs with exact sub-pixel disparity and occlusion.

Every surface is intersected analytically with the rays of both views, and its procedural texture is evaluated at the
point that a ray hits; no image is ever resampled. Disparity d = x0 - x1 is f / Z for focal length f in px and depth Z
in baselines.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from tensor_stereo.configs import SyntheticConfig
from tensor_stereo.datasets.textures import Texture, random_texture
from tensor_stereo.types import StereoPair

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]


class Hit(NamedTuple):
    """Where the rays of some pixels meet a surface."""

    disparity: Float  # px, -inf where the ray misses
    u: Float  # texture coordinates, px of view 0
    v: Float


class Surface(Protocol):
    """Anything that rays of either view can meet."""

    @property
    def texture(self) -> Texture:
        """Grey level at the texture coordinates of a hit."""
        ...

    def hit(self, view: int, x: Float, y: Float) -> Hit:
        """Meet the rays of the pixels (x, y) of one view."""
        ...


@dataclass(frozen=True)
class Card:
    """Slanted planar patch: d = a (x0 - cx) + b (y - cy) + c, a rectangle or ellipse in view 0."""

    texture: Texture
    slant_x: float
    slant_y: float
    disparity: float  # at the centre
    centre: tuple[float, float]
    size: tuple[float, float] = (np.inf, np.inf)
    angle: float = 0.0
    is_ellipse: bool = False

    def hit(self, view: int, x: Float, y: Float) -> Hit:
        cx, cy = self.centre
        disparity = self.slant_x * (x - cx) + self.slant_y * (y - cy) + self.disparity
        if view == 1:  # x is x1; x0 = x1 + d enters its own plane equation
            disparity = disparity / (1 - self.slant_x)
            x = x + disparity
        c, s = np.cos(self.angle), np.sin(self.angle)
        u, v = c * (x - cx) + s * (y - cy), c * (y - cy) - s * (x - cx)
        p, q = np.abs(u) / (self.size[0] / 2), np.abs(v) / (self.size[1] / 2)
        inside = p * p + q * q <= 1 if self.is_ellipse else np.maximum(p, q) <= 1
        return Hit(np.where(inside & (disparity > 0), disparity, -np.inf), u, v)


@dataclass(frozen=True)
class Sphere:
    """Ball given by its image in view 0."""

    texture: Texture
    disparity: float  # of the centre
    centre: tuple[float, float]  # px
    radius: float  # px
    focal: float  # px
    principal: tuple[float, float]

    def hit(self, view: int, x: Float, y: Float) -> Hit:
        depth = self.focal / self.disparity
        scale = depth / self.focal  # baselines per px at the centre's depth
        (px, py), (cx, cy) = self.principal, self.centre
        centre = np.array([(cx - px) * scale - view, (cy - py) * scale, depth])
        radius = self.radius * scale
        rx, ry = (x - px) / self.focal, (y - py) / self.focal  # ray (rx, ry, 1)
        square = rx * rx + ry * ry + 1
        half = rx * centre[0] + ry * centre[1] + centre[2]
        root = half * half - square * (centre @ centre - radius * radius)
        z = (half - np.sqrt(np.maximum(root, 0))) / square
        disparity = np.where(root > 0, self.focal / z, -np.inf)
        nx, ny, nz = (rx * z - centre[0]) / radius, (ry * z - centre[1]) / radius, (z - centre[2]) / radius
        u, v = np.arctan2(nx, -nz) * self.radius, np.arcsin(np.clip(ny, -1, 1)) * self.radius
        return Hit(disparity, u, v)


@dataclass(frozen=True)
class Rendering:
    """Both views of one scene.

    Attributes:
        images: grey (H, W) uint8 of view 0 and 1.
        clean: the same before gain, noise and rounding, in grey levels.
        disparities: (H, W) float64 disparity in px at the pixel centres of view 0 and 1.
        occluded: (H, W) bool, True where the other view does not see the surface point, or it lies outside its image.
    """

    images: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    clean: tuple[Float, Float]
    disparities: tuple[Float, Float]
    occluded: tuple[Bool, Bool]


def render_scene(seed: int | tuple[int, ...], config: SyntheticConfig = SyntheticConfig()) -> Rendering:
    """Render both views of a random scene: slanted planes, spheres, thin poles, weak and repeated texture.

    Args:
        seed: what the scene, its textures and the sensor noise follow from; the same seed gives the same bits.
        config: size and difficulty.

    Returns:
        Images, exact disparity and occlusion of both views.

    Example:
        >>> scene = render_scene(0)
        >>> scene.disparities[0].shape == scene.images[1].shape
        True
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    surfaces = random_surfaces(rng, config)
    clean = tuple(_shade(surfaces, view, config) for view in (0, 1))
    y, x = np.mgrid[: config.height_px, : config.width_px].astype(np.float64)
    disparities = tuple(np.max([s.hit(view, x, y).disparity for s in surfaces], 0) for view in (0, 1))
    occluded = tuple(_occluded(surfaces, view, disparities[view], x, y) for view in (0, 1))
    images = tuple(
        _expose(rng, clean[view], config, gain=1.0 if view == 0 else config.gain, offset=view * config.offset_levels)
        for view in (0, 1)
    )
    return Rendering(images, clean, disparities, occluded)  # type: ignore[arg-type]


def render_pair(
    seed: int | tuple[int, ...], config: SyntheticConfig = SyntheticConfig(), *, name: str = ""
) -> StereoPair:
    """Render one pair with ground truth for view 0; see :func:`render_scene`.

    Example:
        >>> render_pair(0).image0.shape
        torch.Size([1, 300, 400])
    """
    scene = render_scene(seed, config)
    image0, image1 = (torch.from_numpy(image)[None] for image in scene.images)
    return StereoPair(
        name=name or f"synthetic-{seed}",
        image0=image0,
        image1=image1,
        disparity_gt=torch.from_numpy(scene.disparities[0].astype(np.float32)),
        occluded=torch.from_numpy(scene.occluded[0]),
        dataset="synthetic",
    )


class SyntheticDataset:
    """Sequence of rendered pairs, made when asked for; pair k depends on ``seed`` and k alone.

    Args:
        num_pairs: length.
        seed: of the whole set.
        config: size and difficulty.

    Example:
        >>> [pair.name for pair in SyntheticDataset(2)]
        ['synthetic-00', 'synthetic-01']
    """

    def __init__(self, num_pairs: int = 8, *, seed: int = 0, config: SyntheticConfig = SyntheticConfig()) -> None:
        if num_pairs < 0:
            raise ValueError(f"num_pairs must not be negative, got {num_pairs}")
        self.num_pairs = num_pairs
        self.seed = seed
        self.config = config

    def __len__(self) -> int:
        return self.num_pairs

    def __getitem__(self, index: int) -> StereoPair:
        k = operator.index(index)
        if not -self.num_pairs <= k < self.num_pairs:
            raise IndexError(f"index must lie in 0..{self.num_pairs - 1}, got {index}")
        k %= self.num_pairs
        return render_pair((self.seed, k), self.config, name=f"synthetic-{k:02d}")


def random_surfaces(rng: np.random.Generator, config: SyntheticConfig) -> list[Surface]:
    """Background, floor, cards, spheres and poles of one scene; nearer ones hide farther ones."""
    width, height = config.width_px, config.height_px
    near, far = config.max_disparity_px, config.min_disparity_px
    focal, principal = 1.2 * width, ((width - 1) / 2, (height - 1) / 2)

    def spot() -> tuple[float, float]:
        return float(rng.uniform(0.08, 0.92) * width), float(rng.uniform(0.1, 0.85) * height)

    bright_background = rng.random() < 0.5

    def texture(kind: str, is_object: bool = True) -> Texture:
        return random_texture(rng, kind, bright=bright_background != is_object)

    surfaces: list[Surface] = [
        Card(texture("mixed", False), rng.uniform(-0.012, 0.012), rng.uniform(-0.012, 0.012), far + 4, principal),
        Card(
            texture("mixed", False),
            0.0,
            rng.uniform(0.10, 0.16),
            far + 2,
            (principal[0], rng.uniform(0.62, 0.72) * height),
        ),
    ]
    kinds = ["repeated", "weak", "fine", "mixed", "fine", "mixed"]
    for k, kind in enumerate(kinds):
        depth = far + (near - far) * (k + rng.uniform(0.2, 0.9)) / (len(kinds) + 1)
        size = rng.uniform(0.14, 0.34) * width, rng.uniform(0.18, 0.42) * height
        slant_x, slant_y = rng.uniform(-0.08, 0.08, 2)
        surfaces.append(
            Card(texture(kind), slant_x, slant_y, depth, spot(), size, rng.uniform(-0.6, 0.6), rng.random() < 0.3)
        )
    for _ in range(2):
        depth, radius = rng.uniform(0.45 * near, 0.9 * near), rng.uniform(0.05, 0.11) * width
        surfaces.append(Sphere(texture("fine"), depth, spot(), radius, focal, principal))
    for _ in range(config.num_poles):
        depth, thickness = rng.uniform(0.5 * near, near), rng.uniform(2, 5)
        size = thickness, rng.uniform(0.4, 0.9) * height
        surfaces.append(
            Card(texture("fine"), 0.0, rng.uniform(-0.03, 0.03), depth, spot(), size, rng.uniform(-0.5, 0.5))
        )
    return surfaces


def _shade(surfaces: list[Surface], view: int, config: SyntheticConfig) -> Float:
    """Grey levels of one view: the mean over a square of samples within each pixel, as a sensor integrates."""
    n = config.samples_per_px
    total = np.zeros((config.height_px, config.width_px))
    offsets = (np.arange(n) + 0.5) / n - 0.5
    for dy in offsets:
        for dx in offsets:
            y, x = np.mgrid[: config.height_px, : config.width_px].astype(np.float64)
            x, y = (x + dx).ravel(), (y + dy).ravel()
            hits = [surface.hit(view, x, y) for surface in surfaces]
            nearest = np.argmax([hit.disparity for hit in hits], axis=0)
            levels = np.zeros(x.size)
            for k, (surface, hit) in enumerate(zip(surfaces, hits, strict=True)):
                seen = nearest == k
                levels[seen] = surface.texture(hit.u[seen], hit.v[seen])
            total += levels.reshape(total.shape)
    return total / n**2


def _occluded(surfaces: list[Surface], view: int, disparity: Float, x: Float, y: Float) -> Bool:
    """Pixels whose surface point the other view does not see."""
    other_x = x - disparity if view == 0 else x + disparity
    nearest = np.max([surface.hit(1 - view, other_x, y).disparity for surface in surfaces], 0)
    outside = (other_x < 0) | (other_x > x.shape[1] - 1)
    hidden: Bool = outside | (nearest > disparity + 1e-6)  # px; the same surface comes back within rounding
    return hidden


def _expose(
    rng: np.random.Generator, clean: Float, config: SyntheticConfig, *, gain: float, offset: float
) -> NDArray[np.uint8]:
    noisy = gain * clean + offset + rng.normal(0, config.noise_levels, clean.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
