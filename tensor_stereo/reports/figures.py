"""Figures of classified matches, drawn with matplotlib objects alone: no global state, no window."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import ConnectionPatch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from tensor_stereo.paths import has_ending
from tensor_stereo.types import Adjacency, Matches, check_vector

# hues that stay apart for the common colour blindnesses (Okabe & Ito, 2008)
BLUE, VERMILLION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#595959"
DPI = 100
_PANEL_AREA_IN2, _MIN_WIDTH_IN, _MAX_WIDTH_IN = 22.0, 5.2, 9.0  # of one panel
_GAP_IN, _TITLE_IN, _LABEL_IN, _LEGEND_IN = 0.12, 0.36, 0.24, 0.34
_FONT_SIZE = 9
_NUM_CELLS = 7  # along the longer side of an image; of each one match is joined across the views


@dataclass(frozen=True)
class _Class:
    """Matches that look alike."""

    label: str
    mask: NDArray[np.bool_]
    color: str
    marker: str

    def _style(self) -> dict[str, Any]:
        disc = {"markersize": 5.0, "markeredgecolor": "white", "markeredgewidth": 0.5}
        cross = {"markersize": 4.5, "markeredgewidth": 1.2}
        return {"linestyle": "none", "marker": self.marker, "color": self.color} | (
            disc if self.marker == "o" else cross
        )

    def draw(self, axes: Axes, keypoints: NDArray[np.floating]) -> None:
        axes.plot(*keypoints[self.mask].T, **self._style())

    def handle(self) -> Line2D:
        return Line2D([], [], label=f"{self.label}: {int(self.mask.sum())}", **self._style())


def draw_classification(
    image0: Tensor,
    image1: Tensor,
    matches: Matches,
    verdicts: Mapping[str, Tensor],
    adjacency0: Adjacency,
    adjacency1: Adjacency,
    *,
    tested: Tensor | None = None,
    correct: Tensor | None = None,
    valid: Tensor | None = None,
    contours0: Sequence[Tensor] | None = None,
    contours1: Sequence[Tensor] | None = None,
    title: str = "",
) -> Figure:
    """Draw one pair: its matches by verdict and truth, a row for each verdict, and below the graphs of both views.

    The marker is the verdict, a disc for kept and a cross for rejected; the colour is the truth, blue for correct,
    vermillion for incorrect, grey for unknown. Without ground truth the classes are kept, rejected and untested. Edges
    that both graphs have are told from those of one view only. Lines join some of the kept matches across the views.

    Args:
        image0: (C, H, W) uint8 of view 0, C = 1 or 3 (RGB); drawn in grey so that colours mean matches only.
        image1: (C, H, W) uint8 of view 1.
        matches: M matches of one pair.
        verdicts: (M,) bool, True for kept, by the name of what decided; one or several, from top to bottom.
        adjacency0: graph of view 0 over the M matches.
        adjacency1: graph of view 1.
        tested: (M,) bool, False for matches without evidence, which are told apart where there is no ground truth.
        correct: (M,) bool against ground truth, together with ``valid``.
        valid: (M,) bool, ground truth is known.
        contours0: (L, 2) chains of pixels (x, y) of view 0, as :func:`tensor_stereo.objects.trace_objects` gives them.
        contours1: the same of view 1.
        title: one line.

    Returns:
        A figure of 100 dots per inch that pyplot does not know.

    Raises:
        ValueError: if there is not just one pair, a length is not M, an image is not (C, H, W), or only one of
            ``correct`` and ``valid`` is given.
        TypeError: if an image is not uint8.

    Example:
        >>> image, points = torch.zeros(1, 20, 30, dtype=torch.uint8), torch.tensor([[3.0, 4.0]])
        >>> one, none = torch.ones(1, dtype=torch.int64), torch.zeros(0, dtype=torch.int64)
        >>> graph = Adjacency(torch.zeros(2, dtype=torch.int64), none, torch.tensor([0, 1]))
        >>> matches, kept = Matches(points, points, torch.tensor([0, 1])), one > 0
        >>> len(draw_classification(image, image, matches, {"score": kept}, graph, graph).axes)
        4
    """
    _check_pair(image0, image1, matches)
    for name, adjacency in (("adjacency0", adjacency0), ("adjacency1", adjacency1)):
        if adjacency.num_nodes != matches.num_matches:
            raise ValueError(f"{name} must have {matches.num_matches} nodes, one per match, got {adjacency.num_nodes}")
    if not verdicts:
        raise ValueError("verdicts must hold at least one")
    for name, inlier in verdicts.items():
        check_vector(f"verdicts[{name!r}]", inlier, matches.num_matches)
    rows = [_classes(inlier, tested, correct, valid, matches.num_matches) for inlier in verdicts.values()]
    keypoints = [points.numpy(force=True) for points in (matches.keypoints0, matches.keypoints1)]
    edges = [_edges(adjacency0), _edges(adjacency1)]
    shared = [np.isin(edges[view], edges[1 - view]) for view in (0, 1)]

    layout = _Layout(image0, title, num_rows=len(rows) + 1)
    panels: list[list[Axes]] = [[] for _ in rows]
    for view, (image, contours) in enumerate(((image0, contours0), (image1, contours1))):
        gray = _gray(image)
        for row, (name, classes) in enumerate(zip(verdicts, rows, strict=True)):
            panels[row].append(layout.draw_matches(row, view, gray, classes, keypoints[view], name))
        num_edges, num_shared = len(edges[view]), int(shared[view].sum())
        label = f"Delaunay graph of view {view}: {num_edges} edges, {num_shared} of them in both views"
        lower = layout.panel(len(rows), view, label, gray, strength=0.25)
        if contours is not None:
            _draw_lines(lower, [_closed(contour.numpy(force=True)) for contour in contours], GREEN, 1.6)
        ends = np.stack(np.divmod(edges[view], matches.num_matches), 1)
        segments = keypoints[view][ends]  # (E, 2, 2)
        _draw_lines(lower, segments[~shared[view]], VERMILLION, 0.6)
        _draw_lines(lower, segments[shared[view]], BLUE, 0.9)
        lower.plot(*keypoints[view].T, linestyle="none", marker=".", markersize=2.5, color="black")
    for row, classes in enumerate(rows):
        layout.legend(row, [item.handle() for item in classes])
        layout.join(panels[row], classes, keypoints)
    lines = {"edge in both views": BLUE, "edge in one view only": VERMILLION}
    if contours0 is not None or contours1 is not None:
        lines["object contour"] = GREEN
    layout.legend(
        len(rows), [Line2D([], [], color=color, linewidth=1.5, label=label) for label, color in lines.items()]
    )
    return layout.figure


def draw_matches(
    image0: Tensor,
    image1: Tensor,
    matches: Matches,
    inlier: Tensor,
    *,
    correct: Tensor,
    valid: Tensor,
    title: str = "",
) -> Figure:
    """Draw the matches of one pair by verdict and truth, as the upper half of :func:`draw_classification`.

    Arguments and errors are those of :func:`draw_classification`; ``inlier`` (M,) bool is the verdict.

    Example:
        >>> image, points = torch.zeros(1, 20, 30, dtype=torch.uint8), torch.tensor([[3.0, 4.0]])
        >>> matches, kept = Matches(points, points, torch.tensor([0, 1])), torch.tensor([True])
        >>> len(draw_matches(image, image, matches, kept, correct=kept, valid=kept).axes)
        2
    """
    _check_pair(image0, image1, matches)
    classes = _truth_classes(inlier, correct, valid, matches.num_matches)
    layout = _Layout(image0, title, num_rows=1)
    panels: list[Axes] = []
    for view, (image, points) in enumerate(((image0, matches.keypoints0), (image1, matches.keypoints1))):
        panels.append(layout.draw_matches(0, view, _gray(image), classes, points.numpy(force=True)))
    layout.legend(0, [item.handle() for item in classes])
    layout.join(panels, classes, [points.numpy(force=True) for points in (matches.keypoints0, matches.keypoints1)])
    return layout.figure


def write_figure(figure: Figure, path: Path | str) -> None:
    """Write a figure in the format that the ending of ``path`` names.

    PNG files get a palette of 256 colours, which halves their size and shows no difference; equal figures give equal
    files. Other formats are written by matplotlib as they are.

    Args:
        figure: any matplotlib figure.
        path: file to write, .png or another format of matplotlib; its folder must exist.

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if matplotlib does not know the format.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_figure(Figure(figsize=(1, 1)), Path(folder) / "empty.png")
        ...     print([path.name for path in Path(folder).iterdir()])
        ['empty.png']
    """
    path = Path(path)
    if has_ending(path, ".png"):
        path.write_bytes(figure_png(figure))
    else:
        figure.savefig(path)


def figure_png(figure: Figure) -> bytes:
    """The bytes of the PNG file that :func:`write_figure` writes.

    Example:
        >>> figure_png(Figure(figsize=(1, 1)))[1:4]
        b'PNG'
    """
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    file = io.BytesIO()
    image.quantize(256, dither=Image.Dither.NONE).save(file, "PNG", dpi=(figure.dpi, figure.dpi))
    return file.getvalue()


class _Layout:
    """Rows of two panels with the images' aspect, a legend under each row, sizes in inches."""

    def __init__(self, image: Tensor, title: str, *, num_rows: int) -> None:
        height, width = image.shape[-2:]
        aspect = width / height
        self.width = float(np.clip((_PANEL_AREA_IN2 * aspect) ** 0.5, _MIN_WIDTH_IN, _MAX_WIDTH_IN))
        self.height = self.width / aspect
        self.row = _LABEL_IN + self.height + _LEGEND_IN
        self.num_rows = num_rows
        self.size = (2 * self.width + 3 * _GAP_IN, (_TITLE_IN if title else 0) + num_rows * self.row + _GAP_IN)
        self.figure = Figure(figsize=self.size, dpi=DPI)
        if title:
            self.figure.text(0.5, 1 - 0.5 * _TITLE_IN / self.size[1], title, ha="center", va="center", fontsize=12)

    def _bottom(self, row: int) -> float:
        return _GAP_IN + (self.num_rows - 1 - row) * self.row + _LEGEND_IN

    def panel(self, row: int, column: int, label: str, gray: NDArray[np.uint8], *, strength: float) -> Axes:
        """Axes in pixel coordinates over the image, faded towards white."""
        height, width = gray.shape
        left = _GAP_IN + column * (self.width + _GAP_IN)
        box = np.array([left, self._bottom(row), self.width, self.height]) / np.tile(self.size, 2)
        axes = self.figure.add_axes(tuple(box), xticks=[], yticks=[])
        faded = (255 - strength * (255 - gray.astype(np.float32))).astype(np.uint8)
        axes.imshow(faded, cmap="gray", vmin=0, vmax=255, interpolation="bilinear")
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), autoscale_on=False)
        axes.set_title(label, pad=3, fontsize=_FONT_SIZE)
        axes.spines[:].set_visible(False)
        return axes

    def draw_matches(
        self,
        row: int,
        view: int,
        gray: NDArray[np.uint8],
        classes: Sequence[_Class],
        keypoints: NDArray[np.floating],
        name: str = "",
    ) -> Axes:
        where = f"view {view} ({('left', 'right')[view]})"
        axes = self.panel(row, view, f"{name}: {where}" if name else where, gray, strength=0.5)
        for item in reversed(classes):  # the first on top
            item.draw(axes, keypoints)
        return axes

    def join(
        self, panels: Sequence[Axes], classes: Sequence[_Class], keypoints: Sequence[NDArray[np.floating]]
    ) -> None:
        """Lines across both views for some of the kept matches, at most one from each cell of a coarse grid."""
        taken: set[tuple[int, ...]] = set()
        cell = max(panels[0].get_xlim()[1], panels[0].get_ylim()[0]) / _NUM_CELLS
        for item in classes:
            for k in np.flatnonzero(item.mask) if item.marker == "o" else ():
                place = tuple((keypoints[0][k] // cell).astype(int))
                if place in taken or not np.isfinite([keypoints[0][k], keypoints[1][k]]).all():
                    continue
                taken.add(place)
                line = ConnectionPatch(
                    keypoints[0][k],
                    keypoints[1][k],
                    coordsA=panels[0].transData,
                    coordsB=panels[1].transData,
                    color=item.color,
                    linewidth=0.6,
                    alpha=0.6,
                )
                self.figure.add_artist(line)

    def legend(self, row: int, handles: list[Line2D]) -> None:
        y = (self._bottom(row) - 0.5 * _LEGEND_IN) / self.size[1]
        options = {"handlelength": 1.2, "handletextpad": 0.4, "columnspacing": 1.0, "borderpad": 0, "frameon": False}
        self.figure.legend(
            handles=handles,
            loc="center",
            bbox_to_anchor=(0.5, y),
            ncols=len(handles),
            fontsize=_FONT_SIZE,
            **options,
        )


def _classes(
    inlier: Tensor, tested: Tensor | None, correct: Tensor | None, valid: Tensor | None, num_matches: int
) -> list[_Class]:
    """How the matches are told apart, the errors that matter most first."""
    if correct is None and valid is None:
        kept: NDArray[np.bool_] = inlier.numpy(force=True)
        known: NDArray[np.bool_] = np.ones(num_matches, np.bool_)
        if tested is not None:
            check_vector("tested", tested, num_matches)
            known = tested.numpy(force=True)
        return [
            _Class("kept", kept, BLUE, "o"),
            _Class("rejected", ~kept & known, VERMILLION, "x"),
            _Class("untested", ~known, GREY, "x"),
        ]
    if correct is None or valid is None:
        raise ValueError("correct and valid must be given together, got only one of them")
    return _truth_classes(inlier, correct, valid, num_matches)


def _truth_classes(inlier: Tensor, correct: Tensor, valid: Tensor, num_matches: int) -> list[_Class]:
    check_vector("inlier", inlier, num_matches)
    check_vector("correct", correct, num_matches)
    check_vector("valid", valid, num_matches)
    kept, right, known = inlier.numpy(force=True), correct.numpy(force=True), valid.numpy(force=True)
    classes = [
        _Class("kept, incorrect", kept & known & ~right, VERMILLION, "o"),
        _Class("kept, correct", kept & known & right, BLUE, "o"),
        _Class("rejected, incorrect", ~kept & known & ~right, VERMILLION, "x"),
        _Class("rejected, correct", ~kept & known & right, BLUE, "x"),
        _Class("kept, unknown", kept & ~known, GREY, "o"),
        _Class("rejected, unknown", ~kept & ~known, GREY, "x"),
    ]
    return [item for item in classes if item.color != GREY or item.mask.any()]


def _check_pair(image0: Tensor, image1: Tensor, matches: Matches) -> None:
    """Raise unless there is one pair and its images can be drawn."""
    if matches.num_pairs != 1:
        raise ValueError(f"matches must be of one pair, got {matches.num_pairs}")
    for name, image in (("image0", image0), ("image1", image1)):
        if image.ndim != 3 or image.shape[0] not in (1, 3):
            raise ValueError(f"{name} must have shape (C, H, W) with C = 1 or 3, got {tuple(image.shape)}")
        if image.dtype != torch.uint8:
            raise TypeError(f"{name} must be uint8, got {image.dtype}")


def _edges(adjacency: Adjacency) -> NDArray[np.int64]:
    """(E,) edges, each once, as row * M + column."""
    rows, columns = adjacency.row_indices.numpy(force=True), adjacency.col_indices.numpy(force=True)
    keys: NDArray[np.int64] = rows * adjacency.num_nodes + columns
    return keys[rows < columns]


def _draw_lines(axes: Axes, lines: Any, color: str, width: float) -> None:
    axes.add_collection(LineCollection(lines, colors=color, linewidths=width), autolim=False)


def _closed(contour: NDArray[Any]) -> NDArray[Any]:
    return np.concatenate([contour, contour[:1]])


def _gray(image: Tensor) -> NDArray[np.uint8]:
    """(H, W) luma of a (C, H, W) image."""
    planes = image.numpy(force=True)
    if len(planes) == 1:
        return planes[0]  # type: ignore[no-any-return]
    return np.tensordot([0.299, 0.587, 0.114], planes, 1).round().astype(np.uint8)  # ITU-R BT.601
