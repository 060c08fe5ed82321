"""What a filter buys: dense maps, depth and epipolar geometry from the matches that it keeps.

    python benchmarks/accuracy/dense.py --folds WORK

Thresholds are chosen on the training scenes. The learned score of such a scene comes from the network that was trained
without it; ``training/train_learned.py`` leaves these networks in its folder WORK.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import torch

import tensor_stereo as ts
from tensor_stereo.datasets import find_pairs, read_calibration
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.scores import TOLERANCES_PX, LearnedScore, consensus_belief, load_learned, measure_images

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from accuracy.dense_figures import draw_bars, draw_maps
from accuracy.peers import score_disparity, score_lpm
from accuracy.putatives import GrayPair, Putatives, find_putatives, load_pairs, to_matches
from accuracy.uses import BAD_PX, FITS, epipolar_distances, is_known, map_errors
from shared.harness import Suite
from training.scenes import fold_of
from training.work_folder import load_fold_networks

DETECTORS = ("sift", "fast", "gftt")
MIN_GAP = 0.002  # of bad-2px, between the best peer and the oracle
MAX_STEP_PX = 4.0  # where triangles are cut; of 2, 4, 8 and 16 the best on the training scenes
NUM_THRESHOLDS = 13  # quantiles of each other score, of correct and of other matches of the training scenes
PROBABILITIES = np.arange(1, 20) / 20  # thresholds of the learned score, which mean the same for all kinds of matches
PEERS = ("LPM", "libviso2 support", "disparity median, Delaunay")
OURS = ("topology", "consensus", "learned")
SCORES = (*PEERS, *OURS)
SHOWN_SCENE, SHOWN = "teddy", ("none", "paper R1+R2", "disparity median, Delaunay", "learned", "oracle")
FILTERS = ("none", "paper R1+R2", *PEERS, *OURS, "learned, 0.5", "oracle")

Rows = np.ndarray  # (M,) bool
Scored = dict[str, np.ndarray]
Case = tuple[GrayPair, Putatives, Scored]
Tried = dict[str, tuple[np.ndarray, np.ndarray]]


def score_filters(pair: GrayPair, one: Putatives, network: LearnedScore) -> Scored:
    """Every score of one pair, and the verdicts without a threshold as scores of 0 and 1."""
    plain, given = to_matches([one]), to_matches([one], with_cost=True)
    graphs = build_match_graphs(given)
    views = ([torch.from_numpy(view)[None]] for view in (pair.left, pair.right))
    peers = score_disparity(one)
    ours = {
        "topology": ts.DelaunayFilter(verdict="cardinality", score="topology")(plain).score,
        "consensus": consensus_belief(given, graphs),
        "learned": network(given, graphs, measure_images(*views, given, graphs))[1][:, TOLERANCES_PX.index(1)],
        "paper R1+R2": ts.classify_matches(plain, min_group_size=1).inlier,
        "none": torch.ones(plain.num_matches),
        "oracle": torch.from_numpy(one.correct & one.valid),
    }
    ours["learned, 0.5"] = ours["learned"]  # a calibrated probability, taken at its word
    scores = {name: score.double().numpy() for name, score in ours.items()}
    return scores | {"LPM": score_lpm(one)} | {name: peers[name] for name in PEERS[1:]}


def errors_of(
    pair: GrayPair, one: Putatives, kept: Rows, max_step_px: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The dense map of the kept matches, and its errors."""
    return map_errors(pair, to_matches([one]), torch.from_numpy(kept), max_step_px)


def measure_maps(pair: GrayPair, one: Putatives, kept: Rows, max_step_px: float | None = None) -> dict[str, float]:
    error = errors_of(pair, one, kept, max_step_px)[1]
    return {"bad2": float((error > BAD_PX).mean()), "epe_px": float(error.mean()), "anchors": float(kept.sum())}


