"""SURF keypoints and descriptors."""

from __future__ import annotations

import numpy as np
import torch
from mahotas.features import surf as mahotas_surf
from numpy.typing import NDArray
from torch import Tensor

from tensor_stereo.configs import SURFConfig
from tensor_stereo.features.images import join_images, map_images, strongest_first, to_gray
from tensor_stereo.types import Features

_SIZE = 64  # 4 x 4 cells of 4 sums
_SCALE_PER_LOBE = 0.4  # SURF's scale is 1.2 at the 9-px filter, which has lobes of 3 px (Bay et al., section 3.3)
_ROUNDING = 1e-9  # relative; responses are sums of some 30 exact terms in float64
_STENCILS = np.array([[0, 1, 0], [-0.5, 0, 0.5], [1, -2, 1]])  # value, slope, curvature at the middle of three samples

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def detect_surf(images: Tensor, config: SURFConfig | None = None) -> Features:
    """Detect maxima of the box-filtered Hessian's determinant and describe them by sums of Haar wavelets.

    Source: Bay, Ess, Tuytelaars, Van Gool, "Speeded-up robust features (SURF)", CVIU 110(3), 2008. Maxima and
    descriptors are mahotas', which takes one image at a time. Its sub-pixel step is repeated here: mahotas (1.4.19)
    adds the offset of the maximum with the wrong sign and takes the curvature in x for that in y, which misplaces a
    keypoint by up to a sampling step (1 px in the first octave, 8 px in the fourth). No gradient.

    Args:
        images: (B, 1, H, W) or (B, 3, H, W), uint8 or floating point in [0, 1], as :func:`to_gray` takes them.
        config: settings; None means the defaults.

    Returns:
        Sub-pixel keypoints, strongest first, equal scores by row, then column; (N, 64) descriptors of unit length;
        ``scores`` is the determinant in mahotas' scale. Only keypoints whose descriptor lies inside the image count,
        so that an image without texture, or with a side below about 60 px, has none.

    Raises:
        ValueError: if ``images`` has another shape, or values outside of [0, 1].
        TypeError: if ``images`` has another dtype.

    >>> y, x = torch.meshgrid(torch.arange(120.0), torch.arange(130.0), indexing="ij")
    >>> blob = torch.exp(-((x - 60.25) ** 2 + (y - 58) ** 2) / 32)
    >>> detect_surf(blob[None, None]).keypoints[0].round(decimals=1).tolist()
    [60.2..., 58.0]
    """
    config = config or SURFConfig()
    gray = to_gray(images)
    detected = map_images(lambda image: _detect(image, config), gray.cpu())
    (keypoints, descriptors, scores), ptr = join_images(detected, [(2,), (_SIZE,), ()], gray.device)
    return Features(keypoints, ptr, descriptors, scores)


