"""Random point sets with the degeneracies that break geometric code."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Generator = Callable[[np.random.Generator, int], np.ndarray]


def _rotated(points: np.ndarray, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, -s], [s, c]]).T


def _line(rng: np.random.Generator, n: int, slope: float, offset: float) -> np.ndarray:
    x = rng.integers(0, 4 * n, n).astype(float)
    return np.stack([x, slope * x + offset], 1)


def _circle(rng: np.random.Generator, n: int) -> np.ndarray:
    angle = rng.random(n) * 2 * np.pi
    return np.stack([np.cos(angle), np.sin(angle)], 1)


def _parabola_facing_line(rng: np.random.Generator, n: int) -> np.ndarray:
    x = np.linspace(-1, 1, n - n // 2)
    return np.concatenate([np.stack([x, x * x + 1], 1), np.stack([np.linspace(-1, 1, n // 2), np.zeros(n // 2)], 1)])


def _exact_circle(rng: np.random.Generator, n: int) -> np.ndarray:
    """Integer points on the circle of radius 65, which has 36 of them."""
    grid = np.arange(-65, 66)
    x, y = np.meshgrid(grid, grid)
    on = np.stack([x, y], -1)[x * x + y * y == 65 * 65].astype(float)
    return on[rng.permutation(len(on))[:n]]


GENERATORS: dict[str, Generator] = {
    "uniform": lambda rng, n: rng.random((n, 2)) * 640,
    "integers": lambda rng, n: rng.integers(0, 640, (n, 2)).astype(float),
    "dense_integers": lambda rng, n: rng.integers(0, int(n**0.5) + 2, (n, 2)).astype(float),
    "grid_8px": lambda rng, n: 8.0 * rng.integers(0, int(n**0.5) + 2, (n, 2)),
    "grid_tenth": lambda rng, n: 0.1 * rng.integers(0, int(n**0.5) + 2, (n, 2)),
    "rotated_grid": lambda rng, n: _rotated(rng.integers(0, int(n**0.5) + 2, (n, 2)).astype(float), 0.5),
    "collinear": lambda rng, n: _line(rng, n, 2.0, 1.0),
    "nearly_collinear": lambda rng, n: _line(rng, n, 0.3, 0.1),
    "circle": _circle,
    "exact_circle": _exact_circle,
    "clustered": lambda rng, n: rng.integers(0, 3, (n, 2)) + 1e-9 * rng.random((n, 2)),
    "parabola_facing_line": _parabola_facing_line,
    "ulps": lambda rng, n: 1 + rng.integers(0, int(n**0.5) + 2, (n, 2)) * 2.0**-52,
    "small": lambda rng, n: rng.random((n, 2)) * 1e-50,
    "large": lambda rng, n: rng.random((n, 2)) * 1e50,
    "far_away": lambda rng, n: rng.random((n, 2)) + 1e6,
    "mixed_magnitudes": lambda rng, n: rng.integers(-3, 4, (n, 2)) * 10.0 ** rng.integers(-60, 60, (n, 2)),
}


def distinct_points(name: str, seed: int, n: int) -> np.ndarray:
    """About ``n`` distinct points of one kind, in random order."""
    rng = np.random.default_rng([seed, n])
    return rng.permutation(np.unique(GENERATORS[name](rng, n) + 0.0, axis=0))