def measure_geometry(pair: GrayPair, one: Putatives, kept: Rows) -> dict[str, float]:
    return epipolar_distances(pair, to_matches([one]), torch.from_numpy(kept))


def try_thresholds(cases: list[Case]) -> Tried:
    """For each score some thresholds (T,), and the bad-2px (S, T) of each scene at each of them."""
    tried = {}
    right = np.concatenate([one.correct & one.valid for _, one, _ in cases])
    for name in SCORES:
        pooled = np.concatenate([scores[name] for *_, scores in cases])
        shares = np.linspace(0, 0.96, NUM_THRESHOLDS)
        quantiles = np.unique([np.quantile(part, shares) for part in (pooled[right], pooled[~right])])
        thresholds = PROBABILITIES if name == "learned" else quantiles
        bad = [[measure_maps(pair, one, s[name] >= t)["bad2"] for t in thresholds] for pair, one, s in cases]
        tried[name] = thresholds, np.array(bad)
    return tried


def choose_thresholds(tried: list[Tried], scenes: Rows) -> list[dict[str, float]]:
    """A threshold of each score: one for each kind of matches, of a probability one for all kinds."""
    mean = np.mean([of_kind["learned"][1][scenes] for of_kind in tried], 0)
    shared = {"learned": middle_threshold(PROBABILITIES, mean)}
    return [
        {name: middle_threshold(t, bad[scenes]) for name, (t, bad) in of_kind.items()} | shared for of_kind in tried
    ]


