"""Repair the putatives of the training scenes, so that the learned score also learns from what repair leaves.

    python benchmarks/training/repaired_matches.py DATA TRAINING_DATA WORK

WORK/rectified holds the networks of a cross-validation by ``train_learned.py``. WORK/repaired receives one file of
putatives for each scene, its matches after repair; which were to be repaired says the network that was trained without
the scene. Scenes that have a file are left out. The next training of ``train_learned.py`` sees them too.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from tensor_stereo.atomic import whole_file
from tensor_stereo.batching import select_matches
from tensor_stereo.configs import FilterConfig
from tensor_stereo.features import detect_features
from tensor_stereo.scores import LearnedScore, Origin, repair_matches, score_matches
from training.putatives import FIXED, MAX_MATCHES, Found, Putatives, find_matches, judge_matches
from training.scenes import NUM_FOLDS, Scene, list_scenes
from training.work_folder import load_fold_networks, putatives_path

KIND = "repaired"
NUM_ALTERED = {"middlebury": 8, "eth3d": 8, "kitti": 3, "rendered": 8, "synthetic": 2}
_LIKELY = 0.5


def repair_scene(work: Path, scene: Scene, number: int) -> None:
    """Write the repaired matches of a scene, which is the ``number``-th, unless they are there."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    path = putatives_path(work / KIND, scene.name)
    if path.exists():
        return
    networks = load_fold_networks(work / "rectified")
    network = networks[number % NUM_FOLDS if scene.fold is None else scene.fold]
    rng = np.random.default_rng([9, number])
    found = [repair(scene, one, network, rng) for one in find_matches(scene, number, NUM_ALTERED[scene.domain])]
    with whole_file(path) as part:
        torch.save(found, part)


@torch.no_grad()
def repair(scene: Scene, given: Found, network: LearnedScore, rng: np.random.Generator) -> Putatives:
    """The same pair with other partners, and with keypoints that had none."""
    images = [torch.from_numpy(view.copy())[None] for view in given.views[:2]]
    views = [images[0]], [images[1]]
    score = score_matches(given.matches, FilterConfig(), images=views, network=network)
    detector = given.kind.split()[0] if given.fixed else str(rng.choice(["sift", "fast", "gftt"]))
    keypoints = detect_features(images[0][None], replace(FIXED, detector=detector)).keypoints.double()
    kept = score.score >= _LIKELY
    more = repair_matches(given.matches, *views, kept, score.alignment, keypoints0=keypoints)
    count = more.matches.num_matches
    chosen = torch.zeros(count, dtype=torch.bool)
    chosen[torch.from_numpy(rng.permutation(count)[:MAX_MATCHES])] = True
    matches = select_matches(more.matches, chosen)
    judged = judge_matches(scene, f"{given.kind} repaired", given.fixed, given.views, matches)
    return replace(judged, repaired=more.origin[chosen] == Origin.REPAIRED)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("data", "training_data", "work"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    (options.work / KIND).mkdir(parents=True, exist_ok=True)
    scenes = list_scenes(options.data, options.training_data)
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        pool.starmap(partial(repair_scene, options.work), zip(scenes, range(len(scenes)), strict=True), chunksize=1)


if __name__ == "__main__":
    main()
