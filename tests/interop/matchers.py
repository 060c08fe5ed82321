"""Matches with wrong ones among them, and a filter whose score has a gradient, for the tests of the converters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from tensor_stereo import Matches
from tensor_stereo.interop.glue_factory import two_view_filter
from tensor_stereo.modules import FilterOutput


def scene(seed: int, n: int = 60, wrong: float = 0.3) -> tuple[Tensor, Tensor]:
    """Keypoints of both views (n, 2) float32 px; a share of the partners is random."""
    rng = np.random.default_rng([seed, n])
    left = rng.random((n, 2)) * [320, 240]
    right = left - np.stack([15 + 5 * np.sin(left[:, 0] / 100), np.zeros(n)], 1)
    bad = rng.random(n) < wrong
    right[bad] = rng.random((int(bad.sum()), 2)) * [320, 240]
    return torch.from_numpy(left).float(), torch.from_numpy(right).float()


class SmoothFilter(nn.Module):
    """The verdicts of DelaunayFilter with a score that depends smoothly on the keypoints of view 1."""

    def forward(self, matches: Matches) -> FilterOutput:
        output = two_view_filter()(matches)
        return replace(output, score=torch.sigmoid(matches.keypoints1.sum(1) / 500))
