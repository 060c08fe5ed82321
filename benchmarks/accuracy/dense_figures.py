"""Figures of dense maps."""

from __future__ import annotations

import numpy as np

from shared.figures import plt, save_figure


def draw_bars(tables: dict[str, dict[str, dict[str, np.ndarray]]]) -> None:
    """results/dense_bad2.png: bad-2px of each filter on the eight scenes, one panel per kind of putative matches."""
    figure, axes = plt.subplots(2, 3, figsize=(12, 6.5), sharex=True, constrained_layout=True)
    for axis, (title, table) in zip(axes.T.flat, tables.items(), strict=True):
        bad = [figures["bad2"] for figures in table.values()]
        axis.barh(range(len(bad)), [values.mean() for values in bad], color="0.8")
        for k, values in enumerate(bad):
            axis.plot(values, [k] * len(values), "k.", ms=3)
        axis.axvline(bad[-1].mean(), color="C2", lw=1)
        axis.set_yticks(range(len(bad)), table)
        axis.invert_yaxis()
        axis.set(title=title, xlabel="pixels off by more than 2 px")
    figure.suptitle("dense maps from kept matches: mean over the eight scenes; dots are scenes, the line is the oracle")
    save_figure(figure, "dense_bad2")


def draw_maps(scene: str, truth: np.ndarray, maps: dict[str, tuple[np.ndarray, np.ndarray, float]]) -> None:
    """results/dense_maps.png: maps (H, W), their anchors (K, 2) and bad-2px beside the ground truth of one scene."""
    figure, axes = plt.subplots(2, 3, figsize=(12, 7.5), constrained_layout=True)
    low, high = np.nanmin(truth), np.nanmax(truth)
    shown = {"ground truth": (truth, np.empty((0, 2)), 0.0)} | maps
    for axis, (name, (values, anchors, bad)) in zip(axes.flat, shown.items(), strict=True):
        image = axis.imshow(values, vmin=low, vmax=high, cmap="viridis")
        axis.plot(*anchors.T, "r.", ms=1)
        axis.set_axis_off()
        axis.set_title(name if name == "ground truth" else f"{name}\n{bad:.0%} off by more than 2 px")
    figure.colorbar(image, ax=axes, label="disparity in px", shrink=0.7)
    figure.suptitle(f"{scene}, FAST without gates; anchors in red")
    save_figure(figure, "dense_maps")
