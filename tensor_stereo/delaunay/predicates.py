"""Exact signs of the orientation and in-circle determinants on float64 points, vectorised in NumPy.

A floating-point filter decides almost all rows; the rest is evaluated in integer arithmetic, so every sign is that of
the real-valued determinant of the given doubles. Bounds: Shewchuk, "Adaptive Precision Floating-Point Arithmetic and
Fast Robust Geometric Predicates", Discrete & Computational Geometry 18 (1997), sections 4.2 and 4.4.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Sign = NDArray[np.int8]

EPSILON = 2.0**-53
ORIENTATION_BOUND = (3 + 16 * EPSILON) * EPSILON
INCIRCLE_BOUND = (10 + 96 * EPSILON) * EPSILON


def orientation(a: Float, b: Float, c: Float) -> Sign:
    """Turn of the path a, b, c.

    Args:
        a: (K, 2) float64 points, 0 or 1e-60..1e60 in magnitude.
        b: (K, 2).
        c: (K, 2).

    Returns:
        (K,) int8: 1 counter-clockwise in a frame with y upwards, -1 clockwise, 0 collinear.

    Example:
        >>> import numpy as np
        >>> o, x, y = np.zeros((1, 2)), np.array([[1.0, 0.0]]), np.array([[0.1, 0.3]])
        >>> orientation(o, x, y), orientation(o, y, y * 2)
        (array([1], dtype=int8), array([0], dtype=int8))
    """
    u, v = a - c, b - c
    left, right = u[:, 0] * v[:, 1], u[:, 1] * v[:, 0]
    determinant = left - right
    bound = ORIENTATION_BOUND * (np.abs(left) + np.abs(right))
    return _decide(determinant, bound, (a, b, c), _exact_orientation)


def incircle(a: Float, b: Float, c: Float, d: Float) -> Sign:
    """Side of the circle through a, b, c on which d lies.

    Args:
        a: (K, 2) float64 points, 0 or 1e-60..1e60 in magnitude; a, b, c counter-clockwise.
        b: (K, 2).
        c: (K, 2).
        d: (K, 2).

    Returns:
        (K,) int8: 1 strictly inside, -1 strictly outside, 0 on the circle.

    Example:
        >>> import numpy as np
        >>> square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])[:, None]
        >>> incircle(*square), incircle(*square[:3], square[3] * 0.9)
        (array([0], dtype=int8), array([1], dtype=int8))
    """
    u, v, w = a - d, b - d, c - d
    ux, uy, vx, vy, wx, wy = u[:, 0], u[:, 1], v[:, 0], v[:, 1], w[:, 0], w[:, 1]
    vw, wv = vx * wy, wx * vy
    wu, uw = wx * uy, ux * wy
    uv, vu = ux * vy, vx * uy
    lift_u, lift_v, lift_w = ux * ux + uy * uy, vx * vx + vy * vy, wx * wx + wy * wy
    determinant = lift_u * (vw - wv) + lift_v * (wu - uw) + lift_w * (uv - vu)
    permanent = (
        (np.abs(vw) + np.abs(wv)) * lift_u + (np.abs(wu) + np.abs(uw)) * lift_v + (np.abs(uv) + np.abs(vu)) * lift_w
    )
    return _decide(determinant, INCIRCLE_BOUND * permanent, (a, b, c, d), _exact_incircle)


def to_integers(points: Float) -> NDArray[np.object_]:
    """Points scaled by one power of two so that all coordinates are Python integers; signs of determinants stay."""
    mantissa, exponent = np.frexp(points)
    whole = np.ldexp(mantissa, 53).astype(np.int64)
    shift = np.where(whole == 0, 0, exponent - exponent[whole != 0].min(initial=2000))
    integers: NDArray[np.object_] = whole.astype(object) << shift.astype(object)
    return integers


def _decide(determinant: Float, bound: Float, points: tuple[Float, ...], exact: Any) -> Sign:
    signs = np.sign(determinant).astype(np.int8)
    open_rows = np.flatnonzero(~(np.abs(determinant) > bound))
    if len(open_rows):
        rows = np.stack([p[open_rows] for p in points])  # (3 or 4, K, 2)
        degree = 2 if len(points) == 3 else 4
        hard = ~_is_exact_in_double(rows, degree)
        if hard.any():
            signs[open_rows[hard]] = exact(to_integers(rows[:, hard]))
    return signs


def _is_exact_in_double(rows: Float, degree: int) -> NDArray[np.bool_]:
    """Rows on a grid of spacing 2^k so short that a determinant of this degree is exact in double arithmetic."""
    differences = rows[:-1] - rows[-1]
    mantissa, exponent = np.frexp(rows)
    whole = np.ldexp(mantissa, 53).astype(np.int64)
    low_bit = np.frexp((whole & -whole).astype(np.float64))[1]
    spacing = np.where(whole == 0, 2000, exponent + low_bit).min(axis=(0, 2)) - 54  # log2 of the grid
    extent = np.frexp(np.abs(differences).max(axis=(0, 2)))[1]  # log2, rounded up
    # Degree 2: two products of differences, one more bit for their sum; degree 4: four more bits for the lift,
    # the minor and the sum of three terms.
    result: NDArray[np.bool_] = (extent - spacing) * degree + degree <= 53
    return result


def _exact_orientation(points: NDArray[np.object_]) -> Sign:
    a, b, c = points
    u, v = a - c, b - c
    return _sign_of_integers(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])


def _exact_incircle(points: NDArray[np.object_]) -> Sign:
    a, b, c, d = points
    u, v, w = a - d, b - d, c - d
    lift_u, lift_v, lift_w = (u * u).sum(1), (v * v).sum(1), (w * w).sum(1)
    return _sign_of_integers(
        lift_u * (v[:, 0] * w[:, 1] - v[:, 1] * w[:, 0])
        + lift_v * (w[:, 0] * u[:, 1] - w[:, 1] * u[:, 0])
        + lift_w * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    )


def _sign_of_integers(values: NDArray[np.object_]) -> Sign:
    return (values > 0).astype(np.int8) - (values < 0).astype(np.int8)
