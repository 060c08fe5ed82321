"""Stereo confidence against its peers: sparsification, AUC, calibration, precision at coverage, time.

    python benchmarks/accuracy/confidence.py --data DATA --training_data TRAINING_DATA --folds WORK

The eight scenes of the paper by the network of the package; the training scenes by those that were trained without
them, which ``training/train_confidence.py`` leaves in WORK/dense, and the scenes of the first fold also by those that
were trained without a family of methods, on its maps. KITTI counts errors above 3 px, all others above 1. Takes 20
minutes on two cores. CCNN takes part if ``training/ccnn.py`` has run, the package pandora if it is there.
"""

from __future__ import annotations

import multiprocessing
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

from tensor_stereo.configs import SyntheticConfig
from tensor_stereo.datasets.synthetic.rendering import render_scene
from tensor_stereo.dense.confidence import load_confidence
from tensor_stereo.dense.confidence_network import TOLERANCES_PX, ConfidenceNetwork
from tensor_stereo.dense.map_evidence import measure_map, search_range
from tensor_stereo.dense.matching_costs import cost_curves
from tensor_stereo.evaluation.sparsification import cumulative_wrong, sparsification_curve
from tensor_stereo.features import to_gray

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from accuracy import confidence_measures as classic
from accuracy import pandora_ambiguity
from accuracy.confidence_figures import draw_curves, draw_maps
from shared.calibration_error import calibration_error
from shared.harness import Suite
from shared.scenes import EIGHT, read_pairs
from shared.sparsification import auc, keep_expected
from training.ccnn import CCNN, score_ccnn
from training.dense_maps import FAMILIES, METHODS, Floats, both_maps, family, make_methods
from training.matching_network import load_matching
from training.scenes import Views, list_scenes, read_views

COVERAGES = (0.5, 0.8, 0.95)
SHOWN = ("sgbm", "sgbm, 3way", "bm", "census", "network")
OURS = ("ours", "ours without view 1")
PROCESSES = 2
_LEFT_OUT_FOLD = 0
_Figures = dict[str, dict[str, float]]


class Case(NamedTuple):
    """One map of one scene, and the networks that have not seen the scene."""

    group: str
    scene: str
    number: int | None  # in the list of training scenes
    method: str
    network: Path | None  # None: the package's
    ccnn: Path
    max_error_px: float


class Sources(NamedTuple):
    data: Path
    training_data: Path
    folder: Path


def list_cases(sources: Sources) -> Iterator[Case]:
    """The eight scenes, then the real ones of the training set, then those of one fold without a family."""
    for scene in EIGHT:
        for method in SHOWN:
            yield Case("eight", scene, None, method, None, sources.folder / "ccnn.safetensors", 1.0)
    for number, scene in enumerate(list_scenes(sources.data, sources.training_data)):
        if scene.fold is None or scene.domain not in ("middlebury", "eth3d", "kitti"):
            continue
        kitti = scene.domain == "kitti"
        group, tolerance = ("kitti", 3.0) if kitti else ("training", 1.0)
        make = partial(
            Case, scene=scene.name, number=number, ccnn=sources.folder / f"ccnn-{scene.fold}.safetensors",
            max_error_px=tolerance,
        )  # fmt: skip
        for method in ("sgbm", "network") if kitti else SHOWN:
            yield make(group=group, method=method, network=sources.folder / f"fold-{scene.fold}.safetensors")
        for name in FAMILIES if scene.fold == _LEFT_OUT_FOLD else ():
            path = sources.folder / f"without-{name}.safetensors"
            if path.exists():
                for method in (m for m in METHODS if family(m) == name):
                    yield make(group=f"{group} without {name}", method=method, network=path)


def read_case(sources: Sources, case: Case) -> Views:
    if case.number is not None:
        return read_views(list_scenes(sources.data, sources.training_data)[case.number])
    pair = read_pairs(sources.data / "middlebury", [case.scene])[0]
    gray0, gray1 = (to_gray(image[None])[0, 0].numpy() for image in (pair.image0, pair.image1))
    return Views(gray0, gray1, pair.disparity_gt.numpy(), None)


@cache
def load_network(path: Path | None) -> ConfidenceNetwork:
    if path is None:
        return load_confidence()
    network = ConfidenceNetwork()
    network.load_state_dict(load_file(path))
    return network.eval()


@cache
def load_ccnn(path: Path) -> CCNN | None:
    """None if ``training/ccnn.py`` has not run."""
    if not path.exists():
        return None
    network = CCNN()
    network.load_state_dict(load_file(path))
    return network.eval()


@torch.no_grad()
def score_maps(
    views: Views, both: tuple[Floats, Floats], network: ConfidenceNetwork, ccnn: CCNN | None, max_error_px: float
) -> tuple[dict[str, Floats], dict[str, float]]:
    """(H, W) of every measure of a map, and the seconds that it took."""
    disparity, disparity1 = both
    searched = search_range(disparity)
    curves = cost_curves(views.image0, views.image1, *searched)
    k = TOLERANCES_PX.index(max_error_px)
    slope, bias = network.calibration[k]

    def ours(other: Floats | None) -> Floats:
        planes = torch.from_numpy(measure_map(disparity, views.image0, views.image1, other))
        return torch.sigmoid(network(planes[None])[0, k] * slope + bias).numpy()

    measures: dict[str, Callable[[], Floats]] = {
        "left-right": partial(classic.left_right, disparity, disparity1),
        "variance 21": partial(classic.variance, disparity, 21),
        "agreement 11": partial(classic.agreement, disparity, 11),
        "agreement 21": partial(classic.agreement, disparity, 21),
        "median deviation 11": partial(classic.median_deviation, disparity, 11),
        "matching score": partial(classic.matching_score, curves, 1, disparity),
        "peak ratio": partial(classic.peak_ratio, curves, 1, disparity),
        "agreement 21, left-right": lambda: (
            classic.agreement(disparity, 21) - np.tanh(-classic.left_right(disparity, disparity1) / 2)
        ),
        "ours": partial(ours, disparity1),
        "ours without view 1": partial(ours, None),
    }
    if ccnn is not None:
        measures["CCNN"] = partial(score_ccnn, ccnn, disparity)
    if pandora_ambiguity.is_there():
        measures["ambiguity (pandora)"] = partial(pandora_ambiguity.ambiguity, views.image0, views.image1, *searched)
    found, seconds = {}, {}
    for name, call in measures.items():
        start = time.perf_counter()
        found[name] = np.asarray(call(), np.float32)
        seconds[name] = time.perf_counter() - start
    return found, seconds


