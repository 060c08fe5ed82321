"""Textured surfaces that the rays of two rectified pinhole cameras meet in closed form.

The unit of length is the baseline: x to the right, y down, z forward, the camera of view 0 at the origin and that of
view 1 at (1, 0, 0). A point of depth Z then has disparity d = x0 - x1 = f / Z px, and the nearest surface is the one of
greatest disparity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from tensor_stereo.datasets.synthetic.textures import Float, Texture

Index = NDArray[np.int64]

TO_LIGHT = np.array([-0.48, -0.64, -0.6])  # unit vector
AMBIENT, DIFFUSE = 0.62, 0.45  # Lambert's law: the same brightness from both views


@dataclass(frozen=True)
class Camera:
    """What both views share.

    Attributes:
        focal: focal length in px.
        center: (x, y) of the principal point in px.

    Example:
        >>> Camera(100.0, (5.0, 5.0)).point(25.0, 5.0, disparity=10.0)
        array([ 2.,  0., 10.])
    """

    focal: float
    center: tuple[float, float]

    def point(self, x: float, y: float, disparity: float) -> Float:
        """(3,) point that view 0 sees at pixel (x, y) with that disparity."""
        return np.array([x - self.center[0], y - self.center[1], self.focal]) / disparity

    def rays(self, x: Float, y: Float, axis: Float) -> Float:
        """Scalar product of ``axis`` with the rays (x - cx, y - cy, f) of some pixels."""
        a, b, c = axis.tolist()
        product: Float = a * x + (b * y + (c * self.focal - a * self.center[0] - b * self.center[1]))
        return product


@dataclass(frozen=True, eq=False)
class Patch:
    """Flat rectangle, or a whole plane.

    Attributes:
        center: (3,) its middle, the origin of its texture.
        axes: (2, 3) orthonormal directions of u and v.
        half_size: along u and v, in baselines; None for a whole plane.
        texture: grey levels under full light, over (u, v) in baselines.
    """

    center: Float
    axes: Float
    half_size: tuple[float, float] | None
    texture: Texture

    @cached_property
    def normal(self) -> Float:
        """(3,) unit normal on the side of view 0."""
        normal: Float = np.cross(*self.axes)
        return normal if normal @ self.center < 0 else -normal

    @cached_property
    def outline(self) -> Float | None:
        """(K, 3) points whose convex hull holds the surface; None for an unbounded one."""
        if self.half_size is None:
            return None
        signs = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
        return self.center + (signs * self.half_size) @ self.axes

    def disparity(self, camera: Camera, view: int, x: Float, y: Float) -> Float:
        """Disparity in px where the rays of some pixels meet the surface, -inf where they miss it."""
        found = camera.rays(x, y, self.normal / (self.normal @ self.center - view * self.normal[0]))
        missed = found <= 0
        if self.half_size is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                u, v = self._coordinates(camera, view, x, y, found)
            missed |= ~((np.abs(u) <= self.half_size[0]) & (np.abs(v) <= self.half_size[1]))
        found[missed] = -np.inf
        return found

    def grey(self, camera: Camera, view: int, x: Float, y: Float, disparity: Float) -> Float:
        """Grey levels of the points that some pixels show, given their disparity."""
        return self.texture(*self._coordinates(camera, view, x, y, disparity)) * float(_light(self.normal @ TO_LIGHT))

    def _coordinates(self, camera: Camera, view: int, x: Float, y: Float, disparity: Float) -> tuple[Float, Float]:
        u, v = (camera.rays(x, y, axis) / disparity + float(view * axis[0] - axis @ self.center) for axis in self.axes)
        return u, v


@dataclass(frozen=True, eq=False)
class Solid:
    """Sphere, or the wall of a cylinder.

    Attributes:
        center: (3,) its middle.
        axes: (3, 3) orthonormal directions: across, along the cylinder, and away from the cameras.
        radius: in baselines.
        half_length: of the cylinder, in baselines; None for a sphere.
        texture: grey levels under full light, over arc lengths (u, v) in baselines from the point towards the cameras.
    """

    center: Float
    axes: Float
    radius: float
    half_length: float | None
    texture: Texture

    @cached_property
    def outline(self) -> Float:
        """(K, 3) points whose convex hull holds the surface."""
        corners = np.stack(np.meshgrid(*[(-1, 1)] * 3), -1).reshape(-1, 3)
        cube: Float = self.center + self.radius * corners
        if self.half_length is None:
            return cube
        return np.concatenate([cube + end * self.half_length * self.axes[1] for end in (-1, 1)])

    def disparity(self, camera: Camera, view: int, x: Float, y: Float) -> Float:
        """Disparity in px where the rays of some pixels first meet the surface, -inf where they miss it."""
        x, y = x.astype(np.float64), y.astype(np.float64)
        origin = np.array([view, 0.0, 0.0]) - self.center
        # |O + r / d|^2 = radius^2, without the axial part for a cylinder; the nearer of both roots in d
        axes = self.axes if self.half_length is None else self.axes[::2]
        offsets = (axes @ origin).tolist()
        rays = [camera.rays(x, y, axis) for axis in axes]
        a = sum(offset * offset for offset in offsets) - self.radius**2
        b = sum(offset * ray for offset, ray in zip(offsets, rays, strict=True))
        c = sum(ray * ray for ray in rays)
        root = b * b - a * c
        found: Float = (np.sqrt(np.maximum(root, 0)) - b) / a
        missed = root < 0
        if self.half_length is not None:
            along = camera.rays(x, y, self.axes[1]) / found + float(self.axes[1] @ origin)
            missed |= np.abs(along) > self.half_length
        found[missed] = -np.inf
        return found

    def grey(self, camera: Camera, view: int, x: Float, y: Float, disparity: Float) -> Float:
        """Grey levels of the points that some pixels show, given their disparity."""
        origin = np.array([view, 0.0, 0.0]) - self.center
        across, along, away = (camera.rays(x, y, axis) / disparity + float(axis @ origin) for axis in self.axes)
        normal = [across / self.radius, along / self.radius, away / self.radius]
        toward = (self.axes @ TO_LIGHT).tolist()
        if self.half_length is None:
            angle = np.arccos(np.clip(-normal[2], -1, 1))
            stretch = 1 / np.sinc(np.minimum(angle, 3.0) / np.pi)  # angle / sine, finite on the far side too
            u, v = across * stretch, along * stretch
        else:
            u, v = np.arctan2(normal[0], -normal[2]) * self.radius, along
            toward[1] = 0.0
        levels: Float = self.texture(u, v) * _light(sum(n * t for n, t in zip(normal, toward, strict=True)))
        return levels


Surface: TypeAlias = Patch | Solid


@dataclass(frozen=True, eq=False)
class Scene:
    """Surfaces before a camera; at least one of them is unbounded and behind everything.

    Attributes:
        camera: of both views.
        surfaces: in any order; where two tie, the first is seen.

    Example:
        >>> wall = Patch(np.array([0.0, 0.0, 20.0]), np.eye(3)[:2], None, Texture(np.array([[80.0]]), cell=1.0))
        >>> scene = Scene(Camera(100.0, (5.0, 5.0)), [wall])
        >>> pixel = np.array([7.0]), np.array([3.0])
        >>> disparity, index = scene.trace(1, *pixel)
        >>> disparity, scene.shade(1, *pixel, disparity, index).round(1)
        (array([5.]), array([71.2]))
    """

    camera: Camera
    surfaces: Sequence[Surface]

    def trace(self, view: int, x: Float, y: Float) -> tuple[Float, Index]:
        """Find the nearest surface at some pixels, which need not be whole.

        Args:
            view: 0 or 1.
            x: (N,) px.
            y: (N,) px, ascending.

        Returns:
            (N,) disparity in px, of the dtype of ``x``, and (N,) index into ``surfaces``.
        """
        nearest = np.full(x.shape, -np.inf, dtype=x.dtype)
        index = np.zeros(x.shape, dtype=np.int64)
        for k, surface in enumerate(self.surfaces):
            where = self._candidates(surface, view, x, y)
            found = surface.disparity(self.camera, view, x[where], y[where])
            nearer = found > nearest[where]
            hit = nearer if isinstance(where, slice) else where[nearer]
            nearest[hit] = found[nearer]
            index[hit] = k
        return nearest, index

    def shade(self, view: int, x: Float, y: Float, disparity: Float, index: Index) -> Float:
        """(N,) grey levels at some pixels, given what :meth:`trace` has found there."""
        levels = np.empty_like(x)
        for k in np.flatnonzero(np.bincount(index)).tolist():
            seen = np.flatnonzero(index == k)
            levels[seen] = self.surfaces[k].grey(self.camera, view, x[seen], y[seen], disparity[seen])
        return levels

    def _candidates(self, surface: Surface, view: int, x: Float, y: Float) -> Index | slice:
        """Pixels within the box around the image of a surface."""
        outline = surface.outline
        if outline is None:
            return slice(None)
        image = (outline[:, :2] - (view, 0)) / outline[:, 2:] * self.camera.focal + self.camera.center
        (left, top), (right, bottom) = image.min(0).tolist(), image.max(0).tolist()
        # keys of the dtype of y, which else would be converted as a whole
        start = np.searchsorted(y, y.dtype.type(top), "left")
        stop = np.searchsorted(y, y.dtype.type(bottom), "right")
        columns = x[start:stop]
        return np.flatnonzero((columns >= left) & (columns <= right)) + start


def _light(cosine: Float | float) -> Float:
    brightness: Float = AMBIENT + DIFFUSE * np.maximum(cosine, 0)
    return brightness
