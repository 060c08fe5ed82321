from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from tensor_stereo.delaunay.predicates import incircle, orientation, to_integers
from tests.point_sets import GENERATORS


def _sign(value: Fraction) -> int:
    return (value > 0) - (value < 0)


def _rational(points: np.ndarray) -> list[tuple[Fraction, Fraction]]:
    return [(Fraction(float(x)), Fraction(float(y))) for x, y in points]


def _orientation(points: np.ndarray) -> int:
    (ax, ay), (bx, by), (cx, cy) = _rational(points)
    return _sign((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))


def _incircle(points: np.ndarray) -> int:
    """Sign of the 4 x 4 determinant |x y x2+y2 1|, expanded along its rows."""
    rows = [(x, y, x * x + y * y, Fraction(1)) for x, y in _rational(points)]

    def minor(matrix: list[tuple[Fraction, ...]]) -> Fraction:
        if len(matrix) == 1:
            return matrix[0][0]
        rest = [[row[:k] + row[k + 1 :] for row in matrix[1:]] for k in range(len(matrix))]
        return sum(((-1) ** k * matrix[0][k] * minor(rest[k]) for k in range(len(matrix))), Fraction(0))

    return _sign(minor(rows))


@pytest.mark.parametrize("kind", GENERATORS)
def test_signs_equal_rational_arithmetic(kind: str) -> None:
    rng = np.random.default_rng(7)
    pool = GENERATORS[kind](rng, 30)
    rows = pool[rng.integers(0, len(pool), (4, 150))]  # coincident points included
    assert orientation(*rows[:3]).tolist() == [_orientation(rows[:3, k]) for k in range(rows.shape[1])]
    assert incircle(*rows).tolist() == [_incircle(rows[:, k]) for k in range(rows.shape[1])]


def test_last_bit_decides() -> None:
    a, b = np.array([[0.0, 0.0]]), np.array([[1.0, 1.0]])
    for nudge, expected in ((np.inf, 1), (-np.inf, -1)):
        c = np.array([[3.0, np.nextafter(3.0, nudge)]])
        assert orientation(a, b, c).tolist() == [expected]


def test_integers_keep_ratios() -> None:
    points = np.array([[0.1, -3e50], [0.0, 2.0**-190]])
    scaled = to_integers(points)
    assert all(isinstance(value, int) for value in scaled.ravel())
    factor = Fraction(scaled[0, 0]) / Fraction(0.1)
    assert [Fraction(v) for v in scaled.ravel()] == [factor * Fraction(v) for v in points.ravel()]
