"""How far probabilities are from what they promise."""

from __future__ import annotations

import torch

NUM_BINS = 15


def calibration_error(probability: torch.Tensor, correct: torch.Tensor) -> float:
    """Expected calibration error over bins of equal width (Guo et al., ICML 2017)."""
    cell = (probability * NUM_BINS).long().clamp(0, NUM_BINS - 1)
    gap = torch.zeros(NUM_BINS, dtype=torch.float64).index_add(0, cell, probability.double() - correct.double())
    return float(gap.abs().sum() / len(cell))
