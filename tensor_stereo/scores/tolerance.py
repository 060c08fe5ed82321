"""Tolerances: how far off a match may be and still count as correct, and the probability that goes with each."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from tensor_stereo.configs import LEAST_ERROR_PX, MOST_ERROR_PX

TOLERANCES_PX = (LEAST_ERROR_PX, 1.0, 2.0, 3.0, MOST_ERROR_PX)  # at which scores predict; between them, linearly
NUM_TOLERANCES = len(TOLERANCES_PX)


def probability_within(cumulative: Tensor | None, max_error_px: float) -> Tensor:
    """The probability of an error of at most ``max_error_px``.

    Args:
        cumulative: (..., 5) probabilities of an error of at most each of :data:`TOLERANCES_PX`, which do not fall; None
            stands for a score that is no probability, and is refused.
        max_error_px: From .5 to 5 px; linear between the tolerances.

    Returns:
        (...) in the dtype of ``cumulative``; it never falls when ``max_error_px`` grows. Gradients flow.

    Raises:
        ValueError: for a tolerance outside of .5 to 5 px, or a score that is no probability.

    >>> probability_within(torch.tensor([0.1, 0.3, 0.5, 0.6, 0.8]), 1.5)
    tensor(0.4000)
    """
    if cumulative is None:
        raise ValueError("score must be 'learned' or 'consensus', which are probabilities; this one is not")
    if not LEAST_ERROR_PX <= max_error_px <= MOST_ERROR_PX:
        raise ValueError(
            f"max_error_px must lie between {LEAST_ERROR_PX:g} and {MOST_ERROR_PX:g} px, got {max_error_px}"
        )
    k = max(k for k in range(NUM_TOLERANCES - 1) if TOLERANCES_PX[k] <= max_error_px)
    low, high = TOLERANCES_PX[k : k + 2]
    below, above = cumulative[..., k], cumulative[..., k + 1]
    share = (max_error_px - low) / (high - low)
    if share == 1:
        return above
    return torch.minimum(below + share * (above - below), above)  # rounding must not lift it above the next one


def rising(columns: Sequence[Tensor]) -> Tensor:
    """Stack the values (...) of five tolerances to (..., 5), each at least as large as those of smaller tolerances.

    >>> rising(torch.tensor([0.2, 0.1, 0.4, 0.4, 0.3]).unbind())
    tensor([0.2000, 0.2000, 0.4000, 0.4000, 0.4000])
    """
    largest = [columns[0]]
    for values in columns[1:]:
        largest.append(torch.maximum(largest[-1], values))
    return torch.stack(largest, -1)
