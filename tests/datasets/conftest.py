"""Files in the formats of the benchmarks, written for one test."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

WriteScene = Callable[..., Path]


@pytest.fixture
def write_scene() -> WriteScene:
    """Write images (and empty other files) of one scene: ``write_scene(folder, "im2.png im6.png", width=450)``."""

    def write(folder: Path, names: str, *, width: int = 16, height: int = 4) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        for name in names.split():
            grey = "disp" in name or name.endswith(".pgm")
            if Path(name).suffix in (".png", ".ppm", ".pgm"):
                shape = (height, width) if grey else (height, width, 3)
                assert cv2.imwrite(str(folder / name), np.full(shape, 9, dtype=np.uint8))
            else:
                (folder / name).touch()
        return folder

    return write
