"""Draw verdicts.png, the picture of the README: ``python docs/make_picture.py``, or with another place for the file.

The scene is rendered from a seed that no training of the learned score has seen. Detector and settings are the
defaults.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from torch import Tensor

import tensor_stereo as ts
from tensor_stereo.datasets import render_pair
from tensor_stereo.evaluation import matches_against_gt
from tensor_stereo.reports.figures import BLUE, VERMILLION, write_figure

SCENE = (2016, 4)  # a room; the README classifies the same pair
MAX_ERROR_PX = 1.0  # of the disparity, and of the row, of a correct match
WIDTH_IN, GAP_IN, CAPTION_IN = 4.0, 0.1, 0.42  # of one panel, between panels, of the two lines above a panel
NUM_GREYS = 20  # in the background, so that the file stays small


def main(path: Path) -> None:
    """Render the pair, decide about its matches, draw four panels and write them."""
    pair = render_pair(SCENE)
    output = ts.run_pipeline([(pair.image0, pair.image1)])
    matches = output.matches
    correct, _ = matches_against_gt(matches, [pair.disparity_gt], max_error_px=MAX_ERROR_PX)  # known everywhere here
    verdict = output.classification
    shown = {
        "putative matches": torch.ones_like(correct),
        "the paper: Restriction 2 (cardinality)": verdict.inlier_of("cardinality"),
        "learned, probability ≥ .5 (the default)": verdict.inlier,
    }
    height, width = pair.image0.shape[-2:]
    panel = np.array([WIDTH_IN, WIDTH_IN * height / width])
    size = 2 * panel + [3 * GAP_IN, 2 * CAPTION_IN + 2 * GAP_IN]
    figure = Figure(figsize=tuple(size), dpi=100)
    for k, name in enumerate(["left image", *shown]):
        row, column = divmod(k, 2)
        corner = [GAP_IN + column * (panel[0] + GAP_IN), GAP_IN + (1 - row) * (panel[1] + CAPTION_IN + GAP_IN)]
        axes = figure.add_axes((*(corner / size), *(panel / size)), xticks=[], yticks=[])
        draw_image(axes, pair.image0[0], strength=0.35 if name in shown else 1.0)
        if name in shown:
            draw_kept(axes, matches, shown[name], correct)
            caption(axes, name, (shown[name] & correct).sum(), (shown[name] & ~correct).sum())
        else:
            axes.text(0, 1.015, "a rendered scene: the left image", **style(axes))
    write_figure(figure, path)


def draw_image(axes: Axes, image: Tensor, *, strength: float) -> None:
    """The (H, W) image, faded towards white, one pixel of it to a pixel of the picture."""
    height, width = image.shape
    step = 255 / NUM_GREYS
    gray = ((255 - strength * (255 - image.float())) / step).round() * step
    axes.imshow(gray, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), autoscale_on=False)
    axes.spines[:].set_visible(False)


def draw_kept(axes: Axes, matches: ts.Matches, kept: Tensor, correct: Tensor) -> None:
    """Each kept match as a line from its place in the left image to its place in the right one, a dot at the left."""
    lines = torch.stack([matches.keypoints0, matches.keypoints1], 1).numpy()  # (M, 2, 2)
    for color, chosen in ((VERMILLION, kept & ~correct), (BLUE, kept & correct)):
        part = lines[chosen.numpy()]
        axes.add_collection(LineCollection(part, colors=color, linewidths=0.8), autolim=False)
        axes.plot(*part[:, 0].T, linestyle="none", marker="o", markersize=2.8, color=color)


def caption(axes: Axes, name: str, num_correct: Tensor, num_wrong: Tensor) -> None:
    """Two lines above a panel: its name, and how many matches it shows, in their colours."""
    axes.text(0, 1.075, name, **style(axes))
    axes.text(0, 1.015, f"{num_correct} correct", color=BLUE, fontweight="bold", **style(axes))
    axes.text(0.29, 1.015, f"{num_wrong} wrong", color=VERMILLION, fontweight="bold", **style(axes))


def style(axes: Axes) -> dict[str, Any]:
    """Of a text above a panel."""
    return {"transform": axes.transAxes, "fontsize": 10.5, "va": "bottom"}


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("verdicts.png"))
