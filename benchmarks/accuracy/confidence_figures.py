"""Figures of the confidence of dense maps."""

from __future__ import annotations

from typing import Any

import numpy as np

from shared.figures import plt, save_figure

_PANELS = (
    ("eight", "sgbm", "eight scenes, semi-global maps"),
    ("eight", "bm", "eight scenes, block matching"),
    ("eight", "network", "eight scenes, a network's winners"),
    ("training", "sgbm", "17 scenes out of fold, semi-global maps"),
    ("kitti", "sgbm", "KITTI out of fold, semi-global maps, 3 px"),
    ("kitti", "network", "KITTI out of fold, a network's winners, 3 px"),
)
_STYLES = {
    "left-right": {"color": "0.6"},
    "variance 21": {"color": "C4"},
    "agreement 21": {"color": "C1"},
    "peak ratio": {"color": "C5"},
    "ambiguity (pandora)": {"color": "C8"},
    "CCNN": {"color": "C3"},
    "ours": {"color": "C0", "lw": 2.5},
    "optimum": {"color": "k", "ls": ":"},
}


def draw_curves(records: list[dict[str, Any]]) -> None:
    """results/confidence_curves.png: mean sparsification curves of the main measures, one panel per kind of maps."""
    curves = {(r["group"], r["method"], r["measure"]): r for r in records if "curve" in r}
    figure, axes = plt.subplots(2, 3, figsize=(14, 7.5), constrained_layout=True)
    for axis, (group, method, title) in zip(axes.flat, _PANELS, strict=True):
        for name, style in _STYLES.items():
            record = curves.get((group, method, name))
            if record is not None:
                label = name if name == "optimum" else f"{name}: {record['share']:.2f}"
                axis.plot(np.arange(1, 21) * 5, 100 * np.array(record["curve"]), label=label, **style)
        axis.set(title=title, xlim=(5, 100), ylim=(0, None))
        axis.legend(fontsize=8, title="area above the optimum,\nshare of left-right's", title_fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("pixels kept, %")
    for axis in axes[:, 0]:
        axis.set_ylabel("wrong ones among them, %")
    save_figure(figure, "confidence_curves")


def draw_maps(error: np.ndarray, maps: dict[str, np.ndarray], view: np.ndarray) -> None:
    """results/confidence_maps.png: a view, the errors of its map, and the confidence of every measure by rank."""
    known = np.isfinite(error)
    panels = {"view 0": (view, {"cmap": "gray"}), "error, 0 to 4 px": (error, {"cmap": "magma", "vmin": 0, "vmax": 4})}
    for name, values in maps.items():
        ranks = np.searchsorted(np.sort(values[known]), values) / known.sum()
        panels[name] = np.where(known, ranks, np.nan), {"cmap": "cividis"}
    columns = 4
    rows = -(-len(panels) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(14, 2.9 * rows), constrained_layout=True)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, (name, (values, style)) in zip(axes.flat, panels.items(), strict=False):
        axis.imshow(values, **style)
        axis.set_title(name, fontsize=10)
    figure.suptitle("a semi-global map of a rendered pair: its errors, and what each measure trusts (bright), by rank")
    save_figure(figure, "confidence_maps", dpi=70)
