"""The fit of slope and bias that turn log-odds into probabilities."""

from __future__ import annotations

import torch
from torch import Tensor


def fit_calibration(logit: Tensor, correct: Tensor, weight: Tensor) -> Tensor:
    """(2,) slope and bias of a logistic regression (Platt 1999), by Newton's method."""
    columns = torch.stack([logit, torch.ones_like(logit)], 1).double()
    target, weight = correct.double(), weight.double() / weight.sum()
    beta = torch.tensor([1.0, 0.0], dtype=torch.float64)
    for _ in range(30):
        probability = torch.sigmoid(columns @ beta)
        gradient = columns.T @ (weight * (probability - target))
        hessian = (columns * (weight * probability * (1 - probability))[:, None]).T @ columns
        beta = beta - torch.linalg.solve(hessian, gradient).clamp(-1, 1)
    return beta.float()
