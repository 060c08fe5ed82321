"""More correct matches out than went in: what repair and refinement add, beside what others do with the same images.

    python benchmarks/accuracy/repair.py --training-data TRAINING_DATA --folds WORK/rectified

The eight scenes of the paper are judged by the shipped weights, which never saw them; training scenes of Middlebury by
the network of the cross-validation that was trained without them. All methods see the same keypoints of view 0.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from tensor_stereo.configs import FilterConfig, PipelineConfig, SGBMConfig
from tensor_stereo.datasets import find_pairs, read_disparity_png, render_pair
from tensor_stereo.dense.partners import sample_disparity
from tensor_stereo.dense.semi_global import match_semi_global
from tensor_stereo.evaluation import errors_against_gt
from tensor_stereo.features import detect_features, to_gray
from tensor_stereo.pipeline import Stopwatch, find_matches
from tensor_stereo.scores import LearnedScore, Origin, load_learned, refine_matches, repair_matches, score_matches
from tensor_stereo.scores.calibration import keep_by_target
from tensor_stereo.types import Matches

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from accuracy.putatives import GrayPair, load_pairs
from accuracy.sparse_peers import Result, guide_matches, refine_by_correlation, score_neighbors
from accuracy.uses import BAD_PX, FITS, epipolar_distances, map_errors
from shared.calibration_error import calibration_error
from shared.harness import Suite
from training.putatives import FIXED
from training.scenes import fold_of
from training.work_folder import load_fold_networks

DETECTORS = ("fast", "gftt", "sift")
NUM_RENDERED = 40
PRECISIONS = (0.90, 0.95, 0.98)
TOLERANCE_PX, LIKELY = 1.0, 0.5
AIM = 0.95  # min_precision
TWINS = {"disp2.png": "disp6.png", "disp1.png": "disp5.png"}


def run_methods(pair: GrayPair, detector: str, network: LearnedScore) -> tuple[dict[str, Result], torch.Tensor]:
    """Every method's matches and scores, and the keypoints of view 0."""
    config = PipelineConfig(detector=detector, sift=FIXED.sift, gftt=FIXED.gftt)
    gray = [tuple(torch.from_numpy(view)[None, None] for view in (pair.left, pair.right))]
    views = [gray[0][0][0]], [gray[0][1][0]]
    features, ssd = find_matches(gray, config, Stopwatch())
    keypoints = features.keypoints
    maps = match_semi_global(*views, SGBMConfig())
    sgbm = sample_disparity(maps.disparity0, keypoints.double(), features.ptr, disparity1=maps.disparity1)
    found = {
        "SSD, LPM": score_neighbors(ssd, "LPM"),
        "SSD, libviso2": score_neighbors(ssd, "libviso2"),
        "SSD, oracle": Result(ssd, (errors_of(pair, ssd) <= TOLERANCE_PX).double()),
    }
    found["SSD, guided by epipolar lines"] = guide_matches(ssd, gray[0], config)
    found["SGBM, left-right check"] = Result(sgbm, -sgbm.cost, keep_at=-TOLERANCE_PX)
    found["SGBM, oracle"] = Result(sgbm, (errors_of(pair, sgbm) <= TOLERANCE_PX).double())
    for name, matches in (("SSD", ssd), ("SGBM", sgbm)):
        consensus = score_matches(matches, FilterConfig(score="consensus"))
        found[f"{name}, consensus"] = Result(matches, consensus.score, is_probability=True)
        given = score_matches(matches, FilterConfig(), consensus.graphs, images=views, network=network)
        found[f"{name}, learned"] = Result(matches, given.score, is_probability=True)
        kept = given.score >= LIKELY
        if name == "SSD":
            finer = refine_by_correlation(ssd, gray[0], kept)
            found["SSD, learned, correlation of patches"] = Result(finer, given.score, is_probability=True)
        finer = refine_matches(matches, *views, kept, given.alignment, given.graphs)
        found[f"{name}, learned, refined"] = Result(finer, given.score, is_probability=True)
        more = repair_matches(matches, *views, kept, given.alignment, keypoints0=keypoints, ptr0=features.ptr)
        anew = score_matches(more.matches, FilterConfig(), images=views, network=network)
        score = torch.where(anew.graphs.group_size > 0, anew.score, 0)
        repaired = more.origin == Origin.REPAIRED
        found[f"{name}, learned, repaired"] = Result(more.matches, score, repaired, is_probability=True)
        finer = refine_matches(more.matches, *views, score >= LIKELY, anew.alignment, anew.graphs)
        found[f"{name}, learned, repaired and refined"] = Result(finer, score, repaired, is_probability=True)
    return found, keypoints


def count_correct(score: torch.Tensor, correct: torch.Tensor, precision: float) -> int:
    """Correct matches in the largest prefix by score that reaches a precision."""
    hits = correct[score.argsort(descending=True, stable=True)].double().cumsum(0)
    share = hits / torch.arange(1, len(hits) + 1)
    reached = (share >= precision).nonzero()[:, 0]
    return int(hits[reached[-1]]) if len(reached) else 0


def visible_of(pair: GrayPair, keypoints: torch.Tensor, second: np.ndarray | None) -> tuple[torch.Tensor, torch.Tensor]:
    """(N,) bool, keypoints whose truth is known and which view 1 sees, and which it does not see."""
    x, y = keypoints.round().long().unbind(1)
    height, width = pair.disparity_gt.shape
    x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
    truth = torch.from_numpy(pair.disparity_gt)[y, x]
    known = truth.isfinite()
    if second is None:
        return known, torch.zeros_like(known)
    there = (x - truth.nan_to_num(0)).round().long()
    back = torch.from_numpy(second.astype(np.float64))[y, there.clamp(0, width - 1)]
    seen = (there >= 0) & ((back - truth).abs() <= 1)
    hidden = (there < 0) | (back - truth > 2)
    return known & seen, known & hidden