def middle_threshold(thresholds: np.ndarray, bad: np.ndarray) -> float:
    """Of the (T,) thresholds that are at most one standard error worse than the best on (S, T), the middle one.

    The rule of one standard error (Breiman et al. 1984, section 3.4.3): the least mean of a flat curve is an accident.
    """
    worse = bad - bad[:, [bad.mean(0).argmin()]]
    alike = thresholds[worse.mean(0) <= worse.std(0, ddof=1) / np.sqrt(len(bad))]
    return float(alike[len(alike) // 2])


def keep(scores: Scored, name: str, thresholds: dict[str, float]) -> Rows:
    return scores[name] >= thresholds.get(name, 0.5)


def report(suite: Suite, title: str, table: dict[str, dict[str, np.ndarray]], thresholds: dict[str, float]) -> None:
    """Print and keep the means over scenes, and what part of the gap to the oracle ours close."""
    print(title)
    for name, figures in table.items():
        middle = {key: float((np.median if key in FITS else np.mean)(values)) for key, values in figures.items()}
        scenes = {key: values.round(4).tolist() for key, values in figures.items()}
        suite.records.append({
            "putatives": title, "filter": name, "threshold": thresholds.get(name), **middle, "scenes": scenes,
        })  # fmt: skip
        print(f"  {name:28}" + "  ".join(f"{key} {value:8.3f}" for key, value in middle.items()), flush=True)
    bad = {name: figures["bad2"].mean() for name, figures in table.items()}
    peer = min(PEERS, key=bad.__getitem__)
    gap = bad[peer] - bad["oracle"]
    for name in (*OURS, "learned, 0.5"):
        gain = bad[peer] - bad[name]
        closed = gain / gap if gap > MIN_GAP else None  # of nothing there is no share
        suite.records.append({
            "putatives": title, "filter": name, "best_peer": peer, "gap": gap, "gain": gain, "gap_closed": closed,
        })  # fmt: skip
        share = "" if closed is None else f", {closed:+.2f} of it"
        print(f"  {name:28} gains {gain:+.4f} on {peer}, the oracle {gap:+.4f}{share}", flush=True)


def measure_depth(pair: GrayPair, one: Putatives, kept: Rows, doffs_px: float) -> dict[str, float]:
    """Error of the depth of the dense map, relative to the true depth."""
    known = is_known(pair.disparity_gt)
    found = errors_of(pair, one, kept)[0][known] + doffs_px
    error = np.abs((pair.disparity_gt[known] + doffs_px) / found.clip(1e-6) - 1)  # depth is a constant / these
    return {"median": float(np.median(error)), "above_10_percent": float((error > 0.1).mean())}


def find_offsets(root: Path) -> dict[str, float]:
    """Scene -> px between the principal points, for pairs with a calibration."""
    found = {files.scene: files.image0.parent / "calib.txt" for files in find_pairs(root)}
    return {scene: read_calibration(file).doffs_px for scene, file in found.items() if file.is_file()}


def find_cases(
    pairs: dict[str, list[GrayPair]], folds: list[LearnedScore], detector: str, gated: bool
) -> dict[str, list[Case]]:
    """The putative matches of one kind of all pairs, and their scores."""
    networks = {"training": [folds[fold_of(pair.scene)] for pair in pairs["training"]]}
    networks["eight"] = [load_learned()] * len(pairs["eight"])
    cases: dict[str, list[Case]] = {}
    for group, members in pairs.items():
        found = [find_putatives(pair, detector, gated=gated) for pair in members]
        scores = [score_filters(*case) for case in zip(members, found, networks[group], strict=True)]
        cases[group] = list(zip(members, found, scores, strict=True))
    return cases


def measure_filters(cases: list[Case], best: dict[str, float]) -> dict[str, dict[str, np.ndarray]]:
    """Filter -> figure -> (S,)."""
    table = {}
    for name in FILTERS:
        rows = []
        for pair, one, scores in cases:
            kept = keep(scores, name, best)
            cut = measure_maps(pair, one, kept, MAX_STEP_PX)
            whole = measure_maps(pair, one, kept) | {"bad2_cut": cut["bad2"], "epe_cut_px": cut["epe_px"]}
            rows.append(whole | measure_geometry(pair, one, kept))
        table[name] = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    return table


def show_maps(case: Case, best: dict[str, float]) -> None:
    pair, one, scores = case
    shown = {}
    for name in SHOWN:
        kept = keep(scores, name, best)
        values, error = errors_of(pair, one, kept)
        shown[name] = values, one.points0[kept], float((error > BAD_PX).mean())
    draw_maps(pair.scene, np.where(is_known(pair.disparity_gt), pair.disparity_gt, np.nan), shown)


@torch.no_grad()
def main() -> None:
    suite = Suite("dense", folds="folder WORK of training/train_learned.py")
    cv2.setNumThreads(1)
    groups = load_pairs(suite.options.data)
    pairs = {group: groups[group] for group in ("training", "eight")}
    offsets, folds = find_offsets(suite.options.data), load_fold_networks(suite.options.folds)
    kinds = {
        f"{detector}{', gated' if gated else ''}": find_cases(pairs, folds, detector, gated)
        for detector in DETECTORS
        for gated in (False, True)
    }
    tried = [try_thresholds(cases["training"]) for cases in kinds.values()]
    # The scenes with a calibration measure depth; there they choose no threshold.
    measured = np.array([pair.scene in offsets for pair in pairs["training"]])
    best, best_of_others = (choose_thresholds(tried, scenes) for scenes in (measured | True, ~measured))
    tables = {}
    for title, thresholds, others in zip(kinds, best, best_of_others, strict=True):
        cases = kinds[title]
        tables[title] = measure_filters(cases["eight"], thresholds)
        report(suite, title, tables[title], thresholds)
        if title == "fast":
            show_maps(next(case for case in cases["eight"] if case[0].scene == SHOWN_SCENE), thresholds)
        for pair, one, scores in (case for case in cases["training"] if case[0].scene in offsets):
            for name in FILTERS:
                error = measure_depth(pair, one, keep(scores, name, others), offsets[pair.scene])
                suite.note(f"depth, {title}, {pair.scene}, {name}", **error)
    draw_bars(tables)
    suite.write()


if __name__ == "__main__":
    main()
