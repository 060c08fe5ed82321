"""Homographies between two views: built from a viewpoint, applied to images and to points.

A homography (3, 3) takes (x, y, 1) in px of view 0 to view 1, pixel centres at integers.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Gray = NDArray[np.uint8]

FOCAL = 1.2  # focal length in widths of the image
_SMALLER = 0.8  # below this scale the canvas shrinks with the image, so that little of it stays empty


@dataclass(frozen=True)
class Viewpoint:
    """How view 1 looks at the plane that view 0 shows from the front.

    Attributes:
        turn_deg: rotation in the image plane.
        scale: size of things in the middle of the image, against view 0.
        tilt_deg: angle between the line of sight and the normal of the plane.
        tilt_axis_deg: direction of the axis of the tilt in the plane.
        shift: how far the middle moves, in sizes (width, height) of the image.
    """

    turn_deg: float = 0.0
    scale: float = 1.0
    tilt_deg: float = 0.0
    tilt_axis_deg: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)

    def homography(self, size: tuple[int, ...]) -> Float:
        """That of images (height, width) like ``size``; the image of view 1 has the size :meth:`canvas`."""
        axis, tilt, turn = np.deg2rad([self.tilt_axis_deg, self.tilt_deg, self.turn_deg])
        rotation, _ = cv2.Rodrigues(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
        focal = FOCAL * max(size)
        # points (x, y, 0) of the turned plane, seen from the distance of the focal length
        seen = np.diag([1.0, 1.0, 1 / focal]) @ np.column_stack([rotation[:, :2], (0.0, 0.0, focal)])
        c, s = self.scale * np.cos(turn), self.scale * np.sin(turn)
        turned = np.array([(c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)])
        height, width = self.canvas(size)
        target = _middle((height, width)) + np.array(self.shift) * (width, height)
        return _translation(target) @ turned @ seen @ _translation(-_middle(size))

    def canvas(self, size: tuple[int, ...]) -> tuple[int, int]:
        """(height, width) of the image of view 1."""
        scale = self.scale if self.scale < _SMALLER else 1.0
        return round(size[0] * scale), round(size[1] * scale)

    def show(self, image: Gray) -> Gray:
        """The image of view 1; where view 0 ends, it is mirrored."""
        if self.scale < 1:  # what the smaller image cannot show would be noise in it
            image = cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(self.scale**-2 - 1) + 1e-3)
        height, width = self.canvas(image.shape)
        matrix = self.homography(image.shape)
        return cv2.warpPerspective(image, matrix, (width, height), None, cv2.INTER_CUBIC, cv2.BORDER_REFLECT_101)


def transform(matrix: Float, points: Float) -> Float:
    """(M, 2) points of view 1."""
    mapped = points @ matrix[:, :2].T + matrix[:, 2]
    return mapped[:, :2] / mapped[:, 2:]


def local_scale(matrix: Float, points: Float) -> Float:
    """(M,) root of the determinant of the Jacobian at points (M, 2) of view 0."""
    depth = points @ matrix[2, :2] + matrix[2, 2]
    return np.sqrt(np.abs(np.linalg.det(matrix) / depth**3))


def _middle(size: tuple[int, ...]) -> Float:
    return (np.array(size[::-1]) - 1) / 2


def _translation(vector: Float) -> Float:
    matrix = np.eye(3)
    matrix[:2, 2] = vector
    return matrix