def errors_of(pair: GrayPair, matches: Matches) -> torch.Tensor:
    return errors_against_gt(matches, torch.from_numpy(pair.disparity_gt)[None])


def measure(result: Result, pair: GrayPair, keypoints: torch.Tensor, second: np.ndarray | None) -> dict[str, float]:
    error = errors_of(pair, result.matches)
    known, correct = ~error.isnan(), error <= TOLERANCE_PX
    visible, _ = visible_of(pair, keypoints.double(), second)
    values = {
        f"correct_at_{round(100 * p)}": float(count_correct(result.score[known], correct[known], p)) for p in PRECISIONS
    }
    values["recall_at_95"] = values["correct_at_95"] / max(int(visible.sum()), 1)
    kept = known & result.kept
    near = kept & (error <= 2)
    values |= {"kept_error_px": float(error[kept].mean()), "near_error_px": float(error[near].mean())}
    values["kept_precision"] = float(correct[kept].double().mean())
    if result.is_probability:
        sure = keep_by_target(result.score, result.score > 0, result.matches.ptr, min_precision=AIM)
        values["precision_at_aim"] = float(correct[known & sure].double().mean())
    values["bad2"] = float((map_errors(pair, result.matches, result.kept)[1] > BAD_PX).mean())
    values |= epipolar_distances(pair, result.matches, result.kept)
    _, is_hidden = visible_of(pair, result.matches.keypoints0.double(), second)
    if second is not None and bool(is_hidden.any()):
        values["hidden_kept"] = float((is_hidden & result.kept).sum() / is_hidden.sum())
    return values


def report(
    suite: Suite, group: str, detector: str, pairs: Sequence[GrayPair], networks: Sequence[LearnedScore], twins: dict
) -> None:
    """Means over the pairs for every method, and the calibration error of repaired matches alone."""
    figures: dict[str, list[dict[str, float]]] = {}
    pooled: dict[str, list[tuple[torch.Tensor, torch.Tensor]]] = {}
    for pair, network in zip(pairs, networks, strict=True):
        found, keypoints = run_methods(pair, detector, network)
        for name, result in found.items():
            figures.setdefault(name, []).append(measure(result, pair, keypoints, twins.get(pair.scene)))
            if result.repaired is not None:
                error = errors_of(pair, result.matches)
                rows = result.repaired & ~error.isnan() & (result.score > 0)
                pooled.setdefault(name, []).append((result.score[rows], error[rows] <= TOLERANCE_PX))
    for name, values in figures.items():
        middle = {key: np.median if key in FITS else np.nanmean for key in dict.fromkeys(k for v in values for k in v)}
        means = {key: float(take([v[key] for v in values if key in v])) for key, take in middle.items()}
        if name in pooled:
            means["calibration_error_of_repaired"] = calibration_error(
                *(torch.cat(x) for x in zip(*pooled[name], strict=True))
            )
        suite.note(f"{group}, {detector}, {name}", **means)


def report_locking(suite: Suite, detector: str) -> None:
    """Bias of refined matches by the fraction of their disparity, on rendered scenes, whose truth is exact.

    Right matches are rounded to whole px of disparity and refined; those that end within half a px count.
    """
    found = []
    for seed in range(NUM_RENDERED):
        pair = render_pair((2016, seed))
        points = (
            detect_features(to_gray(pair.image0[None]), PipelineConfig(detector=detector)).keypoints.double().round()
        )
        x, y = points.long().unbind(1)
        disparity = pair.disparity_gt[y, x].double()
        seen = ~pair.occluded[y, x] & (points[:, 0] - disparity > 8)
        points, disparity = points[seen], disparity[seen]
        right = points - torch.stack([disparity.round(), torch.zeros_like(disparity)], 1)
        matches = Matches(points, right, torch.tensor([0, len(points)]))
        kept = torch.ones(len(points), dtype=torch.bool)
        moved = refine_matches(matches, [pair.image0], [pair.image1], kept)
        found.append(torch.stack([disparity - disparity.floor(), points[:, 0] - disparity - moved.keypoints1[:, 0]]))
    fraction, error = torch.cat(found, 1)
    near = error.abs() < 0.5
    tenth = (10 * fraction).long().clamp(0, 9)
    bias = {f"bias_at_0.{k}5": float(error[near & (tenth == k)].mean()) for k in range(10)}
    suite.note(f"pixel locking, {detector}", median_error_px=float(error.abs().median()), **bias)


@torch.no_grad()
def main() -> None:
    suite = Suite(
        "repair", **{"training-data": "folder of further pairs", "folds": "folder WORK/rectified of train_learned.py"}
    )
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    folds, shipped = load_fold_networks(suite.options.folds), load_learned()
    groups = load_pairs(suite.options.data)
    twins = {}
    for files in find_pairs(suite.options.data):
        twin = None if files.disparity_gt is None else TWINS.get(files.disparity_gt.name)
        if twin is not None and files.disparity_gt.with_name(twin).exists():
            twins[files.scene] = read_disparity_png(files.disparity_gt.with_name(twin), files.gt_scale)
    for group, title in (("eight", "eight"), ("training", "Middlebury")):
        pairs = groups[group]
        networks = [shipped if group == "eight" else folds[fold_of(pair.scene)] for pair in pairs]
        for detector in DETECTORS:
            report(suite, title, detector, pairs, networks, twins)
    for detector in DETECTORS[:2]:
        report_locking(suite, detector)
    suite.write()


if __name__ == "__main__":
    main()
