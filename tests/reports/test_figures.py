from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from matplotlib import _pylab_helpers
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from scipy.spatial import Delaunay

from tensor_stereo.reports.figures import draw_classification, write_figure
from tensor_stereo.types import Adjacency, Matches

BLUE, VERMILLION, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#595959"
SHAPE = (1, 60, 90)


def delaunay(points: np.ndarray) -> set[tuple[int, int]]:
    if len(points) < 3:
        return set(combinations(range(len(points)), 2))
    return {(int(a), int(b)) for simplex in Delaunay(points).simplices for a, b in combinations(sorted(simplex), 2)}


def adjacency(edges: set[tuple[int, int]], num_nodes: int) -> Adjacency:
    both = sorted(edges | {(b, a) for a, b in edges})
    rows, columns = torch.tensor(both, dtype=torch.int64).reshape(-1, 2).unbind(1)
    crow = torch.searchsorted(rows.contiguous(), torch.arange(num_nodes + 1))
    return Adjacency(crow, columns, torch.tensor([0, num_nodes]))


def scene(num_matches: int, seed: int = 0, names: Sequence[str] = ("by score",)) -> dict[str, Any]:
    """Arguments of draw_classification with a verdict of each name, and as ``edges`` the two graphs as Python sets."""
    draw = np.random.default_rng(seed)
    _, height, width = SHAPE
    keypoints = [draw.uniform(0, 1, (num_matches, 2)) * [width - 1, height - 1] for _ in range(2)]
    moved = draw.random(num_matches) < 0.8
    keypoints[1][moved] = keypoints[0][moved] - [3, 0]
    keypoints = [points.astype(np.float32) for points in keypoints]
    edges = [delaunay(points) for points in keypoints]
    tested = torch.from_numpy(draw.random(num_matches) < 0.8)
    verdicts = {name: tested & torch.from_numpy(draw.random(num_matches) < 0.5) for name in names}
    return {
        "image0": torch.from_numpy(draw.integers(0, 256, SHAPE, dtype=np.uint8)),
        "image1": torch.from_numpy(draw.integers(0, 256, SHAPE, dtype=np.uint8)),
        "matches": Matches(*map(torch.from_numpy, keypoints), ptr=torch.tensor([0, num_matches])),
        "verdicts": verdicts,
        "tested": tested,
        "edges": edges,
        "correct": torch.from_numpy(draw.random(num_matches) < 0.5),
        "valid": torch.from_numpy(draw.random(num_matches) < 0.8),
    }


def render(case: dict[str, Any], *, truth: bool = True, **options: Any) -> Figure:
    num_matches = case["matches"].num_matches
    known = {name: case[name] for name in (("correct", "valid") if truth else ("tested",))}
    graphs = [adjacency(edges, num_matches) for edges in case["edges"]]
    inputs = [case[name] for name in ("image0", "image1", "matches", "verdicts")]
    return draw_classification(*inputs, *graphs, **known, **options)


def legend_labels(figure: Figure) -> list[list[str]]:
    return [[text.get_text() for text in legend.get_texts()] for legend in figure.legends]


def panels(figure: Figure, start: str) -> list[int]:
    """Numbers of the axes whose title starts so, from left to right."""
    found = [k for k, axes in enumerate(figure.axes) if axes.get_title().startswith(start)]
    return sorted(found, key=lambda k: figure.axes[k].get_position().x0)


def views(case: dict[str, Any]) -> list[tuple[str, torch.Tensor]]:
    return [("left", case["matches"].keypoints0), ("right", case["matches"].keypoints1)]


def drawn_points(figure: Figure, panel: int) -> dict[tuple[str, str], set[tuple[float, float]]]:
    return {
        (to_hex(line.get_color()), str(line.get_marker())): set(map(tuple, line.get_xydata().tolist()))
        for line in figure.axes[panel].lines
    }


def drawn_segments(figure: Figure, panel: int, color: str) -> set[frozenset[tuple[float, float]]]:
    segments = set()
    for lines in figure.axes[panel].collections:
        if isinstance(lines, LineCollection) and to_hex(lines.get_color()[0]) == color:
            segments |= {frozenset(map(tuple, segment.tolist())) for segment in lines.get_segments()}
    return segments


