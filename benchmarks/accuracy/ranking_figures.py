"""Figures of how well scores rank matches."""

from __future__ import annotations

import numpy as np

from accuracy.scores import OURS
from shared.figures import plt, save_figure

SHOWN = ("Jaccard of neighbours", "LPM", "libviso2 support", "disparity median, Delaunay", "AdaLAM", *OURS)


def _style(name: str) -> dict:
    k = SHOWN.index(name)
    return {"color": f"C{k}", "lw": 2.0 if name in OURS else 1.0, "ls": "-" if name in OURS else "--", "label": name}


def draw_roc(group: str, grid: np.ndarray, panels: dict[str, dict[str, np.ndarray]]) -> None:
    """results/accuracy_roc_GROUP.png: one panel per kind of putative matches, the mean curve over scenes."""
    figure, axes = plt.subplots(
        2, len(panels) // 2, figsize=(2 * len(panels), 7.5), sharex=True, sharey=True, constrained_layout=True
    )
    for axis, (title, curves) in zip(axes.T.flat, panels.items(), strict=True):
        for name in SHOWN:
            axis.plot(grid, curves[name], **_style(name))
        axis.set(
            title=title, xlabel="sensitivity: incorrect matches rejected", ylabel="specificity: correct matches kept"
        )
        axis.axvline(0.96, color="0.8", lw=0.8, zorder=0)
    axes.flat[0].legend(fontsize=8, loc="lower left")
    figure.suptitle(f"mean over scenes: {group}")
    save_figure(figure, f"accuracy_roc_{group}")


def draw_degradation(title: str, rows: dict[float, dict[str, np.ndarray]]) -> None:
    """results/accuracy_TITLE.png: AUC and specificity against the disturbance."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), sharex=True, constrained_layout=True)
    names = [name for name in SHOWN if name in next(iter(rows.values()))]
    for k, (axis, label) in enumerate(zip(axes, ("AUC", "specificity at sensitivity .96"), strict=True)):
        for name in names:
            axis.plot(list(rows), [np.nanmean(figures[name][:, k]) for figures in rows.values()], **_style(name))
        axis.set(xlabel=title, ylabel=label)
    axes[0].legend(fontsize=8)
    save_figure(figure, "accuracy_" + title.split(", ")[-1].replace(" ", "_"))
