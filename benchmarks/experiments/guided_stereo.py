"""Guided stereo: which matches should a network be given as hints?

    python benchmarks/experiments/guided_stereo.py --folds WORK/rectified --training-data TRAINING_DATA --work WORK

``train_guided.py`` must have run. The paper's eight scenes, which neither the networks nor the learned score have seen,
and the KITTI frames of the validation, with the learned score that was trained without them. Five networks judge every
condition; what is compared are their means over the scenes, and the spread is that over the networks. In the benchmark
environment, which has GMS.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from tensor_stereo.scores import load_learned

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from accuracy.putatives import GrayPair, load_pairs
from experiments.anchors import CONDITIONS, Anchors, find_anchors
from experiments.train_guided import SEEDS, VALIDATION_FOLD, load_guided
from shared.harness import Suite
from training.scenes import list_scenes, read_views
from training.work_folder import load_fold_networks

BAD_PX = {"eight": 2.0, "kitti": 3.0}
TOLERANCE_PX = {"eight": 1.0, "kitti": 3.0}  # of a correct hint
NO_HINTS = "no guidance"
WRONG_SHARES = (0.0, 0.05, 0.1, 0.2, 0.4)  # of the hints, in the curve


class Case(NamedTuple):
    """One pair, what each condition gives as hints, and the name of its group."""

    group: str
    pair: GrayPair
    hints: dict[str, Anchors]


def find_cases(data: Path, more: Path, folds: Path, *, gated: bool) -> Iterator[Case]:
    """The eight scenes and the validation frames of KITTI.

    In KITTI only corners whose truth is known take part, an eighth of them, or the oracle would have the fewest.
    """
    shipped, network = load_learned(), load_fold_networks(folds)[VALIDATION_FOLD]
    for pair in load_pairs(data)["eight"]:
        yield Case("eight", pair, vary(find_anchors(pair, shipped, gated=gated), TOLERANCE_PX["eight"]))
    for scene in list_scenes(data, more):
        if scene.domain == "kitti" and scene.fold == VALIDATION_FOLD:
            views = read_views(scene)
            pair = GrayPair(scene.name, views.image0, views.image1, views.disparity0.astype(float))
            found = find_anchors(pair, network, gated=gated, tolerance_px=TOLERANCE_PX["kitti"])
            known = {name: anchors.some(np.isfinite(anchors.error_px)) for name, anchors in found.items()}
            yield Case("kitti", pair, vary(known, TOLERANCE_PX["kitti"]))


def vary(found: dict[str, Anchors], tolerance_px: float) -> dict[str, Anchors]:
    """The conditions as they are; all thinned to the number of the smallest; and correct hints with some wrong ones."""
    rng = np.random.default_rng(0)
    least = min(len(anchors.pixels) for anchors in found.values())
    equal = {
        f"{name}, equal": anchors.some(np.sort(rng.permutation(len(anchors.pixels))[:least]))
        for name, anchors in found.items()
    }
    every = found["all putatives"]
    right, wrong = (np.flatnonzero(every.wrong(tolerance_px) == is_wrong) for is_wrong in (False, True))
    curve = {}
    for share in WRONG_SHARES:
        num = min(len(right), int(len(wrong) * (1 - share) / max(share, 1e-9))) if share else len(right)
        num_wrong = round(num * share / (1 - share))
        rows = np.concatenate([rng.permutation(right)[:num], rng.permutation(wrong)[:num_wrong]])
        curve[f"{share:.0%} wrong"] = every.some(rows)
    nothing = every.some(np.zeros(0, np.int64))
    return {NO_HINTS: nothing} | found | equal | curve


def judge(work: Path, cases: list[Case], seed: int) -> list[dict[str, tuple[float, float]]]:
    """Share of bad pixels and mean error of every condition, for each case."""
    torch.set_num_threads(1)
    net = load_guided(work, seed)
    found = []
    for group, pair, hints in cases:
        truth = torch.from_numpy(pair.disparity_gt).float()
        known = truth.isfinite() & (truth > 0)
        views = (torch.from_numpy(pair.left)[None], torch.from_numpy(pair.right)[None])
        figures = {}
        maps = net.predict(*views, (anchors.hints(truth.shape) for anchors in hints.values()))
        for name, disparity in zip(hints, maps, strict=True):
            error = (disparity - truth).abs()[known]
            figures[name] = float((error > BAD_PX[group]).float().mean()), float(error.mean())
        found.append(figures)
    return found


def note_gap(suite: Suite, title: str, bad: dict[str, NDArray[np.float64]], every: str, names: Sequence[str]) -> None:
    """What part of the gap between left-right check and oracle some conditions close, and whether that can be told.

    The power is the mean over the networks of the difference between ``every``, without a filter, and the oracle, over
    its spread.
    """
    check, oracle = (bad[key].mean() for key in ("left-right check", "oracle"))
    gap = bad[every] - bad["oracle"]
    closed = {name: float((check - bad[name].mean()) / (check - oracle)) for name in names}
    suite.note(f"{title}: gap closed", power=float(gap.mean() / gap.std(ddof=1)), **closed)


def report(suite: Suite, putatives: str, group: str, cases: list[Case], judged: list[list[dict]]) -> None:
    """Means and spreads over the networks."""
    rows = [k for k, case in enumerate(cases) if case.group == group]
    bad, epe = (
        {n: np.array([np.mean([of[k][n][which] for k in rows]) for of in judged]) for n in judged[0][0]}
        for which in (0, 1)
    )
    print(f"\n{group}, {putatives}: bad-{BAD_PX[group]:g}px and mean error, over {len(judged)} networks")
    for name, values in bad.items():
        hints = [cases[k].hints[name] for k in rows]
        record = {
            "putatives": putatives, "group": group, "condition": name,
            "hints": float(np.mean([len(h.pixels) for h in hints])),
            "correct": float(np.mean([1 - h.wrong(TOLERANCE_PX[group]).mean() for h in hints if len(h.pixels)] or [1])),
            "bad": float(values.mean()), "bad_spread": float(values.std(ddof=1)),
            "epe_px": float(epe[name].mean()), "epe_spread_px": float(epe[name].std(ddof=1)),
            "networks_bad": values.round(4).tolist(),
        }  # fmt: skip
        suite.records.append(record)
        text = "  ".join(f"{key} {record[key]:.4f}" for key in ("bad", "bad_spread", "epe_px", "correct"))
        print(f"  {name:40} {record['hints']:7.0f}  {text}", flush=True)
    for ending in ("", ", equal"):
        of = {name: bad[name + ending] for name in CONDITIONS if name in bad}
        ours = ("learned", "learned + repair", "consensus")
        note_gap(suite, f"{group}, {putatives}{ending}", of, "all putatives", ours)


def main() -> None:
    folders = {
        "folds": "folder WORK/rectified of training/train_learned.py",
        "training-data": "folder of the training data",
        "work": "folder of train_guided.py",
    }
    suite = Suite("guided_stereo", **folders)
    options = suite.options
    found: dict[str, list[Case]] = defaultdict(list)
    for gated in (False, True):
        found["FAST, gated" if gated else "FAST"] = list(
            find_cases(options.data, options.training_data, options.folds, gated=gated)
        )
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        for putatives, cases in found.items():
            judged = pool.map(partial(judge, options.work, cases), SEEDS, chunksize=1)
            for group in BAD_PX:
                report(suite, putatives, group, cases, judged)
    suite.write()


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
