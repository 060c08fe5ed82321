"""classify_matches, points to verdicts, against scipy with Python sets and OpenCV's GMS."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2

import tensor_stereo as ts

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite
from shared.points import matched_batch, matched_points
from speed.python_sets import classify_with_sets

PAIRS, COUNT = 64, 1000


def main() -> None:
    suite = Suite("classify")
    for kind in ("float", "integer"):
        pairs = [matched_points(kind, COUNT, 10 * b) for b in range(PAIRS)]
        matches = matched_batch(kind, PAIRS, COUNT)
        keypoints = [[[cv2.KeyPoint(float(x), float(y), 1) for x, y in view] for view in pair] for pair in pairs]
        links = [cv2.DMatch(i, i, 0.0) for i in range(COUNT)]

        def gms(keypoints: list = keypoints, links: list = links) -> None:
            for kp0, kp1 in keypoints:
                cv2.xfeatures2d.matchGMS((640, 480), (640, 480), kp0, kp1, links, False, False, 6)

        cases = {
            "tensor_stereo native": lambda m=matches: ts.classify_matches(m, backend="native"),
            "tensor_stereo scipy": lambda m=matches: ts.classify_matches(m, backend="scipy"),
            "OpenCV matchGMS": gms,
            "scipy Delaunay + Python sets": lambda p=pairs: [classify_with_sets(*pair) for pair in p],
        }
        cv2.setNumThreads(2)
        title = f"classify, {kind}, {PAIRS} pairs x {COUNT} matches"
        ratios = suite.compare(title, cases, threads=2, units=PAIRS, repeats=min(9, suite.options.repeats))
        faster = ratios["scipy Delaunay + Python sets"] / ratios["tensor_stereo scipy"]
        suite.note(f"scipy back end against the loop, {kind}", times_faster=faster)
    suite.write()


if __name__ == "__main__":
    main()
