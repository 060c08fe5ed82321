"""Peak memory and time of every detector on a pair of 12 megapixels, and memory of images to verdicts (Linux).

    python benchmarks/speed/memory.py

Every case is a process of its own. Memory is what the process holds at most above what it held before the call, when
everything was loaded and had run once on a small image.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

from tensor_stereo.configs import GFTTConfig, PipelineConfig, SIFTConfig
from tensor_stereo.features import detect_features, to_gray
from tensor_stereo.pipeline import run_pipeline

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite
from shared.scenes import read_eight

WIDTH, HEIGHT = 3892, 3108
Call = Callable[[], object]


def texture(seed: int, width: int, height: int) -> torch.Tensor:
    """(1, H, W) uint8 noise of many scales."""
    rng = np.random.default_rng(seed)
    levels = np.zeros((height, width), np.float32)
    for scale in (1, 2, 4, 8, 16, 32, 64):
        noise = rng.normal(size=(height // scale + 2, width // scale + 2)).astype(np.float32)
        levels += scale**0.5 * cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    return torch.from_numpy(np.clip(10 * levels + 128, 0, 255).astype(np.uint8))[None]


def resident(key: str) -> float:
    """MB of this process: VmRSS now, VmHWM at most."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) / 1e3 for line in lines if line.startswith(key))


def measure(warm: Call, call: Call) -> tuple[float, float, float]:
    """Seconds, MB above what was held before, MB at most."""
    warm()
    ctypes.CDLL("libc.so.6").malloc_trim(0)  # what is free, and was not given back, is not held
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    before, start = resident("VmRSS"), time.perf_counter()
    call()
    return time.perf_counter() - start, resident("VmHWM") - before, resident("VmHWM")


def detect(config: PipelineConfig) -> tuple[float, float, float]:
    pair = torch.stack([texture(0, WIDTH, HEIGHT), texture(1, WIDTH, HEIGHT)])
    return measure(lambda: detect_features(pair[:, :, :200, :200], config), lambda: detect_features(pair, config))


def verdicts(data: Path | None, **settings: bool) -> tuple[float, float, float]:
    pairs = [tuple(to_gray(image[None])[0] for image in (p.image0, p.image1)) for p in read_eight(data)[1]]
    config = PipelineConfig(detector="fast", **settings)
    small = [tuple(image[:, :120, :160] for image in pairs[0])]
    return measure(lambda: run_pipeline(small, config), lambda: [run_pipeline([pair], config) for pair in pairs])


def verdicts_of_large() -> tuple[float, float, float]:
    right = texture(0, WIDTH + 40, HEIGHT)
    pair, config = (right[:, :, :-40].contiguous(), right[:, :, 40:].contiguous()), PipelineConfig(detector="fast")
    small = [tuple(image[:, :120, :160] for image in pair)]
    return measure(lambda: run_pipeline(small, config), lambda: run_pipeline([pair], config))


def main() -> None:
    suite = Suite("memory")
    cases: dict[str, Callable[[], tuple[float, float, float]]] = {
        "fast": partial(detect, PipelineConfig(detector="fast")),
        "gftt, kornia": partial(detect, PipelineConfig(detector="gftt")),
        "gftt, opencv": partial(detect, PipelineConfig(detector="gftt", gftt=GFTTConfig(backend="opencv"))),
        "surf": partial(detect, PipelineConfig(detector="surf")),
        "sift, kornia": partial(detect, PipelineConfig(detector="sift")),
        "sift, opencv": partial(detect, PipelineConfig(detector="sift", sift=SIFTConfig(backend="opencv"))),
        "eight scenes, learned": partial(verdicts, suite.options.data),
        "eight scenes, learned, repaired and refined": partial(verdicts, suite.options.data, repair=True, refine=True),
        "12 megapixels, fast, learned": verdicts_of_large,
    }
    for name, case in cases.items():
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            seconds, above, peak = pool.apply(case)
        suite.note(name, seconds=seconds, mb_above=above, mb_at_most=peak)
    suite.write()


if __name__ == "__main__":
    main()
