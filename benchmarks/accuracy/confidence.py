"""Stereo confidence against its peers: sparsification, AUC, calibration, precision at coverage.

    python benchmarks/accuracy/confidence.py --data DATA --training_data TRAINING_DATA --folds WORK

The eight scenes of the paper by the network of the package; the training scenes by those that were trained without
them, which ``training/train_confidence.py`` leaves in WORK/dense. KITTI counts errors above 3 px, all others above 1.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

from tensor_stereo.dense.confidence import load_confidence
from tensor_stereo.dense.confidence_network import TOLERANCES_PX, ConfidenceNetwork
from tensor_stereo.dense.map_evidence import NUM_OTHER, measure_map, search_range
from tensor_stereo.dense.matching_costs import cost_curves
from tensor_stereo.evaluation.sparsification import cumulative_wrong
from tensor_stereo.evaluation.sparsification import sparsification_area as area
from tensor_stereo.features import to_gray

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from accuracy.confidence_measures import (
    agreement,
    left_right,
    matching_score,
    median_deviation,
    peak_ratio,
    variance,
)
from shared.calibration_error import calibration_error
from shared.harness import Suite
from shared.scenes import EIGHT, read_pairs
from shared.sparsification import auc, keep_expected
from training.ccnn import CCNN, score_ccnn
from training.dense_maps import both_maps
from training.scenes import Views, list_scenes, read_views

COVERAGES = (0.5, 0.8, 0.95)
SHOWN = ("sgbm", "sgbm, 3way", "bm", "census")
OURS = ("ours", "ours without view 1")


class Case(NamedTuple):
    """A scene, and the networks that have not seen it."""

    scene: str
    group: str
    views: Views
    network: ConfidenceNetwork
    ccnn: CCNN | None
    max_error_px: float


def cases(suite: Suite) -> Iterator[Case]:
    """The eight scenes, then the real ones of the training set."""
    package, ccnn = load_confidence(), load_ccnn(suite.options.folds / "dense" / "ccnn.safetensors")
    for pair in read_pairs(suite.options.data / "middlebury", EIGHT):
        gray0, gray1 = (to_gray(image[None])[0, 0].numpy() for image in (pair.image0, pair.image1))
        yield Case(pair.name, "eight", Views(gray0, gray1, pair.disparity_gt.numpy(), None), package, ccnn, 1.0)
    for scene in list_scenes(suite.options.data, suite.options.training_data):
        if scene.fold is None or scene.domain not in ("middlebury", "eth3d", "kitti"):
            continue
        network = ConfidenceNetwork()
        network.load_state_dict(load_file(suite.options.folds / "dense" / f"fold-{scene.fold}.safetensors"))
        ccnn = load_ccnn(suite.options.folds / "dense" / f"ccnn-{scene.fold}.safetensors")
        group, tolerance = ("kitti", 3.0) if scene.domain == "kitti" else ("training", 1.0)
        yield Case(scene.name, group, read_views(scene), network.eval(), ccnn, tolerance)


def load_ccnn(path: Path) -> CCNN | None:
    """None if ``training/ccnn.py`` has not run."""
    if not path.exists():
        return None
    network = CCNN()
    network.load_state_dict(load_file(path))
    return network.eval()


@torch.no_grad()
def score(case: Case, method: str) -> tuple[dict[str, Tensor], Tensor, float]:
    """Every measure of one map, and its errors, at the pixels that the map and the truth know."""
    views = case.views
    truth = np.where(np.isfinite(views.disparity0), views.disparity0, np.nan)
    count = int(np.clip(np.ceil(1.25 * np.nanquantile(truth, 0.999) / 16) * 16, 32, 256))
    disparity, disparity1 = both_maps(method, views.image0, views.image1, count)
    curves = cost_curves(views.image0, views.image1, *search_range(disparity))
    maps = {
        "left-right": left_right(disparity, disparity1),
        "variance 21": variance(disparity, 21),
        "agreement 11": agreement(disparity, 11),
        "agreement 21": agreement(disparity, 21),
        "median deviation 11": median_deviation(disparity, 11),
        "matching score": matching_score(curves, 1, disparity),
        "peak ratio": peak_ratio(curves, 1, disparity),
    }
    maps["agreement 21, left-right"] = maps["agreement 21"] - np.tanh(-maps["left-right"] / 2)
    if case.ccnn is not None:
        maps["CCNN"] = score_ccnn(case.ccnn, disparity)
    planes = torch.from_numpy(measure_map(disparity, views.image0, views.image1, disparity1))
    bare = planes.clone()
    bare[-1 - NUM_OTHER : -1] = 0
    k = TOLERANCES_PX.index(case.max_error_px)
    for name, seen in zip(OURS, (planes, bare), strict=True):
        slope, bias = case.network.calibration[k]
        maps[name] = torch.sigmoid(case.network(seen[None])[0, k] * slope + bias).numpy()
    error = np.abs(disparity - truth)
    known = np.isfinite(error)
    found = {name: torch.from_numpy(np.asarray(values)[known].astype(np.float32)) for name, values in maps.items()}
    return found, torch.from_numpy(error[known]), float(np.isfinite(disparity).mean())


def measure(found: dict[str, Tensor], wrong: Tensor) -> dict[str, dict[str, float]]:
    """Figures of every measure."""
    figures = {"optimum": {"area": area(-wrong.float(), wrong)}}
    last = [int(np.ceil(share * len(wrong))) for share in COVERAGES]
    for name, values in found.items():
        right = 1 - cumulative_wrong(values, wrong)[torch.tensor(last) - 1] / torch.tensor(last)
        figures[name] = {"area": area(values, wrong), "auc": auc(values, ~wrong)}
        figures[name] |= {f"precision at {c:g}": float(r) for c, r in zip(COVERAGES, right, strict=True)}
        if name in OURS:
            figures[name]["calibration error"] = calibration_error(values, ~wrong)
            kept = keep_expected(values, 0.95)
            figures[name]["precision of .95"] = float((~wrong[kept]).double().mean()) if len(kept) else 1.0
            figures[name]["coverage of .95"] = len(kept) / len(values)
    return figures


def main() -> None:
    suite = Suite("confidence", training_data="folder of the training scenes", folds="work folder of the training")
    rows: dict[tuple[str, str], list[dict[str, dict[str, float]]]] = defaultdict(list)
    for case in cases(suite):
        for method in SHOWN if case.group != "kitti" else SHOWN[:1]:
            found, error, _ = score(case, method)
            rows[case.group, method].append(measure(found, error > case.max_error_px))
    for (group, method), scenes in rows.items():
        mean = {
            name: {key: float(np.nanmean([scene[name][key] for scene in scenes])) for key in scenes[0][name]}
            for name in scenes[0]
        }
        best = mean["optimum"]["area"]
        check = mean["left-right"]["area"] - best
        print(f"{group}, {method}, {len(scenes)} maps: optimum {best:.4f}")
        for name, figures in mean.items():
            share = (figures["area"] - best) / check
            suite.records.append({"group": group, "method": method, "measure": name, "share": share, **figures})
            print(
                f"  {name:26} share {share:6.3f}  " + "  ".join(f"{k} {v:.4f}" for k, v in figures.items()), flush=True
            )
    suite.write()


if __name__ == "__main__":
    main()
