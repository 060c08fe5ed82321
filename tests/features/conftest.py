"""Images that every detector finds something in."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor


def make_texture(seed: int, height: int = 120, width: int = 136) -> Tensor:
    """(H, W) uint8 noise of several scales: corners for FAST and GFTT, blobs for SIFT and SURF."""
    generator = np.random.default_rng(seed)
    image = np.zeros((height, width))
    for cell in (24, 10, 4, 2):
        coarse = generator.normal(size=(height // cell + 2, width // cell + 2))
        image += cell**0.5 * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    low, high = image.min(), image.max()
    return torch.from_numpy(np.rint((image - low) / (high - low) * 255).astype(np.uint8))


@pytest.fixture(scope="session")
def textures() -> Tensor:
    """(3, 1, H, W) uint8."""
    return torch.stack([make_texture(seed) for seed in range(3)])[:, None]
