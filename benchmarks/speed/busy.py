"""The command line beside two processes that never rest: wall time against that on a quiet machine.

    python benchmarks/speed/busy.py

Threads that wait by spinning, OpenMP's default, are compared with those that the command line asks for. The pair is
rendered.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from tensor_stereo.configs import SyntheticConfig
from tensor_stereo.datasets.synthetic.rendering import render_pair

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks/, for its packages
from shared.harness import Suite

SPINNING = {"OMP_WAIT_POLICY": "active", "KMP_BLOCKTIME": "200"}


@contextmanager
def busy(count: int) -> Iterator[None]:
    """So many processes that compute while the body runs."""
    with ExitStack() as stack:
        for _ in range(count):
            process = stack.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
            stack.callback(process.kill)
        yield


def classify(left: Path, right: Path, detector: str, neighbors: int, environment: dict[str, str]) -> None:
    command = [sys.executable, "-m", "tensor_stereo", "classify", str(left), str(right), "--detector", detector]
    with busy(neighbors):
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env={**os.environ, **environment})


def main() -> None:
    suite = Suite("busy")
    pair = render_pair(0, SyntheticConfig(width_px=800, height_px=600))
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{side}.png" for side in ("left", "right")]
        for path, image in zip(paths, (pair.image0, pair.image1), strict=True):
            levels = np.rint(255 * image.permute(1, 2, 0).numpy()).astype(np.uint8)
            cv2.imwrite(str(path), levels[..., ::-1])
        for detector in ("fast", "sift"):
            run = partial(classify, *paths, detector)
            cases = {
                "quiet": partial(run, 0, {}),
                "beside two busy processes": partial(run, 2, {}),
                "the same, threads that spin": partial(run, 2, SPINNING),
            }
            suite.compare(f"tensor-stereo classify --detector {detector}", cases, threads=2, repeats=5)
    suite.write()


if __name__ == "__main__":
    main()
