"""Random scenes: a room, a street, a shelf and a yard, each with what makes stereo hard.

All of them mix repeated, weak and rich texture, slanted planes, round and thin objects that hide each other, and
objects that are brighter or darker than their background as a whole.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tensor_stereo.configs import SyntheticConfig
from tensor_stereo.datasets.synthetic.surfaces import Camera, Patch, Scene, Solid, Surface
from tensor_stereo.datasets.synthetic.textures import (
    Float,
    Texture,
    make_blobs,
    make_bricks,
    make_checker,
    make_noise,
    make_plain,
    make_planks,
    make_print,
    make_stripes,
    make_wallpaper,
    make_windows,
)


class _Stage:
    """Places surfaces by where view 0 sees them, in px of a frame of 320 x 240 in the middle of the image.

    Larger images show the same, finer; other aspect ratios show more to the sides or above and below.

    Args:
        rng: source of all random choices.
        config: size and range of disparities.
        dark_objects: whether objects are darker than their background, or brighter.
    """

    def __init__(self, rng: np.random.Generator, config: SyntheticConfig, *, dark_objects: bool) -> None:
        self.rng = rng
        self.unit = min(config.width_px / 320, config.height_px / 240)  # px of the image per px of the frame
        self.width = config.width_px / self.unit
        self.aspect = config.height_px / config.width_px
        self.camera = Camera(1.1 * config.width_px, ((config.width_px - 1) / 2, (config.height_px - 1) / 2))
        self.far, self.near = config.min_disparity_px, config.max_disparity_px
        self.eye_height = (
            config.height_px / 2 / self.depth(0.85)
        )  # baselines; the image ends where the floor is at 0.85
        self.dark_objects = dark_objects
        self.surfaces: list[Surface] = []

    def depth(self, nearness: float) -> float:
        """Disparity in px of a nearness from 0 (farthest) to 1 (nearest)."""
        return self.far + nearness * (self.near - self.far)

    def draw(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def floor_y(self, nearness: float) -> float:
        """Row at which the floor has that nearness."""
        return 120 + self.eye_height * self.depth(nearness) / self.unit

    def paint(self, pattern: Float, cell: float, nearness: float, contrast: float, *, is_object: bool) -> Texture:
        """Grey levels around a tone that sets objects off; ``cell`` is the lattice distance in px at that nearness."""
        dark = is_object == self.dark_objects
        tone = self.draw(40, 95) if dark else self.draw(160, 215)
        return Texture(np.clip(tone + contrast * pattern, 6, 235), cell * self.unit / self.depth(nearness))

    def point(self, x: float, y: float, nearness: float) -> Float:
        return self.camera.point(x * self.unit, self.camera.center[1] + (y - 120) * self.unit, self.depth(nearness))

    def add_plane(self, x: float, y: float, nearness: float, turn: tuple[float, float], texture: Texture) -> None:
        """Unbounded plane through a point, turned about the vertical and then tilted, in radians."""
        self.surfaces.append(Patch(self.point(x, y, nearness), _frame(turn[0], turn[1], 0.0)[:2], None, texture))

    def add_floor(self, texture: Texture) -> None:
        axes = np.array([(1.0, self.draw(-0.04, 0.04) * self.aspect, 0.0), (0.0, 0.0, 1.0)])
        axes[0] /= np.linalg.norm(axes[0])
        self.surfaces.append(Patch(np.array([0.0, self.eye_height, 0.0]), axes, None, texture))

    def add_board(
        self,
        at: tuple[float, float, float],
        size: tuple[float, float],
        texture: Texture,
        *,
        turn: float = 0.0,
        tilt: float = 0.0,
        roll: float = 0.0,
    ) -> None:
        """Rectangle around (x, y, nearness)."""
        half = np.array(size) / 2 * self.unit / self.depth(at[2])
        axes = _frame(turn, tilt, roll)[:2]
        self.surfaces.append(Patch(self.point(*at), axes, (float(half[0]), float(half[1])), texture))

    def add_box(
        self,
        x: float,
        nearness: float,
        size: tuple[float, float, float],
        textures: tuple[Texture, Texture],
        turn: float,
    ) -> None:
        """Box that stands on the floor: front and sides in the first texture, the top in the second."""
        scale = self.unit / self.depth(nearness)
        w, h, d = (s / 2 * scale for s in size)
        right, down, away = _frame(turn, 0.0, 0.0)
        center = self.point(x, self.floor_y(nearness), nearness) - h * down + d * away
        faces = [(-d * away, (right, down), (w, h), textures[0]), (-h * down, (right, away), (w, d), textures[1])]
        faces += [(side * w * right, (away, down), (d, h), textures[0]) for side in (-1, 1)]
        for offset, axes, half, texture in faces:
            if (center + offset) @ offset < 0 or (center + offset - (1, 0, 0)) @ offset < 0:  # some camera sees it
                self.surfaces.append(Patch(center + offset, np.stack(axes), half, texture))

    def add_ball(self, x: float, y: float, nearness: float, radius: float, texture: Texture) -> None:
        center = self.point(x, y, nearness)
        axes = _frame(self.draw(-0.3, 0.3), self.draw(-0.3, 0.3), self.draw(-0.5, 0.5))
        self.surfaces.append(Solid(center, axes, radius * self.unit / self.depth(nearness), None, texture))

    def add_pole(
        self, start: tuple[float, float, float], end: tuple[float, float, float], radius: float, texture: Texture
    ) -> None:
        """Cylinder between two points (x, y, nearness); ``radius`` in px at the nearer one."""
        p, q = self.point(*start), self.point(*end)
        length = float(np.linalg.norm(q - p))
        along = (q - p) / length
        across = np.cross(along, (0.0, 0.0, 1.0))
        across /= np.linalg.norm(across)
        axes = np.stack([across, along, np.cross(across, along)])
        scale = self.unit / self.depth(max(start[2], end[2]))
        self.surfaces.append(Solid((p + q) / 2, axes, radius * scale, length / 2, texture))

    def rich(self, nearness: float, *, is_object: bool = True) -> Texture:
        """One of the textures that do not repeat."""
        kind = int(self.rng.integers(3))
        pattern = (make_blobs, make_noise, make_print)[kind](self.rng)
        return self.paint(pattern, self.draw(1.7, 2.4), nearness, (36, 24, 42)[kind], is_object=is_object)

    def repeated(self, nearness: float, *, is_object: bool = True) -> Texture:
        """One of the textures that repeat within the range of disparities."""
        kind = int(self.rng.integers(3))
        if kind == 0:
            pattern, cell = make_checker(4), self.draw(1.6, 2.4)
        elif kind == 1:
            pattern, cell = make_wallpaper(self.rng, 9, 5), self.draw(1.8, 2.6)
        else:
            pattern, cell = make_bricks(self.rng, 0.06), self.draw(1.7, 2.2)
        return self.paint(pattern, cell, nearness, 30, is_object=is_object)

    def plain(self, nearness: float, *, is_object: bool = True) -> Texture:
        return self.paint(make_plain(self.rng), 4.0, nearness, 40, is_object=is_object)


def _build_room(stage: _Stage) -> None:
    """Wallpaper, planks or tiles, pictures, cupboards, balls and a lamp."""
    draw, width = stage.draw, stage.width
    wall = stage.paint(make_wallpaper(stage.rng, 12, 6), draw(1.7, 2.2), 0.1, 18, is_object=False)
    stage.add_plane(width / 2, 120, 0.1, (draw(-0.25, 0.25), 0.0), wall)
    if stage.rng.random() < 0.5:
        tiles = np.tile(make_checker(3), (20, 20)) + 0.4 * make_noise(stage.rng, 120)
        stage.add_floor(stage.paint(tiles, 3.2, 0.3, 20, is_object=False))
    else:
        stage.add_floor(stage.paint(make_planks(stage.rng), 2.0, 0.3, 24, is_object=False))
    for k in range(3):
        at = (width * (0.18 + 0.3 * k + draw(-0.04, 0.04)), draw(42, 60), draw(0.16, 0.22))
        stage.add_board(at, (draw(50, 80), draw(45, 65)), stage.rich(0.2), roll=draw(-0.06, 0.06))
    stage.add_box(
        width * draw(0.2, 0.35), 0.3, (draw(60, 80), draw(55, 75), 30), _twice(stage.plain(0.3)), draw(-0.5, 0.5)
    )
    stage.add_box(
        width * draw(0.65, 0.8), 0.42, (draw(50, 70), draw(40, 60), 40), _twice(stage.repeated(0.42)), draw(-0.5, 0.5)
    )
    _add_balls(stage, 3)
    x, nearness = width * draw(0.45, 0.6), draw(0.5, 0.65)
    stage.add_pole((x, stage.floor_y(nearness), nearness), (x + draw(-6, 6), 55, nearness), 2.2, stage.plain(nearness))
    stage.add_ball(x, 45, nearness, draw(16, 22), stage.rich(nearness))


def _build_street(stage: _Stage) -> None:
    """Fronts with windows, sky, trees, boxes, lamp posts and wires."""
    draw, width = stage.draw, stage.width
    stage.add_plane(width / 2, 120, 0.0, (0.0, 0.0), stage.plain(0.0, is_object=False))
    stage.add_floor(stage.paint(make_noise(stage.rng), 1.6, 0.25, 14, is_object=False))
    for side in (-1, 1):
        nearness = draw(0.1, 0.2)
        front = stage.paint(make_windows(stage.rng, 0.8), draw(1.8, 2.3), nearness, 30, is_object=False)
        at = (width * (0.5 + side * draw(0.26, 0.34)), draw(70, 95), nearness)
        stage.add_board(at, (draw(140, 175), 200), front, turn=-side * draw(0.3, 0.7))
    for _ in range(2):
        nearness, x = draw(0.3, 0.6), width * draw(0.1, 0.9)
        top = draw(60, 90)
        stage.add_pole((x, stage.floor_y(nearness), nearness), (x, top, nearness), 3.0, stage.plain(nearness))
        tree = stage.paint(make_blobs(stage.rng), 1.8, nearness, 34, is_object=True)
        stage.add_ball(x, top, nearness, draw(20, 30), tree)
    for k in range(2):
        nearness = draw(0.3, 0.55)
        textures = stage.rich(nearness), stage.plain(nearness)
        stage.add_box(
            width * (0.3 + 0.4 * k + draw(-0.1, 0.1)),
            nearness,
            (draw(45, 70), draw(28, 42), 35),
            textures,
            draw(-0.7, 0.7),
        )
    nearness = draw(0.65, 0.8)
    posts = [(width * (0.2 + 0.6 * k + draw(-0.08, 0.08)), nearness - 0.2 * k) for k in range(2)]
    for x, near in posts:
        stage.add_pole((x, 300, near), (x + draw(-4, 4), -20, near), 3.2, stage.plain(near))
    for k in range(3):
        (x0, near0), (x1, near1) = posts
        wire = stage.plain(nearness)
        stage.add_pole((x0 - 100, 8 + 13 * k, near0), (x1 + 60, 20 + 10 * k + draw(-8, 30), near1), 0.8, wire)


def _build_shelf(stage: _Stage) -> None:
    """Books, pencils and balls on a table before a striped or plain wall."""
    draw, width = stage.draw, stage.width
    if stage.rng.random() < 0.5:
        wall = stage.paint(make_stripes(stage.rng, 11), draw(1.8, 2.4), 0.1, 26, is_object=False)
    else:
        wall = stage.paint(make_bricks(stage.rng, 0.25), draw(1.8, 2.2), 0.1, 22, is_object=False)
    stage.add_plane(width / 2, 120, 0.08, (draw(-0.2, 0.2), 0.0), wall)
    stage.add_floor(stage.paint(make_planks(stage.rng), 1.8, 0.3, 26, is_object=False))
    at = (width * draw(0.25, 0.75), draw(30, 42), 0.14)
    stage.add_board(at, (draw(90, 130), draw(38, 50)), stage.rich(0.14), roll=draw(-0.05, 0.05))
    x = width * draw(0.04, 0.1)
    nearness = draw(0.28, 0.36)
    while x < width * 0.86:
        thickness, height = draw(13, 28), draw(70, 115)
        book = (stage.repeated, stage.repeated, stage.rich, stage.rich, stage.plain)[int(stage.rng.integers(5))](
            nearness
        )
        at = (x + thickness / 2, stage.floor_y(nearness) - height / 2, nearness)
        stage.add_board(at, (thickness, height), book, turn=draw(-0.4, 0.4), roll=draw(-0.06, 0.06))
        x += thickness + 1.5 + (draw(15, 35) if stage.rng.random() < 0.2 else 0)
        nearness = float(np.clip(nearness + draw(-0.05, 0.05), 0.24, 0.4))
    nearness = draw(0.5, 0.6)
    stage.add_board(
        (width * draw(0.3, 0.7), stage.floor_y(nearness) - 22, nearness),
        (draw(70, 95), 46),
        stage.rich(nearness),
        turn=draw(-0.5, 0.5),
        tilt=draw(0.2, 0.5),
        roll=draw(-0.1, 0.1),
    )
    _add_balls(stage, 2)
    x, nearness = width * draw(0.1, 0.8), draw(0.6, 0.7)
    for k in range(4):
        base = (x + 5 * k, stage.floor_y(nearness), nearness)
        stage.add_pole(base, (x + 9 * k + draw(-14, 14), draw(100, 125), nearness), 1.6, stage.plain(nearness))


def _build_yard(stage: _Stage) -> None:
    """Fence of equal bars before a brick wall, crates, balls and leaning sticks on gravel."""
    draw, width = stage.draw, stage.width
    wall = stage.paint(make_bricks(stage.rng, 0.4), draw(1.8, 2.2), 0.1, 24, is_object=False)
    stage.add_plane(width / 2, 120, 0.1, (draw(-0.3, 0.3), 0.0), wall)
    stage.add_floor(stage.paint(make_noise(stage.rng), 1.7, 0.3, 20, is_object=False))
    stage.add_board((width * draw(0.3, 0.7), 62, 0.17), (draw(90, 120), draw(60, 75)), stage.plain(0.17))
    nearness, gap, first = draw(0.3, 0.4), draw(11, 15), width * draw(0.02, 0.4)
    bar = stage.paint(make_plain(stage.rng), 3.0, nearness, 40, is_object=True)
    for k in range(9):
        x = first + gap * k
        stage.add_pole((x, stage.floor_y(nearness), nearness), (x, 105, nearness), 2.0, bar)
    stage.add_pole((first - 6, 118, nearness), (first + 8 * gap + 6, 116, nearness), 1.8, bar)
    for k in range(2):
        nearness = draw(0.35, 0.6)
        textures = (stage.repeated if k else stage.rich)(nearness), stage.plain(nearness)
        stage.add_box(
            width * (0.75 - 0.5 * k + draw(-0.12, 0.12)),
            nearness,
            (draw(45, 65), draw(35, 50), 40),
            textures,
            draw(-0.7, 0.7),
        )
    _add_balls(stage, 3)
    for _ in range(2):
        x, nearness = width * draw(0.1, 0.9), draw(0.6, 0.8)
        stage.add_pole(
            (x, 260, nearness), (x + draw(-60, 60), draw(-10, 60), nearness - 0.15), 1.4, stage.plain(nearness)
        )


_BUILDERS: tuple[Callable[[_Stage], None], ...] = (_build_room, _build_street, _build_shelf, _build_yard)


def build_scene(rng: np.random.Generator, number: int, config: SyntheticConfig) -> Scene:
    """Random scene; ``number`` picks room, street, shelf or yard in turn, and bright or dark objects for each in turn.

    Example:
        >>> scene = build_scene(np.random.default_rng(0), 0, SyntheticConfig())
        >>> floor, wall = (scene.trace(0, np.array([200.0]), np.array([y]))[0] for y in (299.0, 0.0))
        >>> bool(6 < wall[0] < floor[0] < 60)
        True
    """
    turn, kind = divmod(number, len(_BUILDERS))
    stage = _Stage(rng, config, dark_objects=(turn + kind) % 2 == 1)
    _BUILDERS[kind](stage)
    return Scene(stage.camera, stage.surfaces)


def _add_balls(stage: _Stage, count: int) -> None:
    for k in range(count):
        nearness, radius = stage.draw(0.45, 0.75), stage.draw(13, 24)
        x = stage.width * ((k + stage.draw(0.15, 0.85)) / count)
        texture = (stage.rich, stage.rich, stage.repeated)[k % 3](nearness)
        stage.add_ball(x, stage.floor_y(nearness) - radius, nearness, radius, texture)


def _twice(texture: Texture) -> tuple[Texture, Texture]:
    return texture, texture


def _frame(turn: float, tilt: float, roll: float) -> Float:
    """(3, 3) right, down and away: rolled about away, tilted about the horizontal, then turned about the vertical."""
    (ct, st), (cp, sp), (cr, sr) = ((np.cos(a), np.sin(a)) for a in (turn, tilt, roll))
    right, down, away = np.array([(ct, 0.0, st), (st * sp, cp, -ct * sp), (-st * cp, sp, ct * cp)])
    return np.stack([cr * right + sr * down, cr * down - sr * right, away])
