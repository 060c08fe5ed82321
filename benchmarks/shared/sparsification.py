"""How well a confidence sorts the pixels of a map."""

from __future__ import annotations

import torch
from torch import Tensor

_SHARES = 20  # of the pixels that are kept, from a twentieth on


def area(score: Tensor, wrong: Tensor) -> float:
    """Mean share of wrong pixels among the most confident 5, 10, ... 100 %; of equal scores the mean counts.

    Source: Hu & Mordohai, "A quantitative evaluation of confidence measures for stereo vision", PAMI 34(11), 2012.

    >>> area(torch.tensor([0.9, 0.1]), torch.tensor([False, True]))
    0.25
    """
    rate = cumulative_wrong(score, wrong) / torch.arange(1, len(score) + 1, dtype=torch.float64)
    last = (torch.arange(1, _SHARES + 1, dtype=torch.float64) * len(score) / _SHARES).ceil().long() - 1
    return float(rate[last].mean())


def cumulative_wrong(score: Tensor, wrong: Tensor) -> Tensor:
    """(N,) float64 wrong pixels among the first n; those of equal scores are spread evenly."""
    order = torch.argsort(score, descending=True, stable=True)
    score, wrong = score[order], wrong[order].double()
    _, run, size = torch.unique_consecutive(score, return_inverse=True, return_counts=True)
    total = torch.zeros(len(size), dtype=torch.float64).index_add(0, run, wrong)
    return (total / size)[run].cumsum(0)


def auc(score: Tensor, correct: Tensor) -> float:
    """Area under the ROC curve: how often a correct pixel has the higher score, ties half.

    >>> auc(torch.tensor([0.9, 0.1, 0.1]), torch.tensor([True, False, True]))
    0.75
    """
    _, run, size = torch.unique(score, return_inverse=True, return_counts=True)
    rank = (size.cumsum(0).double() - (size.double() - 1) / 2)[run]
    positives, negatives = int(correct.sum()), int((~correct).sum())
    if not positives or not negatives:
        return float("nan")
    return float((rank[correct].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def keep_expected(probability: Tensor, precision: float) -> Tensor:
    """Indices of the most that have an expected share of right ones, best first.

    >>> keep_expected(torch.tensor([0.5, 1.0, 0.9]), 0.9).tolist()
    [1, 2]
    """
    order = torch.argsort(probability, descending=True)
    expected = probability[order].double().cumsum(0) / torch.arange(1, len(order) + 1)
    enough = (expected >= precision).nonzero()
    return order[: int(enough.max()) + 1] if len(enough) else order[:0]