def score(sources: Sources, case: Case) -> tuple[dict[str, Tensor], Tensor, dict[str, float]]:
    """Every measure of one map and its errors where map and truth are known, and the seconds of each measure."""
    views = read_case(sources, case)
    truth = np.where(np.isfinite(views.disparity0), views.disparity0, np.nan)
    count = int(np.clip(np.ceil(1.25 * np.nanquantile(truth, 0.999) / 16) * 16, 32, 256))
    run = make_methods(load_matching(sources.folder, case.number or 0))[case.method]
    both = both_maps(run, views.image0, views.image1, count)
    network, ccnn = load_network(case.network), load_ccnn(case.ccnn)
    maps, seconds = score_maps(views, both, network, ccnn, case.max_error_px)
    error = np.abs(both[0] - truth)
    known = np.isfinite(error)
    found = {name: torch.from_numpy(values[known]) for name, values in maps.items()}
    return found, torch.from_numpy(error[known]), seconds


def measure(sources: Sources, case: Case) -> tuple[Case, _Figures, dict[str, list[float]]]:
    """Figures and sparsification curve of every measure."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    found, error, seconds = score(sources, case)
    wrong = error > case.max_error_px
    curves = {name: sparsification_curve(values, wrong).tolist() for name, values in found.items()}
    curves["optimum"] = sparsification_curve(-wrong.float(), wrong).tolist()
    figures = {name: {"area": float(np.mean(curve))} for name, curve in curves.items()}
    last = torch.tensor([int(np.ceil(share * len(wrong))) for share in COVERAGES])
    for name, values in found.items():
        right = 1 - cumulative_wrong(values, wrong)[last - 1] / last
        figures[name] |= {"auc": auc(values, ~wrong), "seconds": seconds[name]}
        figures[name] |= {f"precision at {c:g}": float(r) for c, r in zip(COVERAGES, right, strict=True)}
        if name in OURS:
            figures[name]["calibration error"] = calibration_error(values, ~wrong)
            kept = keep_expected(values, 0.95)
            figures[name]["precision of .95"] = float((~wrong[kept]).double().mean()) if len(kept) else float("nan")
            figures[name]["coverage of .95"] = len(kept) / len(values)
    return case, figures, curves


def main() -> None:
    suite = Suite("confidence", training_data="folder of the training scenes", folds="work folder of the training")
    sources = Sources(suite.options.data, suite.options.training_data, suite.options.folds / "dense")
    rows: dict[tuple[str, str], list[tuple[_Figures, dict[str, list[float]]]]] = defaultdict(list)
    with multiprocessing.get_context("spawn").Pool(PROCESSES) as pool:
        for case, figures, curves in pool.imap(partial(measure, sources), list(list_cases(sources))):
            rows[case.group, case.method].append((figures, curves))
            areas = {name: round(values["area"], 5) for name, values in figures.items()}
            suite.records.append({"scene": case.scene, "group": case.group, "method": case.method, "areas": areas})
    for (group, method), scenes in rows.items():
        mean = {
            name: {key: float(np.nanmean([scene[name][key] for scene, _ in scenes])) for key in scenes[0][0][name]}
            for name in scenes[0][0]
        }
        best = mean["optimum"]["area"]
        check = mean["left-right"]["area"] - best
        print(f"{group}, {method}, {len(scenes)} maps: optimum {best:.4f}")
        for name, figures in mean.items():
            share = (figures["area"] - best) / check
            curve = np.mean([curves[name] for _, curves in scenes], 0).round(5).tolist()
            suite.records.append(
                {"group": group, "method": method, "measure": name, "share": share, **figures, "curve": curve}
            )
            print(
                f"  {name:26} share {share:6.3f}  " + "  ".join(f"{k} {v:.4f}" for k, v in figures.items()), flush=True
            )
    suite.write()
    draw_curves(suite.records)
    show_rendered(sources.folder)


def show_rendered(folder: Path) -> None:
    """Draw the measures of a semi-global map of a rendered pair, which no training has seen."""
    scene = render_scene(5, SyntheticConfig(width_px=480, height_px=360, max_disparity_px=60, noise_levels=3))
    views = Views(scene.image0[0].numpy(), scene.image1[0].numpy(), scene.disparity0.numpy(), None)
    both = both_maps(make_methods(load_matching(folder, 0))["sgbm"], views.image0, views.image1, 80)
    maps, _ = score_maps(views, both, load_confidence(), load_ccnn(folder / "ccnn.safetensors"), 1.0)
    draw_maps(np.abs(both[0] - views.disparity0), maps, views.image0)


if __name__ == "__main__":
    main()
