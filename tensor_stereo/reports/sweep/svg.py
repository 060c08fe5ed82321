"""Small plots as inline SVG: text that scales, colours from the page's style sheet, no script.

Matplotlib's SVG would bake in the colours of one theme and repeat its glyphs in every figure.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import ArrayLike

NUM_COLORS = 8  # classes c0 to c7 of the style sheet; INK is the colour of text
INK = "ink"
_TOP, _BOTTOM, _RIGHT = 26.0, 42.0, 14.0  # margins; numbers are CSS px at the plot's own size
_SHAPES = {
    "circle": "m-4 0a4 4 0 1 0 8 0a4 4 0 1 0-8 0z",
    "square": "m-3.5-3.5h7v7h-7z",
    "triangle": "m0-4.8l4.5 7.8h-9z",
    "diamond": "m0-5l5 5-5 5-5-5z",
    "star": "m0-8l2.1 5.1 5.5.4-4.2 3.6 1.3 5.4-4.7-2.9-4.7 2.9 1.3-5.4-4.2-3.6 5.5-.4z",
}


@dataclass(frozen=True)
class Axis:
    """What an axis shows.

    Attributes:
        label: quantity and unit.
        low: value at the left or lower end.
        high: value at the other end.
        ticks: values with their text.
        log: whether equal ratios take equal room.
    """

    label: str
    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]
    log: bool = False

    def place(self, values: ArrayLike, start: float, stop: float) -> list[float]:
        """Where values lie between two ends in px."""
        scale = np.log10 if self.log else np.asarray
        low, high, at = scale(self.low), scale(self.high), scale(np.asarray(values, dtype=np.float64))
        return np.atleast_1d(start + (at - low) / (high - low) * (stop - start)).tolist()  # type: ignore[no-any-return]


def rate_axis(label: str, values: Iterable[float] = (0.0,)) -> Axis:
    """Up to 1, from the tick below the least of some rates; NaN is none."""
    least = min((value for value in values if not math.isnan(value)), default=0.0)
    parts = 10 if least >= 0.5 else 5
    first = min(math.floor(parts * least), parts - 1)
    return Axis(label, first / parts, 1.0, tuple((k / parts, f"{k / parts:g}") for k in range(first, parts + 1)))


def log_axis(label: str, values: Iterable[float]) -> Axis:
    """Whole decades around positive values."""
    logs = [math.log10(value) for value in values]
    low, high = math.floor(min(logs)), max(math.ceil(max(logs)), math.floor(min(logs)) + 1)
    return Axis(label, 10.0**low, 10.0**high, tuple((10.0**k, f"{10.0**k:g}") for k in range(low, high + 1)), log=True)


def name_axis(names: Sequence[str]) -> Axis:
    """Names from top to bottom; the first lies at 0."""
    return Axis("", len(names) - 0.5, -0.5, tuple((float(k), name) for k, name in enumerate(names)))


@dataclass(frozen=True)
class Key:
    """How something is drawn, and what a legend calls it.

    Attributes:
        label: its name.
        color: class of the style sheet.
        line: whether the legend shows a line.
        style: further class of the line.
        shape: of its marks; None: it has none.
        filled: whether they are.
    """

    label: str
    color: str
    line: bool = False
    style: str = ""
    shape: str | None = None
    filled: bool = True


class Plot:
    """One panel; elements are drawn in the order in which they are added.

    Args:
        x: horizontal axis.
        y: vertical axis.
        title: above the panel.
        description: text alternative, the whole message in words.
        width: of everything.
        height: of everything.
        left: margin for the text at the vertical axis.
    """

    def __init__(
        self, x: Axis, y: Axis, *, title: str, description: str, width: int = 300, height: int = 280, left: int = 48
    ) -> None:
        self.x, self.y = x, y
        self._description = description
        self._size = width, height
        self._box = float(left), _TOP, width - _RIGHT, height - _BOTTOM  # left, top, right, bottom
        self._parts = [f'<text class="title" x="{_n(self._box[0])}" y="14">{escape(title)}</text>']
        self._draw_axes()

    def _points(self, xs: ArrayLike, ys: ArrayLike) -> list[tuple[float, float]]:
        left, top, right, bottom = self._box
        return list(zip(self.x.place(xs, left, right), self.y.place(ys, bottom, top), strict=True))

    def _draw_axes(self) -> None:
        left, top, right, bottom = self._box
        for value, text in self.x.ticks:
            (at,) = self.x.place(value, left, right)
            self._parts.append(f'<path class="grid" d="M{_n(at)} {_n(top)}V{_n(bottom)}"/>')
            self._parts.append(f'<text class="tick" x="{_n(at)}" y="{_n(bottom + 15)}">{escape(text)}</text>')
        for value, text in self.y.ticks:
            (at,) = self.y.place(value, bottom, top)
            self._parts.append(f'<path class="grid" d="M{_n(left)} {_n(at)}H{_n(right)}"/>')
            self._parts.append(f'<text class="tick y" x="{_n(left - 7)}" y="{_n(at + 3.5)}">{escape(text)}</text>')
        middle = (top + bottom) / 2
        x_label = f'x="{_n((left + right) / 2)}" y="{_n(bottom + 34)}"'
        self._parts.append(f'<text class="label" {x_label}>{escape(self.x.label)}</text>')
        turn = f'transform="translate(12 {_n(middle)}) rotate(-90)"'
        self._parts.append(f'<text class="label" {turn}>{escape(self.y.label)}</text>')

    def line(self, xs: ArrayLike, ys: ArrayLike, key: Key) -> None:
        """Join points; NaN breaks the line."""
        runs: list[list[str]] = [[]]
        for x, y in self._points(xs, ys):
            if math.isnan(x) or math.isnan(y):
                runs.append([])
            elif not runs[-1] or runs[-1][-1] != f"{_n(x)} {_n(y)}":
                runs[-1].append(f"{_n(x)} {_n(y)}")
        path = "".join("M" + "L".join(run) for run in runs if run)
        if path:
            self._parts.append(_line(path, key))

    def mark(self, x: float, y: float, key: Key, *, tip: str = "") -> None:
        """Mark one point; ``tip`` shows under the pointer. NaN marks nothing."""
        ((at_x, at_y),) = self._points(x, y)
        if not (math.isnan(at_x) or math.isnan(at_y)):
            self._parts.append(_mark(at_x, at_y, key, tip))

    def note(self, x: float, y: float, text: str) -> None:
        """Text whose right end lies beside a point."""
        ((at_x, at_y),) = self._points(x, y)
        self._parts.append(f'<text class="note" x="{_n(at_x - 12)}" y="{_n(at_y + 4)}">{escape(text)}</text>')

    def render(self) -> str:
        """The SVG element."""
        width, height = self._size
        size = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
        head = f'<svg class="plot" {size} role="img" aria-label="{escape(self._description)}">'
        return head + "".join(self._parts) + "</svg>"


def legend(keys: Iterable[Key]) -> str:
    """A list of what colours, lines and marks mean."""
    items = []
    for key in keys:
        parts = _line("M1 7H27", key) if key.line else ""
        if key.shape is not None:
            parts += _mark(14, 7, key, "")
        swatch = f'<svg class="swatch" viewBox="0 0 28 14" aria-hidden="true">{parts}</svg>'
        items.append(f"<li>{swatch}{escape(key.label)}</li>")
    return f'<ul class="legend">{"".join(items)}</ul>' if items else ""


def color_class(number: int) -> str:
    """The class of the n-th series."""
    return f"c{number % NUM_COLORS}"


def _line(path: str, key: Key) -> str:
    style = " ".join(filter(None, ("line", key.style, key.color)))
    return f'<path class="{style}" d="{path}"/>'


def _mark(x: float, y: float, key: Key, tip: str) -> str:
    style = f"mark {'full ' if key.filled else ''}{key.color}"
    inside = f"<title>{escape(tip)}</title>" if tip else ""
    return f'<path class="{style}" d="M{_n(x)} {_n(y)}{_SHAPES[key.shape or "circle"]}">{inside}</path>'


def _n(value: float) -> str:
    """A coordinate with one decimal at most."""
    return f"{value:.1f}".removesuffix(".0")
