"""Time of the confidence of a semi-global map of one KITTI pair, or of a rendered pair of that size, and its memory.

python benchmarks/speed/confidence.py
"""

from __future__ import annotations

import ctypes
import sys
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

from tensor_stereo.configs import SyntheticConfig
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tensor_stereo.dense import filter_disparity, score_disparity
from tensor_stereo.features import to_gray
from tensor_stereo.modules import DelaunayFilter

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite
from shared.scenes import read_pairs
from speed.images import semi_global
from speed.memory import resident

STRIDE = 4


def main() -> None:
    suite = Suite("confidence_speed")
    if suite.options.data is None:
        pair = render_pair(0, SyntheticConfig(width_px=1242, height_px=375))
    else:
        pair = read_pairs(suite.options.data / "kitti2015")[0]
    views = [to_gray(image[None])[0] for image in (pair.image0, pair.image1)]
    arrays = [(views[0][0].numpy(), views[1][0].numpy())]
    found = torch.from_numpy(semi_global(arrays, cv2.STEREO_SGBM_MODE_SGBM, both=False)[0].astype(np.float32) / 16)
    disparity = found.where(found >= 0, torch.nan)
    images = {"images0": views[0], "images1": views[1]}
    cases = {
        f"score_disparity, stride {STRIDE}": partial(score_disparity, disparity, *views, stride=STRIDE),
        "score_disparity, every pixel": partial(score_disparity, disparity, *views),
        f"learned on the grid, stride {STRIDE}": partial(
            filter_disparity, disparity, STRIDE, filter=DelaunayFilter(), **images
        ),
        "SGBM": partial(semi_global, arrays, cv2.STEREO_SGBM_MODE_SGBM, both=False),
    }
    for threads in (1, 2):
        cv2.setNumThreads(threads)
        title = f"confidence of a map of {disparity.shape[1]} x {disparity.shape[0]} px"
        suite.compare(title, cases, threads=threads, repeats=min(7, suite.options.repeats))
    for name in list(cases)[:2]:
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
        before = resident("VmRSS")
        cases[name]()
        suite.note(name, mb_above=resident("VmHWM") - before)
    suite.write()


if __name__ == "__main__":
    with torch.inference_mode():
        main()
