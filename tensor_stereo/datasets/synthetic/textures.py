"""Procedural grey textures: periodic lattices of grey levels, blended to smooth functions of surface coordinates.

A large lattice never shows its period within an image; a small one is a repeated texture, the classical trap of stereo.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class Texture:
    """Grey level as a once differentiable function of (u, v).

    Attributes:
        levels: (rows, columns) grey levels at the lattice points; u runs along a row, and both axes wrap around.
        cell: distance of neighbouring lattice points, in the unit of u and v; no detail is finer.

    Example:
        >>> Texture(np.array([[0.0, 100.0]]), cell=2.0)(np.array([0.0, 1.0, 2.0, 4.0]), np.zeros(4))
        array([  0.,  50., 100.,   0.])
    """

    levels: Float
    cell: float

    def __call__(self, u: Float, v: Float) -> Float:
        """Grey levels at points, in their dtype; the cubic 3t^2 - 2t^3 blends the four lattice points around each."""
        rows, columns = self.levels.shape
        flat = self.levels.astype(u.dtype).ravel()
        u, v = u / self.cell, v / self.cell
        left, top = np.floor(u), np.floor(v)
        s, t = u - left, v - top
        s, t = s * s * (3 - 2 * s), t * t * (3 - 2 * t)
        i0, j0 = left.astype(np.int32) % columns, top.astype(np.int32) % rows * columns
        i1, j1 = (i0 + 1) % columns, (j0 + columns) % (rows * columns)
        upper, lower = flat[j0 + i0], flat[j1 + i0]
        upper += s * (flat[j0 + i1] - upper)
        lower += s * (flat[j1 + i1] - lower)
        blended: Float = upper + t * (lower - upper)
        return blended


def make_noise(rng: np.random.Generator, size: int = 128, steps: tuple[int, ...] = (1, 2, 4, 8)) -> Float:
    """(size, size) periodic lattice noise of unit variance; octaves of ``steps`` points, coarser ones stronger.

    Example:
        >>> make_noise(np.random.default_rng(0), size=40).shape
        (40, 40)
    """
    total = np.zeros((size, size))
    for step in steps:
        coarse = rng.standard_normal((-(-size // step),) * 2)
        octave = coarse.repeat(step, 0).repeat(step, 1)[:size, :size]
        for axis in (0, 1):
            octave = np.mean([np.roll(octave, k, axis) for k in range(step)], 0)
        total += step**0.5 * octave / octave.std()
    total /= total.std()
    return total


def make_blobs(rng: np.random.Generator, size: int = 128) -> Float:
    """Noise pressed towards two levels, as camouflage or foliage, in -1..1.

    Example:
        >>> make_blobs(np.random.default_rng(0), size=40).shape
        (40, 40)
    """
    blobs: Float = np.tanh(1.6 * make_noise(rng, size, (1, 3, 6)))
    return blobs


def make_plain(rng: np.random.Generator) -> Float:
    """Almost no texture: stains far below the noise of a sensor, in -0.1..0.1 or so.

    Example:
        >>> make_plain(np.random.default_rng(0)).shape
        (64, 64)
    """
    return 0.04 * make_noise(rng, 64, (4, 16))


def make_wallpaper(rng: np.random.Generator, rows: int, columns: int) -> Float:
    """One mirror-symmetric motif of ``rows`` x 2 ``columns`` points, to be repeated by wrapping, in -1..1.

    Example:
        >>> make_wallpaper(np.random.default_rng(0), 9, 5).shape
        (9, 10)
    """
    half = np.tanh(2 * make_noise(rng, max(rows, columns), (1, 3))[:rows, :columns])
    return np.concatenate([half, half[:, ::-1]], 1)


def make_checker(side: int) -> Float:
    """Squares of ``side`` points, -1 and 1.

    Example:
        >>> make_checker(1)
        array([[-1.,  1.],
               [ 1., -1.]])
    """
    square = np.arange(2 * side) // side
    return np.where(square[:, None] == square, -1.0, 1.0)


def make_bricks(rng: np.random.Generator, spread: float) -> Float:
    """Running bond of 8 x 4 points with light joints; ``spread`` is how much the bricks differ from each other.

    Example:
        >>> make_bricks(np.random.default_rng(0), 0.1).shape
        (128, 128)
    """
    courses, length = 32, 16
    tone = rng.standard_normal((courses, length)) * spread - 0.5
    wall = tone.repeat(4, 0).repeat(8, 1)
    wall[:, ::8] = 1
    wall[::4] = 1
    for course in range(1, courses, 2):
        shifted = slice(4 * course + 1, 4 * course + 4)
        wall[shifted] = np.roll(wall[shifted], 4, 1)
    return wall + spread * make_noise(rng)


def make_windows(rng: np.random.Generator, spread: float) -> Float:
    """Front of a house, dark panes in light frames every 12 x 14 points; ``spread`` is how much the panes differ.

    Example:
        >>> make_windows(np.random.default_rng(0), 0.1).shape
        (112, 120)
    """
    floors, axes = 8, 10
    front = np.zeros((floors, 14, axes, 12))
    front[:, 2:12, :, 2:10] = 1  # frame
    front[:, 3:11, :, 3:9] = -1 + np.abs(spread * rng.standard_normal((floors, 1, axes, 1)))
    front[:, 6] = np.where(front[:, 6] < 0.9, 0.6, front[:, 6])  # transom
    front[:, :2] -= 0.25  # cornice
    return front.reshape(floors * 14, axes * 12) + 0.5 * spread * make_noise(rng, 120)[: floors * 14]


def make_print(rng: np.random.Generator) -> Float:
    """Lines of words on paper: letters 1-2 points wide and 3 high, -1 on 1.

    Example:
        >>> make_print(np.random.default_rng(0)).shape
        (108, 96)
    """
    lines, width = 18, 96
    page = np.ones((lines * 6, width))
    for line in range(lines):
        ink = rng.random((3, width)) < 0.55
        ink &= (rng.random(width // 6) < 0.8).repeat(6) & (np.arange(width) % 6 > 0)  # words and gaps
        page[6 * line + 1 : 6 * line + 4][ink] = -1
    return page


def make_planks(rng: np.random.Generator) -> Float:
    """Boards of 12 points with grain along u, in -1..1 or so.

    Example:
        >>> make_planks(np.random.default_rng(0)).shape
        (120, 240)
    """
    tone = rng.standard_normal(10).repeat(12)[:, None]
    grain = make_noise(rng, 120, (1, 2)).repeat(8, 1)[:, :240]
    for k in range(1, 8):
        grain[:, k::8] += (np.roll(grain[:, ::8], -1, 1) - grain[:, ::8]) * k / 8
    planks = 0.35 * tone + 0.35 * grain
    planks[::12] = -1
    return planks


def make_stripes(rng: np.random.Generator, period: int) -> Float:
    """Upright stripes that repeat after ``period`` points, with a faint weave, in -1..1.

    Example:
        >>> make_stripes(np.random.default_rng(0), 11).shape
        (64, 11)
    """
    edges = rng.random(period) < 0.45
    tones = rng.uniform(-1, 1, period)[np.cumsum(edges) % period]
    return np.tile(tones, (64, 1)) + 0.1 * rng.standard_normal((64, period))
