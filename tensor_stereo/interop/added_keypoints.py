"""Keypoints that repaired and refined matches need, in files whose matches name rows of keypoints.

A partner that has moved, or was searched again, is a keypoint of its own behind those of its image. What else a file
tells of it, such as descriptor, scale or orientation, is that of the keypoint that it was matched with.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from tensor_stereo.interop.verdicts import Array, Float, Improved, Int
from tensor_stereo.scores import Origin

Image = TypeVar("Image", int, str)


class Added(NamedTuple, Generic[Image]):
    """K keypoints behind those of an image.

    Attributes:
        points: (K, 2) px.
        partner: The image of the keypoints that they were matched with.
        rows: (K,) rows of these.
    """

    points: Float
    partner: Image
    rows: Int


class AddedKeypoints(Generic[Image]):
    """Collects the keypoints of all pairs of a file by their image."""

    def __init__(self) -> None:
        self._of_image: dict[Image, list[Added[Image]]] = {}

    def place(self, image: Image, num_known: int, added: Added[Image]) -> Int:
        """Their rows in an image that has ``num_known`` keypoints in the file."""
        if not len(added.points):
            return np.zeros(0, np.int64)
        parts = self._of_image.setdefault(image, [])
        start = num_known + sum(len(part.points) for part in parts)
        parts.append(added)
        return np.arange(start, start + len(added.points))

    def __iter__(self) -> Iterator[tuple[Image, list[Added[Image]]]]:
        yield from self._of_image.items()


class KeptRows(NamedTuple):
    """The kept matches of a pair as rows of the keypoints of both images.

    Attributes:
        rows0: (K,) rows of view 0.
        rows1: (K,) rows of view 1.
        kept: (K,) rows of the improved matches.
    """

    rows0: Int
    rows1: Int
    kept: Int


def place_kept(
    improved: Improved,
    given: tuple[Int, Int],
    keypoints0: Float,
    num_known1: int,
    images: tuple[Image, Image],
    added: AddedKeypoints[Image],
) -> KeptRows:
    """Give the kept matches of a pair rows of both images.

    Args:
        improved: The matches after repair and refinement.
        given: Rows of view 0 and of view 1 of the given matches.
        keypoints0: (N0, 2) px, all keypoints of view 0.
        num_known1: Keypoints of view 1 in the file.
        images: Both images.
        added: Receives the keypoints that view 1 lacks.
    """
    kept = np.flatnonzero(improved.inlier)
    found = improved.take(kept)
    is_given = found.rows >= 0
    rows0, rows1 = (np.zeros(len(kept), np.int64) for _ in range(2))
    rows0[is_given] = given[0][found.rows[is_given]]
    rows0[~is_given] = rows_of(found.keypoints0[~is_given], keypoints0)
    stays = found.origin == int(Origin.GIVEN)
    rows1[stays] = given[1][found.rows[stays]]
    rows1[~stays] = added.place(images[1], num_known1, Added(found.keypoints1[~stays], images[0], rows0[~stays]))
    return KeptRows(rows0, rows1, kept)


def rows_of(points: Float, keypoints: Float) -> Int:
    """The first row of ``keypoints`` at each of some of these places.

    >>> rows_of(np.array([[3.0, 4.0]]), np.array([[1.0, 2.0], [3.0, 4.0], [3.0, 4.0]]))
    array([1])
    """
    both = np.concatenate([keypoints.astype(np.float64), points])
    _, first, inverse = np.unique(both, axis=0, return_index=True, return_inverse=True)
    rows: Int = first[inverse.reshape(-1)[len(keypoints) :]]
    return rows


def extend_rows(values: Array, added: Array) -> Array:
    """The array with more rows behind it, in a type that holds both.

    Half precision, which has no fractions beyond 1024, becomes single, and so do whole numbers.

    >>> extend_rows(np.array([[1, 2]]), np.array([[3.5, 4.0]])).tolist()
    [[1.0, 2.0], [3.5, 4.0]]
    """
    dtype = values.dtype if values.dtype in (np.float32, np.float64) else np.dtype(np.float32)
    return np.concatenate([values.astype(dtype), added.astype(dtype)])