def _detect(image: Tensor, config: SURFConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Keypoints (N, 2), descriptors (N, 64), scores (N,) of one (H, W) image on the CPU."""
    integral = mahotas_surf.integral(image.numpy().astype(np.float64))
    points = mahotas_surf.interest_points(
        integral,
        config.num_octaves,
        config.num_scales,
        config.initial_step_px,
        config.threshold,
        is_integral=True,
    )  # (N, 5): y, x, scale, score, sign of the Laplacian
    points = refine_maxima(integral, points, num_octaves=config.num_octaves, initial_step_px=config.initial_step_px)
    described = mahotas_surf.descriptors(integral, points, is_integral=True)  # (N', 6 + 64), fewer at the border
    rows = torch.from_numpy(described).to(torch.float32)
    keypoints, scores = rows[:, [1, 0]], rows[:, 3]
    order = strongest_first(keypoints, scores, config.max_keypoints)
    return keypoints[order], rows[order, 6:], scores[order]


def refine_maxima(integral: Array, points: Array, *, num_octaves: int, initial_step_px: int) -> Array:
    """Move mahotas' interest points to the maximum of the quadratic through the 27 responses around their grid point.

    The octave, which mahotas does not report, is the one at whose grid point the response is the reported score and
    the largest of the 27; of several such octaves the finest. A point without one stays as it is.

    Args:
        integral: (H, W) integral image.
        points: (N, 5) rows y, x, scale, score, sign of the Laplacian, each within half a step of its grid point.
        num_octaves: number of octaves that were searched.
        initial_step_px: sampling step of the first octave.

    Returns:
        (N, 5) the points with new y, x and scale. An offset is clipped to half a step; it is zero where the quadratic
        is flat.

    >>> refine_maxima(np.zeros((9, 9)), np.zeros((0, 5)), num_octaves=4, initial_step_px=1).shape
    (0, 5)
    """
    octaves = np.arange(num_octaves)
    step = initial_step_px * 2**octaves  # px
    growth = 2 ** (octaves + 1)  # px by which lobes grow from scale to scale
    y, x = (np.rint(points[:, k, None] / step).astype(np.int64) * step for k in (0, 1))  # (N, num_octaves)
    lobe = np.rint((points[:, 2, None] / _SCALE_PER_LOBE - 1) / growth).astype(np.int64) * growth + 1
    response = hessian_determinant(integral, y, x, lobe)
    point, octave = np.nonzero(np.isclose(response, points[:, 3, None], rtol=_ROUNDING, atol=0))
    step, growth = step[octave], growth[octave]
    y, x, lobe = y[point, octave], x[point, octave], lobe[point, octave]

    shift = np.arange(-1, 2)
    scales, rows, columns = (
        centre[:, None] + spacing[:, None] * shift for centre, spacing in ((lobe, growth), (y, step), (x, step))
    )
    cube = hessian_determinant(
        integral, rows[:, None, :, None], columns[:, None, None, :], scales[:, :, None, None]
    )  # (K, 3, 3, 3): scale, y, x
    offset = _quadratic_maximum(cube).clip(-0.5, 0.5)

    largest = np.flatnonzero(cube.max((1, 2, 3)) <= cube[:, 1, 1, 1] * (1 + _ROUNDING))  # by point, then octave
    moved, finest = np.unique(point[largest], return_index=True)
    finest = largest[finest]
    refined = points.copy()
    refined[moved, 0] = (y + step * offset[:, 1])[finest]
    refined[moved, 1] = (x + step * offset[:, 2])[finest]
    refined[moved, 2] = _SCALE_PER_LOBE * (lobe + growth * offset[:, 0])[finest]
    return refined


def _quadratic_maximum(cube: Array) -> Array:
    """(N, 3) stationary point of the quadratic through (N, 3, 3, 3) samples, in steps from the centre; 0 where flat."""

    def derivative(orders: Indices) -> Array:
        return np.asarray(np.einsum("nijk,i,j,k->n", cube, *(_STENCILS[order] for order in orders)))

    unit = np.eye(3, dtype=np.int64)
    gradient = np.stack([derivative(a) for a in unit], 1)
    hessian = np.stack([np.stack([derivative(a + b) for b in unit], 1) for a in unit], 1)
    offset = np.zeros_like(gradient)
    regular = np.linalg.det(hessian) != 0
    offset[regular] = -np.linalg.solve(hessian[regular], gradient[regular, :, None])[:, :, 0]
    return offset


def hessian_determinant(integral: Array, y: Indices, x: Indices, lobe: Indices) -> Array:
    """SURF's response, the determinant of the Hessian in box filters, 0 where negative.

    The layout and the weight 0.36 of the mixed term are those of mahotas.

    Args:
        integral: (H, W) integral image, each entry including its own pixel.
        y: rows, of any shape that broadcasts with ``x`` and ``lobe``.
        x: columns.
        lobe: side of a lobe in px, odd; the filter has side 3 ``lobe``.

    >>> image = np.zeros((31, 31))
    >>> image[14:17, 14:17] = 1
    >>> centre, lobe = np.array([15]), np.array([3])
    >>> hessian_determinant(image.cumsum(0).cumsum(1), centre, centre, lobe).round(3).tolist()
    [0.049]
    """

    def box(dy: Indices | int, dx: Indices | int, height: Indices, width: Indices) -> Array:
        y0, x0 = y + dy - height // 2 - 1, x + dx - width // 2 - 1
        rows = [np.clip(v, 0, integral.shape[0] - 1) for v in (y0, y0 + height)]
        columns = [np.clip(v, 0, integral.shape[1] - 1) for v in (x0, x0 + width)]
        (a, b), (c, d) = ([integral[r, q] for q in columns] for r in rows)
        return np.asarray((d - b) - (c - a))

    area, long, side = (3 * lobe) ** 2, 3 * lobe, 2 * lobe - 1
    off = lobe // 2 + 1
    dxx = (box(0, 0, side, long) - 3 * box(0, 0, side, lobe)) / area
    dyy = (box(0, 0, long, side) - 3 * box(0, 0, lobe, side)) / area
    equal = box(off, off, lobe, lobe) + box(-off, -off, lobe, lobe)
    dxy = (box(off, -off, lobe, lobe) + box(-off, off, lobe, lobe) - equal) / area
    return np.asarray(np.maximum(dxx * dyy - 0.36 * dxy**2, 0))
