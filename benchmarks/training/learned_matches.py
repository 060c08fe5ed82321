"""Record the matches of ALIKED and LightGlue on the training scenes.

    python benchmarks/training/learned_matches.py DATA TRAINING_DATA WORK

DATA and TRAINING_DATA hold the scenes of ``scenes.py``; the eight of the paper are never read. WORK/aliked receives one
file of putatives for each scene, in the form of ``train_learned.py``; scenes that have one are left out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.learned_matchers import match_learned
from tensor_stereo.atomic import whole_file
from tensor_stereo.types import Matches
from training.alterations import alter
from training.putatives import MIN_MATCHES, Putatives, judge_matches
from training.scenes import Scene, Views, list_scenes, read_views
from training.work_folder import putatives_path

KIND = "aliked"
NUM_SYNTHETIC = 20  # of the synthetic scenes, the first ones
REAL = ("middlebury", "eth3d", "kitti")


def find_learned_matches(scene: Scene, number: int) -> list[Putatives]:
    """The matches of one scene, which is the ``number``-th; a real scene is matched as it is and once altered."""
    return [
        judge_matches(scene, KIND, False, views, matches)
        for views in _list_views(scene, number)
        if (matches := _match(views)).num_matches >= MIN_MATCHES
    ]


def _list_views(scene: Scene, number: int) -> Iterator[Views]:
    views = read_views(scene)
    yield views
    if scene.domain in REAL:
        rng, altered = np.random.default_rng([6, number]), views
        while np.array_equal(altered.image1, views.image1):  # sometimes nothing is altered
            altered = alter(views, rng)
        if np.isfinite(altered.disparity0).any():
            yield altered


def _match(views: Views) -> Matches:
    points0, points1, confidence = map(torch.from_numpy, match_learned(views.image0, views.image1))
    return Matches(points0, points1, torch.tensor([0, len(points0)]), cost=1 - confidence)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("data", "training_data", "work"):
        parser.add_argument(name, type=Path)
    options = parser.parse_args()
    folder = options.work / KIND
    folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    num_synthetic = 0
    for number, scene in enumerate(list_scenes(options.data, options.training_data)):
        num_synthetic += scene.domain == "synthetic"
        path = putatives_path(folder, scene.name)
        if num_synthetic > NUM_SYNTHETIC or path.exists():
            continue
        found = find_learned_matches(scene, number)
        with whole_file(path) as part:
            torch.save(found, part)
        print(f"{scene.name}: {', '.join(str(one.matches.num_matches) for one in found)} matches", flush=True)


if __name__ == "__main__":
    main()
