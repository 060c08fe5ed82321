"""Procedural grey textures, functions of continuous surface coordinates in px."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

LATTICE = 64  # cells after which the noise repeats


@dataclass(frozen=True, eq=False)
class Texture:
    """Grey level = base + contrast * (noise + pattern), all smooth and band-limited.

    Attributes:
        base: mean grey level.
        contrast: amplitude of the noise in grey levels.
        wavelengths: px of each octave of lattice noise.
        lattice: (LATTICE, LATTICE) values in -1..1.
        period: px of the repeated pattern in u and v; None for no pattern.
        depth: amplitude of the pattern in grey levels.
    """

    base: float
    contrast: float
    wavelengths: tuple[float, ...]
    lattice: Float
    period: tuple[float, float] | None = None
    depth: float = 0.0

    def __call__(self, u: Float, v: Float) -> Float:
        level = np.full(u.shape, self.base)
        for k, wavelength in enumerate(self.wavelengths):
            amplitude = self.contrast * 0.75**k
            level += amplitude * _lattice_noise(self.lattice, u / wavelength + 7 * k, v / wavelength + 3 * k)
        if self.period is not None:
            waves = np.sin(2 * np.pi * u / self.period[0]) * np.sin(2 * np.pi * v / self.period[1])
            level += self.depth * np.tanh(4 * waves)
        clipped: Float = np.clip(level, 8, 247)
        return clipped


def random_texture(rng: np.random.Generator, kind: str, *, bright: bool) -> Texture:
    """A texture of a kind: ``mixed`` and ``fine`` noise, ``weak`` noise, or a ``repeated`` pattern."""
    lattice = rng.uniform(-1, 1, (LATTICE, LATTICE))
    base = rng.uniform(150, 185) if bright else rng.uniform(60, 95)
    if kind == "mixed":
        return Texture(base, rng.uniform(30, 42), (34.0, 13.0, 6.0, 3.5), lattice)
    if kind == "fine":
        return Texture(base, rng.uniform(30, 45), (9.0, 4.5, 3.0), lattice)
    if kind == "weak":
        return Texture(base, 4.0, (60.0, 9.0), lattice)
    if kind == "repeated":
        period = float(rng.uniform(11, 19)), float(rng.uniform(11, 19))
        return Texture(base, 3.0, (30.0, 7.0), lattice, period, rng.uniform(30, 45))
    raise ValueError(f"kind must be 'mixed', 'fine', 'weak' or 'repeated', got {kind!r}")


def _lattice_noise(lattice: Float, x: Float, y: Float) -> Float:
    """Values at the lattice points, blended with the cubic 3t^2 - 2t^3 in between."""
    column, row = np.floor(x), np.floor(y)
    s, t = x - column, y - row
    s, t = s * s * (3 - 2 * s), t * t * (3 - 2 * t)
    i, j = column.astype(np.int64) % LATTICE, row.astype(np.int64) % LATTICE
    i1, j1 = (i + 1) % LATTICE, (j + 1) % LATTICE
    top = lattice[j, i] * (1 - s) + lattice[j, i1] * s
    bottom = lattice[j1, i] * (1 - s) + lattice[j1, i1] * s
    return top * (1 - t) + bottom * t
