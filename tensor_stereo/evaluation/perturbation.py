"""Putative matches made worse on purpose: exchanged partners and noisy keypoints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import torch

from tensor_stereo.types import Matches


def inject_outliers(matches: Matches, rate: float, generator: torch.Generator) -> Matches:
    """Exchange the partners of a random fraction of the matches of every pair.

    The chosen matches are put in random order, and each gets the view-1 keypoint of the next one. So every keypoint
    stays where a detector found it and in one match, and no chosen match keeps its partner. Costs stay with the view-0
    keypoint, as of a matcher that is sure of a wrong match.

    Args:
        matches: B pairs.
        rate: fraction of each pair's matches to exchange, in [0, 1], rounded to whole matches; a single chosen match
            has nobody to exchange with and stays.
        generator: where the choice comes from.

    Returns:
        The same rows with other ``keypoints1``; ``group`` is dropped if there was one. Gradients flow to the keypoints.

    Raises:
        ValueError: if ``rate`` lies outside [0, 1].

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
        >>> bad = inject_outliers(Matches(points, points, torch.tensor([0, 3])), 1.0, torch.Generator().manual_seed(0))
        >>> (bad.keypoints1 == points).all(1).any()
        tensor(False)
    """
    if not 0 <= rate <= 1:
        raise ValueError(f"rate must lie in [0, 1], got {rate}")
    partner = torch.arange(matches.num_matches)
    offsets = matches.ptr.tolist()
    for start, stop in pairwise(offsets):
        num_chosen = math.floor(rate * (stop - start) + 0.5)
        chosen = start + torch.randperm(stop - start, generator=generator)[:num_chosen]
        partner[chosen] = chosen.roll(-1)
    return replace(matches, keypoints1=matches.keypoints1[partner.to(matches.keypoints1.device)], group=None)


def add_noise(
    matches: Matches, noise_px: float, generator: torch.Generator, sizes: Sequence[tuple[int, int]] | None = None
) -> Matches:
    """Add Gaussian noise to x and y of both keypoints of every match.

    Args:
        matches: B pairs.
        noise_px: standard deviation.
        generator: where the noise comes from.
        sizes: (height, width) of the images of each pair; keypoints are clamped to them. None: no bounds.

    Returns:
        The same rows with other keypoints, in the dtype they have. Gradients flow to the keypoints.

    Raises:
        ValueError: if ``noise_px`` is negative or there is not one size per pair.

    Example:
        >>> points = torch.zeros(1, 2)
        >>> matches = Matches(points, points, torch.tensor([0, 1]))
        >>> noisy = add_noise(matches, 0.5, torch.Generator().manual_seed(0), [(10, 10)])
        >>> (noisy.keypoints0 >= 0).all()
        tensor(True)
    """
    if not noise_px >= 0:
        raise ValueError(f"noise_px must not be negative, got {noise_px}")
    if sizes is not None and len(sizes) != matches.num_pairs:
        raise ValueError(f"sizes must have one entry per pair ({matches.num_pairs}), got {len(sizes)}")
    moved = []
    for keypoints in (matches.keypoints0, matches.keypoints1):
        noise = torch.randn(keypoints.shape, generator=generator, dtype=torch.float64) * noise_px
        points = keypoints + noise.to(keypoints)
        if sizes is not None:
            last = torch.tensor([(width - 1, height - 1) for height, width in sizes]).to(points)
            bounds = last.repeat_interleave(matches.ptr.diff().to(points.device), 0)
            points = points.clamp(min=torch.zeros_like(bounds), max=bounds)
        moved.append(points)
    return replace(matches, keypoints0=moved[0], keypoints1=moved[1])
