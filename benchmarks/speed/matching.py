"""SSD matching of FAST windows, dense and gated, against NumPy and OpenCV's brute force, on rendered pairs."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import torch

from tensor_stereo.batching import concatenate_features
from tensor_stereo.configs import PipelineConfig
from tensor_stereo.datasets import SyntheticDataset
from tensor_stereo.features import detect_features, to_gray
from tensor_stereo.matching import match_features
from tensor_stereo.types import Features

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite
from shared.scenes import GATES

DENSE = PipelineConfig(detector="fast")
GATED = PipelineConfig(detector="fast", matching=GATES)


def rows_of(features: Features) -> list[np.ndarray]:
    return [part.numpy() for part in features.descriptors.split(features.ptr.diff().tolist())]


def dense_numpy(views: list[list[np.ndarray]]) -> None:
    for a, b in zip(*views, strict=True):
        ((a**2).sum(1)[:, None] + (b**2).sum(1)[None] - 2 * a @ b.T).argmin(1)


def dense_opencv(views: list[list[np.ndarray]]) -> None:
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    for a, b in zip(*views, strict=True):
        matcher.match(a, b)


def main() -> None:
    suite = Suite("matching")
    pairs = list(SyntheticDataset(8))
    views = [
        concatenate_features([detect_features(to_gray(image[None]), DENSE) for image in images])
        for images in ([pair.image0 for pair in pairs], [pair.image1 for pair in pairs])
    ]
    windows = [rows_of(view) for view in views]
    cases = {
        "tensor_stereo gated, native": lambda: match_features(*views, GATED),
        "tensor_stereo dense": lambda: match_features(*views, DENSE),
        "NumPy dense": lambda: dense_numpy(windows),
        "OpenCV brute force": lambda: dense_opencv(windows),
    }
    cv2.setNumThreads(2)
    suite.compare("matching of FAST windows, per pair", cases, threads=2, units=len(pairs))
    suite.note("keypoints per image", mean=float(np.mean([len(v.keypoints) / v.num_images for v in views])))
    torch.set_num_threads(2)
    suite.write()


if __name__ == "__main__":
    main()
