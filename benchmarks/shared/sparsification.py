"""How well a confidence sorts the pixels of a map, beyond what the package measures."""

from __future__ import annotations

import torch
from torch import Tensor


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
