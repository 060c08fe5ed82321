"""FAST pipeline from image tensors to verdicts against OpenCV FAST + dense NumPy SSD + scipy + Python sets."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from tensor_stereo.configs import PipelineConfig
from tensor_stereo.features import to_gray
from tensor_stereo.pipeline import run_pipeline

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite
from shared.scenes import GATES, read_eight
from speed.python_sets import classify_with_sets


def naive(images: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """What one would write first: one image after the other, the matches made one-to-one by the lowest cost."""
    for pair in images:
        points, windows = [], []
        for image in pair:
            found = cv2.FastFeatureDetector.create(20).detect(image)
            found = sorted(found, key=lambda k: -k.response)[:2000]
            at = np.array([k.pt for k in found])
            padded = cv2.copyMakeBorder(image, 5, 5, 5, 5, cv2.BORDER_REFLECT).astype(np.float32)
            patches = np.lib.stride_tricks.sliding_window_view(padded, (11, 11))
            x, y = at.astype(int).T
            points.append(at)
            windows.append(patches[y, x].reshape(len(at), -1))
        a, b = windows
        cost = (a**2).sum(1)[:, None] + (b**2).sum(1)[None] - 2 * a @ b.T
        best = cost.argmin(1)
        order = np.argsort(cost[np.arange(len(a)), best], kind="stable")
        _, first = np.unique(best[order], return_index=True)
        left, right = points[0][order[first]], points[1][best[order[first]]]
        classify_with_sets(left, right)


def main() -> None:
    suite = Suite("pipeline")
    source, pairs = read_eight(suite.options.data)
    tensors = [(to_gray(p.image0[None])[0], to_gray(p.image1[None])[0]) for p in pairs]
    arrays = [(a[0].numpy(), b[0].numpy()) for a, b in tensors]
    plain = PipelineConfig(detector="fast", verdict="cardinality")  # as the peer: no score
    config = replace(plain, matching=GATES)
    cases = {
        "tensor_stereo, gated": lambda: run_pipeline(tensors, config),
        "tensor_stereo, no gates": lambda: run_pipeline(tensors, plain),
        "OpenCV + NumPy + scipy + sets": lambda: naive(arrays),
    }
    cv2.setNumThreads(2)
    suite.compare(f"FAST pipeline, {source}, per pair", cases, threads=2, units=len(pairs))
    seconds = run_pipeline(tensors, config).seconds
    suite.note("stages of the gated pipeline in ms per pair", **{k: 1e3 * v / len(pairs) for k, v in seconds.items()})
    suite.write()


if __name__ == "__main__":
    main()
