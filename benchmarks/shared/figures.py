"""Figures without a display."""

from __future__ import annotations

import matplotlib as mpl

from shared.results import RESULTS

mpl.use("agg")
import matplotlib.pyplot as plt  # the backend comes first


def save_figure(figure: plt.Figure, name: str) -> None:
    """Write results/NAME.png and close the figure."""
    RESULTS.mkdir(exist_ok=True)
    figure.savefig(RESULTS / f"{name}.png", dpi=110)
    plt.close(figure)