@pytest.mark.parametrize("names", [("by score",), ("learned, probability 0.5", "cardinality"), ("a", "b", "c")])
def test_matches_are_drawn_and_counted_by_truth_in_a_row_for_each_verdict(names: Sequence[str]) -> None:
    case = scene(120, names=names)
    figure = render(case)
    correct, valid = case["correct"], case["valid"]
    assert len(figure.legends) == len(names) + 1
    assert len(figure.axes) == 2 * (len(names) + 1)
    for row, (name, kept) in enumerate(case["verdicts"].items()):
        expected = {
            "kept, incorrect": (VERMILLION, "o", kept & valid & ~correct),
            "kept, correct": (BLUE, "o", kept & valid & correct),
            "rejected, incorrect": (VERMILLION, "x", ~kept & valid & ~correct),
            "rejected, correct": (BLUE, "x", ~kept & valid & correct),
            "kept, unknown": (GREY, "o", kept & ~valid),
            "rejected, unknown": (GREY, "x", ~kept & ~valid),
        }
        assert legend_labels(figure)[row] == [f"{kind}: {int(mask.sum())}" for kind, (*_, mask) in expected.items()]
        for view, (side, keypoints) in enumerate(views(case)):
            points = {
                (color, marker): set(map(tuple, keypoints[mask].tolist())) for color, marker, mask in expected.values()
            }
            (panel,) = panels(figure, f"{name}: view {view} ({side})")
            assert drawn_points(figure, panel) == points
            assert all(points.values())


def test_verdicts_lie_from_top_to_bottom_and_the_graphs_below_them() -> None:
    figure = render(scene(30, names=("first", "second")), title="A pair")
    tops = {
        start: [figure.axes[k].get_position().y1 for k in panels(figure, start)]
        for start in ("first: view", "second: view", "Delaunay graph")
    }
    assert all(len(heights) == 2 and heights[0] == heights[1] for heights in tops.values())
    order = [heights[0] for heights in tops.values()]
    assert order == sorted(order, reverse=True)
    assert len(set(order)) == 3
    lower = [figure.axes[k].get_position().y0 for k in panels(figure, "first: view")]
    assert min(lower) > max(tops["second: view"])


@pytest.mark.parametrize("names", [("by score",), ("by score", "cardinality")])
def test_without_truth_the_verdicts_alone_are_drawn(names: Sequence[str]) -> None:
    case = scene(120, names=names)
    figure, untested = render(case, truth=False), ~case["tested"]
    styles = (BLUE, "o"), (VERMILLION, "x"), (GREY, "x")
    for row, (name, kept) in enumerate(case["verdicts"].items()):
        masks = {"kept": kept, "rejected": ~kept & ~untested, "untested": untested}
        assert all(mask.any() for mask in masks.values())
        assert legend_labels(figure)[row] == [f"{kind}: {int(mask.sum())}" for kind, mask in masks.items()]
        for view, (_, keypoints) in enumerate(views(case)):
            (panel,) = panels(figure, f"{name}: view {view}")
            assert drawn_points(figure, panel) == {
                style: set(map(tuple, keypoints[mask].tolist()))
                for style, mask in zip(styles, masks.values(), strict=True)
            }


def test_matches_count_as_rejected_where_nothing_says_that_they_are_untested() -> None:
    case = scene(60)
    figure = render(case | {"tested": None}, truth=False)
    kept = int(case["verdicts"]["by score"].sum())
    assert legend_labels(figure)[0] == [f"kept: {kept}", f"rejected: {60 - kept}", "untested: 0"]


def test_unknown_truth_has_no_entry_where_all_is_known() -> None:
    case = scene(50)
    case["valid"][:] = True
    assert len(legend_labels(render(case))[0]) == 4


def test_edges_of_both_views_are_told_from_those_of_one() -> None:
    case = scene(80, names=("by score", "cardinality"))
    figure = render(case)
    edges0, edges1 = case["edges"]
    for panel, keypoints, own, other in zip(
        panels(figure, "Delaunay graph"),
        (case["matches"].keypoints0, case["matches"].keypoints1),
        (edges0, edges1),
        (edges1, edges0),
        strict=True,
    ):
        points = list(map(tuple, keypoints.tolist()))
        for color, chosen in ((BLUE, own & other), (VERMILLION, own - other)):
            assert chosen
            assert drawn_segments(figure, panel, color) == {frozenset((points[a], points[b])) for a, b in chosen}
        title = figure.axes[panel].get_title()
        assert f": {len(own)} edges, {len(own & other)} of them" in title


def test_contours_are_closed_and_drawn_in_their_view_only_when_given() -> None:
    case = scene(20)
    contour = torch.tensor([[2, 2], [3, 3], [4, 2]], dtype=torch.int32)
    figure = render(case, contours0=[contour])
    left, right = panels(figure, "Delaunay graph")
    assert len(drawn_segments(figure, right, GREEN)) == 0
    (lines,) = [c for c in figure.axes[left].collections if to_hex(c.get_color()[0]) == GREEN]
    assert lines.get_segments()[0].tolist() == [[2, 2], [3, 3], [4, 2], [2, 2]]
    assert "object contour" in legend_labels(figure)[1]
    assert "object contour" not in legend_labels(render(case))[1]


@pytest.mark.parametrize("num_matches", [0, 1, 2, 3])
@pytest.mark.parametrize("truth", [True, False])
def test_few_matches_are_drawn(num_matches: int, truth: bool, tmp_path: Path) -> None:
    figure = render(scene(num_matches), truth=truth, contours0=[], contours1=[])
    write_figure(figure, tmp_path / "few.png")
    assert (tmp_path / "few.png").stat().st_size > 0


