"""Two image files and a disparity map of any method -> a file of probabilities, a figure, and rates against truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from tensor_stereo.datasets.discovery import find_scale
from tensor_stereo.datasets.images import read_image
from tensor_stereo.datasets.map_files import read_map, write_confidence
from tensor_stereo.dense.confidence import ScoredDisparity, check_settings, check_verdict, score_disparity
from tensor_stereo.dense.confidence_network import TOLERANCES_PX
from tensor_stereo.evaluation.sparsification import sparsification_area
from tensor_stereo.features import to_gray
from tensor_stereo.paths import MAPS, has_ending, prepare_targets
from tensor_stereo.reports.figures import DPI, write_figure

_WIDTH_IN, _GAP_IN, _LABEL_IN = 5.0, 0.15, 0.3  # of one panel
_UNKNOWN = "#BBBBBB"
BAD_PX = (0.5, 1.0, 2.0, 3.0, 4.0)  # as Middlebury and KITTI count
RATES = (
    *(name + ending for name in ("bad", *(f"bad_{px:g}px" for px in BAD_PX), "epe_px") for ending in ("", "_kept")),
    "sparsification",
    "sparsification_optimum",
)
"""Share of the known pixels, and of the kept ones, whose error is too large (``bad``: by the tolerance asked for) or
above some px; mean error; mean share of wrong pixels as the least confident ones are taken away, and its optimum."""

Values = NDArray[np.float32]


@dataclass(frozen=True)
class ConfidenceSummary:
    """What is known of one map, and of the part that is kept.

    Attributes:
        num_pixels: Pixels that are judged.
        num_known: Those with a disparity.
        num_kept: Those that the verdict keeps.
        expected_precision: Mean probability of the kept ones; NaN without any.
        rates: Against ground truth, by the names of :data:`RATES`; empty without it.
    """

    num_pixels: int
    num_known: int
    num_kept: int
    expected_precision: float
    rates: dict[str, float]


def score_disparity_files(
    left: Path | str,
    right: Path | str,
    disparity: Path | str,
    *,
    disparity1: Path | str | None = None,
    scale: float | None = None,
    unknown: float | None = None,
    max_error_px: float = 1.0,
    max_error_share: float = 0.0,
    stride: int = 1,
    threshold: float | None = None,
    min_precision: float | None = None,
    disparity_gt: Path | str | None = None,
    gt_scale: float | None = None,
    sample_bits: int | None = None,
    out: Path | str | None = None,
    figure: Path | str | None = None,
) -> ConfidenceSummary:
    """How likely is every pixel of a disparity map right?

    Args:
        left: Image of view 0, rectified.
        right: Image of view 1, of the same size.
        disparity: Map of view 0, x0 - x1 in px: .pfm, .png, .npy or .tiff, as
            :func:`tensor_stereo.datasets.map_files.read_map` reads them.
        disparity1: Map of view 1 in the same form; None: not known.
        scale: Stored value / px of both maps; integers need it.
        unknown: A stored value that stands for an unknown disparity.
        max_error_px: A pixel is right if its error is at most this,
        max_error_share: or at most this share of its estimate.
        stride: Distance of the pixels that are judged.
        threshold: Least probability of a kept pixel; None: .5, unless ``min_precision`` is given.
        min_precision: Least expected share of the kept pixels that is right.
        disparity_gt: Ground truth of view 0, PFM or PNG.
        gt_scale: Stored value / px of ground truth in a PNG; None: the one of the release, if its folders tell it.
        sample_bits: Bits in use, 8 to 16, of views that store 16 bits per sample and do not tell.
        out: File of the probabilities, .pfm, .png (16 bits, 65535 is 1), .npy or .tiff; 0 where unknown.
        figure: File .png of view 0, the map, its confidence, what is kept, and its errors with ground truth.

    Returns:
        Counts, and rates with ground truth.

    Raises:
        ValueError: for damaged files, other sizes or endings, or settings out of range.
        FileNotFoundError: if a file is missing.
        OSError: if a result cannot be written; its folder is made.
    """
    left, right, disparity = Path(left), Path(right), Path(disparity)
    disparity1, disparity_gt, out, figure = (
        None if path is None else Path(path) for path in (disparity1, disparity_gt, out, figure)
    )
    sources = {"left": left, "right": right, "disparity": disparity, "disparity1": disparity1}
    prepare_targets({"out": (out, MAPS), "figure": (figure, (".png",))}, sources | {"disparity_gt": disparity_gt})
    check_settings(max_error_px, max_error_share, stride)
    check_verdict(threshold, min_precision)
    image0, image1 = (read_image(path, sample_bits=sample_bits) for path in (left, right))
    given = torch.from_numpy(read_map(disparity, scale=scale, unknown=unknown))
    other = None
    if disparity1 is not None:
        other = torch.from_numpy(read_map(disparity1, scale=scale, unknown=unknown, name="disparity1"))
    truth = None
    if disparity_gt is not None:
        if gt_scale is None and not has_ending(disparity_gt, ".pfm"):
            gt_scale = find_scale(left, disparity_gt)
        truth = torch.from_numpy(read_map(disparity_gt, scale=gt_scale, name="disparity_gt", scale_name="gt_scale"))
        if truth.shape != given.shape:
            sizes = f"{tuple(given.shape)} of disparity, got {tuple(truth.shape)}"
            raise ValueError(f"disparity_gt must have the size {sizes}")
    found = score_disparity(
        given, image0, image1, other, stride, max_error_px=max_error_px, max_error_share=max_error_share
    )
    kept = found.keep(threshold=threshold, min_precision=min_precision)[0, 0]
    if out is not None:
        write_confidence(out, found.probability[0, 0].numpy())
    if figure is not None:
        write_figure(draw_confidence(image0, found, kept, truth, title=disparity.name), figure)
    return summarize_confidence(found, kept, truth, max_error_px=max_error_px, max_error_share=max_error_share)


def summarize_confidence(
    found: ScoredDisparity,
    kept: Tensor,
    truth: Tensor | None = None,
    *,
    max_error_px: float = 1.0,
    max_error_share: float = 0.0,
) -> ConfidenceSummary:
    """Counts of a map and of the part that is kept, and their rates against ground truth.

    Args:
        found: Of one map.
        kept: (H', W') bool.
        truth: (H, W) px, NaN where unknown.
        max_error_px: A pixel is right if its error is at most this,
        max_error_share: or at most this share of its estimate.

    >>> zeros = torch.zeros(1, 1, 8, 9)
    >>> found = ScoredDisparity(zeros, zeros == 0, zeros, torch.zeros(1, 7, 8, 9), 1)
    >>> summarize_confidence(found, zeros[0, 0] == 0, torch.full((8, 9), 1.5)).rates["bad_1px"]
    1.0
    """
    known, probability = found.known[0, 0], found.probability[0, 0]
    chosen = probability[kept].double()
    expected = float(chosen.mean()) if len(chosen) else float("nan")
    counts = (known.numel(), int(known.sum()), int(kept.sum()), expected)
    if truth is None:
        return ConfidenceSummary(*counts, {})
    disparity = found.disparity[0, 0]
    error = (disparity - truth[:: found.stride, :: found.stride]).abs()
    judged = known & error.isfinite()
    tolerance = (max_error_share * disparity.abs()).clamp(max_error_px, TOLERANCES_PX[-1])
    measures = {"bad": error > tolerance} | {f"bad_{px:g}px": error > px for px in BAD_PX} | {"epe_px": error}
    rates = {}
    for name, values in measures.items():
        for ending, part in (("", judged), ("_kept", judged & kept)):
            rates[name + ending] = float(values[part].double().mean())
    wrong = measures["bad"][judged]
    rates["sparsification"] = sparsification_area(probability[judged], wrong)
    rates["sparsification_optimum"] = sparsification_area(-wrong.float(), wrong)
    return ConfidenceSummary(*counts, rates)


def draw_confidence(
    image: Tensor, found: ScoredDisparity, kept: Tensor, truth: Tensor | None = None, *, title: str = ""
) -> Figure:
    """View 0, the map, its confidence and what is kept; with ground truth also the errors of all and of what is kept.

    Args:
        image: (C, H, W) view 0.
        found: Of one map.
        kept: (H', W') bool.
        truth: (H, W) px, NaN where unknown.
        title: Above all.

    >>> zeros = torch.zeros(1, 1, 8, 9)
    >>> found = ScoredDisparity(zeros, zeros == 0, zeros, torch.zeros(1, 7, 8, 9), 1)
    >>> len(draw_confidence(torch.zeros(1, 8, 9, dtype=torch.uint8), found, zeros[0, 0] == 0).axes)
    4
    """
    disparity, probability = found.disparity[0, 0].numpy(), found.probability[0, 0].numpy()
    unknown, rejected = ~found.known[0, 0].numpy(), ~kept.numpy()
    gray = to_gray(image[None])[0, 0, :: found.stride, :: found.stride].numpy()
    low, high = np.nanquantile(disparity, [0.01, 0.99]) if not unknown.all() else (0.0, 1.0)
    shown = {"cmap": "viridis", "vmin": float(low), "vmax": float(max(high, low + 1e-3))}
    share = float(kept.sum()) / max(int((~unknown).sum()), 1)
    panels: list[tuple[str, Values, NDArray[np.bool_], dict[str, object]]] = [
        ("view 0", gray.astype(np.float32), np.zeros_like(unknown), {"cmap": "gray", "vmin": 0, "vmax": 255}),
        ("disparity", disparity, unknown, shown),
        ("probability, from 0 (dark) to 1", probability, unknown, {"cmap": "cividis", "vmin": 0, "vmax": 1}),
        (f"kept: {100 * share:.0f} % of the known pixels", disparity, rejected, shown),
    ]
    if truth is not None:
        error = np.abs(disparity - truth.numpy()[:: found.stride, :: found.stride])
        style = {"cmap": "magma", "vmin": 0, "vmax": 4}
        panels.append(("error, from 0 to 4 px and more", error, ~np.isfinite(error), style))
        panels.append(("error of what is kept", error, ~np.isfinite(error) | rejected, style))
    rows = len(panels) // 2
    height = _WIDTH_IN * gray.shape[0] / gray.shape[1]
    size = (2 * _WIDTH_IN + 3 * _GAP_IN, rows * (height + _LABEL_IN) + _GAP_IN + (_LABEL_IN if title else 0))
    drawn = Figure(figsize=size, dpi=DPI)
    if title:
        drawn.text(0.5, 1 - 0.5 * _LABEL_IN / size[1], title, ha="center", va="center", fontsize=11)
    for k, (label, values, hidden, style) in enumerate(panels):
        row, column = divmod(k, 2)
        bottom = _GAP_IN + (rows - 1 - row) * (height + _LABEL_IN)
        box = (_GAP_IN + column * (_WIDTH_IN + _GAP_IN), bottom, _WIDTH_IN, height)
        axes = drawn.add_axes(tuple(np.array(box) / np.tile(size, 2)), xticks=[], yticks=[])
        _show(axes, label, np.ma.masked_array(values, hidden), style)
    return drawn


def _show(axes: Axes, label: str, values: np.ma.MaskedArray, style: dict[str, object]) -> None:
    axes.set_facecolor(_UNKNOWN)
    axes.imshow(values, interpolation="nearest", **style)  # type: ignore[arg-type]
    axes.set_title(label, pad=3, fontsize=9)
    axes.spines[:].set_visible(False)
