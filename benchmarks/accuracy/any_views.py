"""Any two views and any matcher: homographies, turned coordinates, ALIKED with LightGlue, and what ``auto`` takes.

    python benchmarks/accuracy/any_views.py --training-data TRAINING_DATA --matches WORK/aliked

The eight scenes of the paper are scored by the shipped weights, which never saw them. WORK keeps the matches of ALIKED
and LightGlue, which take some seconds a pair.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from tensor_stereo.configs import FilterConfig
from tensor_stereo.evaluation.metrics import PAPER_SENSITIVITY, roc_update
from tensor_stereo.scores import score_matches
from tensor_stereo.scores.calibration import keep_by_target
from tensor_stereo.scores.tolerance import TOLERANCES_PX

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from accuracy.homographies import load_homography_pairs
from accuracy.peers import score_adalam, score_disparity, score_gms, score_lpm, score_magsac, score_residuals
from accuracy.putatives import (
    Float,
    GrayPair,
    Putatives,
    find_learned_putatives,
    find_putatives,
    load_pairs,
    to_images,
    to_matches,
)
from shared.calibration_error import calibration_error
from shared.harness import Suite
from training.putatives import Putatives as TrainingPutatives
from training.two_views import find_two_views
from training.view_scenes import list_view_scenes

SHARES = (0.3, 0.6, 0.8)  # of wrong matches
TURNS = ((15.0, 1.0), (90.0, 0.5), (160.0, 2.0), (-60.0, 1.4))  # degrees and scale of the coordinates of view 1
MIN_PRECISION = 0.95
DETECTORS = ("sift", "fast", "gftt")
PEERS: dict[str, Callable[[Putatives], Float]] = {
    "LPM": score_lpm,
    "GMS": score_gms,
    "AdaLAM": score_adalam,
    "libviso2 support": lambda given: score_disparity(given)["libviso2 support"],
    "MAGSAC++ F": score_magsac,
    "MAGSAC++ F, residuals": lambda given: score_residuals(given, "fundamental"),
    "MAGSAC++ H, residuals": lambda given: score_residuals(given, "homography"),
}
OURS = ("consensus", "learned, no images", "learned")


def score_ours(given: Putatives, *, with_cost: bool) -> dict[str, torch.Tensor]:
    """The probabilities (M, 5) of our scores under ``auto``."""
    matches = to_matches([given], with_cost=with_cost)
    consensus = score_matches(matches, FilterConfig(score="consensus", rectified="auto"))
    shared = {"graphs": consensus.graphs, "alignment": consensus.alignment}
    config = FilterConfig(rectified="auto")
    bare, whole = (
        score_matches(matches, config, images=images, **shared) for images in (None, tuple(to_images([given])))
    )
    return dict(zip(OURS, (consensus.cumulative, bare.cumulative, whole.cumulative), strict=True))


def report(
    suite: Suite, title: str, given: list[Putatives], own: dict[str, Callable] | None = None, **ours: bool
) -> None:
    """Means over the pairs of AUC and specificity of all scores, and the calibration error of ours."""
    scores: dict[str, list[torch.Tensor]] = {}
    for one in given:
        for name, peer in ((own or {}) | PEERS).items():
            scores.setdefault(name, []).append(torch.from_numpy(peer(one))[:, None].expand(-1, len(TOLERANCES_PX)))
        for name, cumulative in score_ours(one, **ours).items():
            scores.setdefault(name, []).append(cumulative)
    error = [torch.from_numpy(one.error_px) for one in given]
    for k, tolerance in enumerate(TOLERANCES_PX):
        for name, found in scores.items():
            counts = [
                roc_update(score[:, k], e <= tolerance, valid=~e.isnan()) for score, e in zip(found, error, strict=True)
            ]
            values = {
                "auc": np.nanmean([c.auc() for c in counts]),
                "specificity_at_96": np.nanmean([c.specificity_at(PAPER_SENSITIVITY) for c in counts]),
            }
            if name in OURS:
                whole, e = torch.cat(found)[:, k], torch.cat(error)
                values["calibration_error"] = calibration_error(whole[~e.isnan()], e[~e.isnan()] <= tolerance)
            suite.note(f"{title}, {name}, {tolerance:g} px", **values)


def turn(given: Putatives, degrees: float, scale: float) -> Putatives:
    """The same matches in other coordinates of view 1."""
    c, s = (scale * f(np.radians(degrees)) for f in (np.cos, np.sin))
    return replace(given, points1=given.points1 @ np.array([[c, s], [-s, c]]) + [300.0, 100.0])


def report_turned(suite: Suite, pairs: list[GrayPair]) -> None:
    """What turning and scaling changes, without images, against the same pairs as they are."""
    one = TOLERANCES_PX.index(1)
    for detector in DETECTORS:
        for gated in (False, True):
            kind = f"{detector}{' g' if gated else ''}"
            found = [find_putatives(pair, detector, gated=gated) for pair in pairs]
            for name in ("consensus", "learned"):
                config = FilterConfig(score=name, rectified="auto")
                before = np.array([_merits(one_, one_, config, one) for one_ in found])
                for degrees, scale in TURNS:
                    after = np.array([_merits(turn(x, degrees, scale), x, config, one) for x in found])
                    change = (after - before).mean(0)
                    title = f"eight turned by {degrees:g} degrees, times {scale:g}, {kind}, {name}"
                    suite.note(
                        title, auc=after.mean(0)[0], auc_change=change[0], kept=after.mean(0)[1], kept_change=change[1]
                    )


def _merits(given: Putatives, truth: Putatives, config: FilterConfig, k: int) -> tuple[float, float]:
    """AUC, and the share of the correct matches that ``min_precision`` keeps."""
    matches = to_matches([given], with_cost=True)
    score = score_matches(matches, config).cumulative[:, k]
    correct, valid = torch.from_numpy(truth.correct), torch.from_numpy(truth.valid)
    kept = keep_by_target(score, score > 0, matches.ptr, min_precision=MIN_PRECISION)
    return roc_update(score, correct, valid=valid).auc(), float((kept & correct).sum() / correct.sum())


def report_auto(suite: Suite, groups: dict[str, list[GrayPair]]) -> None:
    """How many pairs ``auto`` takes for rectified, of those that are and of those that are not."""
    for group, pairs in groups.items():
        for detector in DETECTORS:
            for gated in (False, True):
                found = [find_putatives(pair, detector, gated=gated) for pair in pairs]
                taken = [_is_taken_for_rectified(to_matches([one])) for one in found]
                title = f"auto, {group}, {detector}{' g' if gated else ''}"
                suite.note(title, pairs=len(found), taken_for_rectified=sum(taken))


def report_real_views(suite: Suite) -> None:
    """The two real pairs that are not rectified, which training never saw, and alterations of them."""
    for number, scene in enumerate(list_view_scenes(suite.options.training_data)):
        found = find_two_views(scene, number)
        taken = [_is_taken_for_rectified(one.matches) for one in found]
        suite.note(f"auto, {scene.name}", pairs=len(found), taken_for_rectified=sum(taken))
        for k, tolerance in enumerate(TOLERANCES_PX):
            merits = _merits_of_views(found, k) if tolerance >= found[0].least_error_px else {}
            for name, values in merits.items():
                suite.note(f"{scene.name}, {name}, {tolerance:g} px", auc=np.mean(values), pairs=len(values))


def _merits_of_views(found: list[TrainingPutatives], k: int) -> dict[str, list[float]]:
    """AUC of every pair that has correct and incorrect matches at tolerance k, by score."""
    merits: dict[str, list[float]] = {}
    for one in found:
        known, correct = ~one.error_px.isnan(), one.error_px <= TOLERANCES_PX[k]
        if not 0 < int(correct.sum()) < int(known.sum()):
            continue
        for name in ("consensus", "learned"):
            images = None if name == "consensus" else tuple([image] for image in one.images)
            score = score_matches(one.matches, FilterConfig(score=name, rectified="auto"), images=images)
            merits.setdefault(name, []).append(roc_update(score.cumulative[:, k], correct, valid=known).auc())
    return merits


def _is_taken_for_rectified(matches) -> bool:
    found = score_matches(matches, FilterConfig(score="consensus", rectified="auto"))
    return bool(found.alignment.rectified)


@torch.no_grad()
def main() -> None:
    suite = Suite(
        "any_views", **{"training-data": "folder of further pairs", "matches": "folder for the matches of ALIKED"}
    )
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    groups = load_pairs(suite.options.data)
    for share in SHARES:
        report(
            suite, f"homographies, {share:.0%} wrong", load_homography_pairs(groups["eight"], share), with_cost=False
        )
    learned = [find_learned_putatives(pair, folder=suite.options.matches) for pair in groups["eight"]]
    own = {"LightGlue's confidence": lambda given: 1 - given.cost}
    report(suite, "eight, ALIKED + LightGlue", learned, own, with_cost=True)
    report(suite, "eight, ALIKED + LightGlue, costs unknown", learned, own, with_cost=False)
    report_turned(suite, groups["eight"])
    more = load_pairs(suite.options.training_data)
    report_auto(suite, {name: pairs + (more[name] if name != "synthetic" else []) for name, pairs in groups.items()})
    report_real_views(suite)
    suite.write()


if __name__ == "__main__":
    main()