@pytest.mark.parametrize("size", [(370, 463), (375, 1242), (900, 500), (64, 64)])
@pytest.mark.parametrize("num_verdicts", [1, 2])
def test_panels_have_the_aspect_of_the_image_and_legends_fit(size: tuple[int, int], num_verdicts: int) -> None:
    image = torch.zeros(3, *size, dtype=torch.uint8)
    case = scene(9999, names=("by score", "b")[:num_verdicts])  # numbers of four digits
    case |= {"image0": image, "image1": image, "edges": [set(), set()]}
    figure = render(case, title="A pair")
    figure.draw_without_rendering()
    for axes in figure.axes:
        box = axes.get_window_extent()
        assert box.height / box.width == pytest.approx(size[0] / size[1], rel=1e-6)
        np.testing.assert_allclose(axes.get_position(original=True), axes.get_position(), atol=1e-6)  # no blank strip
    for legend in figure.legends:
        box = legend.get_window_extent()
        assert box.x0 >= 0
        assert box.x1 <= figure.bbox.x1
        assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)


def test_image_is_placed_with_pixel_centres_at_integers() -> None:
    axes = render(scene(5)).axes[0]
    assert axes.images[0].get_extent() == [-0.5, 89.5, 59.5, -0.5]
    assert axes.get_xlim() == (-0.5, 89.5)
    assert axes.get_ylim() == (59.5, -0.5)


def test_colour_images_are_drawn_as_opencv_greys_them() -> None:
    case = scene(5)
    draw = np.random.default_rng(0)
    color = draw.integers(0, 256, (60, 90, 3), dtype=np.uint8)
    images = []
    for planes in (color.transpose(2, 0, 1), cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)[None]):
        case["image0"] = torch.from_numpy(np.ascontiguousarray(planes))
        images.append(np.asarray(render(case).axes[0].images[0].get_array(), dtype=int))
    assert np.abs(images[0] - images[1]).max() <= 1  # OpenCV works in fixed point


def test_pyplot_stays_untouched() -> None:
    before = len(_pylab_helpers.Gcf.figs)
    render(scene(10))
    assert len(_pylab_helpers.Gcf.figs) == before


def test_equal_figures_give_equal_png_files(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        write_figure(render(scene(60), title="A pair"), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_palette_of_the_file_keeps_the_picture(tmp_path: Path) -> None:
    case = scene(60)
    ramp = torch.arange(90, dtype=torch.uint8).expand(1, 60, 90) * 2
    figure = render(case | {"image0": ramp, "image1": ramp}, title="A pair")
    write_figure(figure, tmp_path / "a.png")
    figure.savefig(tmp_path / "full.png")
    written, full = (cv2.imread(str(tmp_path / name)).astype(int) for name in ("a.png", "full.png"))
    assert written.shape == full.shape
    assert np.abs(written - full).mean() < 2  # grey levels


def test_other_formats_and_wrong_paths(tmp_path: Path) -> None:
    figure = render(scene(5))
    write_figure(figure, str(tmp_path / "a.pdf"))
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    with pytest.raises(FileNotFoundError):
        write_figure(figure, tmp_path / "none" / "a.png")
    with pytest.raises(ValueError, match="not supported"):
        write_figure(figure, tmp_path / "a.xyz")


def test_figures_name_what_is_wrong() -> None:
    case = scene(4)
    graph = adjacency(set(), 4)
    inputs = [case[name] for name in ("image0", "image1", "matches", "verdicts")]
    with pytest.raises(ValueError, match="verdicts must hold at least one"):
        draw_classification(*inputs[:3], {}, graph, graph)
    with pytest.raises(ValueError, match=r"must have shape \(4,\)"):
        draw_classification(*inputs[:3], {"a": case["tested"], "b": case["tested"][:3]}, graph, graph)
    with pytest.raises(ValueError, match="tested must have shape"):
        draw_classification(*inputs, graph, graph, tested=case["tested"][:3])
    with pytest.raises(ValueError, match="adjacency1 must have 4 nodes"):
        draw_classification(*inputs, graph, adjacency(set(), 3))
    with pytest.raises(ValueError, match="given together"):
        draw_classification(*inputs, graph, graph, correct=case["correct"])
    with pytest.raises(ValueError, match="valid must have shape"):
        draw_classification(*inputs, graph, graph, correct=case["correct"], valid=case["valid"][:2])
    two = Matches(case["matches"].keypoints0, case["matches"].keypoints1, torch.tensor([0, 2, 4]))
    with pytest.raises(ValueError, match="matches must be of one pair, got 2"):
        draw_classification(*inputs[:2], two, inputs[3], graph, graph)
    with pytest.raises(ValueError, match="image1 must have shape"):
        draw_classification(inputs[0], inputs[1][0], *inputs[2:], graph, graph)
    with pytest.raises(TypeError, match="image0 must be uint8"):
        draw_classification(inputs[0].float(), *inputs[1:], graph, graph)
