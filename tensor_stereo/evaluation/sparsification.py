"""How well a confidence sorts the pixels of a disparity map.

Source: Hu & Mordohai, "A quantitative evaluation of confidence measures for stereo vision", PAMI 34(11), 2012,
section 5: the share of wrong pixels among the most confident ones, over the share of pixels that is kept.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tensor_stereo.types import check_vector

NUM_SHARES = 20  # of the pixels that are kept: a twentieth, two, ... all


def sparsification_curve(score: Tensor, wrong: Tensor, num_shares: int = NUM_SHARES) -> Tensor:
    """The share of wrong pixels among the most confident 1, 2, ... n n-ths of them.

    Args:
        score: (N,) confidence of each pixel in any unit; a higher one is kept longer. NaN is refused.
        wrong: (N,) bool.
        num_shares: n.

    Returns:
        (n,) float64; NaN without pixels. Of equal scores the mean counts, so that the order of the pixels does not.

    Raises:
        ValueError: if the lengths differ, a score is NaN, or ``num_shares`` is below 1.

    >>> sparsification_curve(torch.tensor([0.9, 0.1, 0.5, 0.8]), torch.tensor([False, True, False, False]), 4)
    tensor([0.0000, 0.0000, 0.0000, 0.2500], dtype=torch.float64)
    """
    if num_shares < 1:
        raise ValueError(f"num_shares must be at least 1, got {num_shares}")
    found = cumulative_wrong(score, wrong)
    if not len(found):
        return torch.full((num_shares,), torch.nan, dtype=torch.float64)
    last = (torch.arange(1, num_shares + 1, dtype=torch.float64) * len(score) / num_shares).ceil().long() - 1
    return found.cpu()[last] / (last + 1)


def sparsification_area(score: Tensor, wrong: Tensor, num_shares: int = NUM_SHARES) -> float:
    """The mean of :func:`sparsification_curve`: the less, the better; the least is that of ``-wrong`` as a score.

    Args:
        score: As there.
        wrong: As there.
        num_shares: As there.

    >>> sparsification_area(torch.tensor([0.9, 0.1]), torch.tensor([False, True]))
    0.25
    """
    return float(sparsification_curve(score, wrong, num_shares).mean())


def cumulative_wrong(score: Tensor, wrong: Tensor) -> Tensor:
    """(N,) float64 wrong pixels among the n most confident; those of equal scores are spread evenly.

    >>> cumulative_wrong(torch.tensor([0.5, 0.5]), torch.tensor([True, False]))
    tensor([0.5000, 1.0000], dtype=torch.float64)
    """
    check_vector("score", score, score.numel())
    check_vector("wrong", wrong, len(score))
    if wrong.dtype != torch.bool:
        raise TypeError(f"wrong must be bool, got {wrong.dtype}")
    if bool(score.isnan().any()):
        raise ValueError("score must not be NaN")
    order = torch.argsort(score, descending=True, stable=True)
    score, wrong_in_order = score[order], wrong[order].double()
    _, run, size = torch.unique_consecutive(score, return_inverse=True, return_counts=True)
    total = torch.zeros(len(size), dtype=torch.float64, device=score.device).index_add(0, run, wrong_in_order)
    found: Tensor = (total / size)[run].cumsum(0)
    return found
