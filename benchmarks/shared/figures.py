"""Figures without a display."""

from __future__ import annotations

import matplotlib as mpl
from PIL import Image

from shared.results import RESULTS

mpl.use("agg")
import matplotlib.pyplot as plt  # the backend comes first


def save_figure(figure: plt.Figure, name: str, dpi: int = 110) -> None:
    """Write results/NAME.png in a palette of 128 colours and close the figure."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.png"
    figure.savefig(path, dpi=dpi)
    plt.close(figure)
    with Image.open(path) as image:
        small = image.convert("RGB").quantize(128)
    small.save(path, optimize=True)
