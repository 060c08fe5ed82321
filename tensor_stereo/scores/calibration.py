"""Probabilities from beliefs, and verdicts that aim at an expected precision or sensitivity."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tensor_stereo.scores.tolerance import rising

# Slope and bias of a logistic regression on the log-odds of the belief (Platt 1999) at each of TOLERANCES_PX, for pairs
# that are rectified, that have epipolar lines, and that have neither; fitted by
# benchmarks/training/calibrate_consensus.py on the real scenes of the training set.
_CONSENSUS = (
    ((0.67, 0.45), (0.66, 2.40), (0.59, 3.14), (0.61, 3.63), (0.62, 4.03)),
    ((0.70, 0.22), (0.69, 2.46), (0.65, 3.69), (0.71, 4.51), (0.74, 5.15)),
    ((0.86, -0.11), (0.83, 1.96), (0.68, 3.10), (0.69, 3.70), (0.69, 4.09)),
)
_LEAST = 1e-4  # probability, of either outcome
_NUM_KNOTS = 2048  # linear between them, the probability is off by less than 3e-6
_PARTS = 2**32  # of one match; whole numbers add up to the same in any order


def calibrate_consensus(belief: Tensor, kind: Tensor | None = None) -> Tensor:
    """The probabilities that a match is correct within each tolerance, from the belief of its neighbours.

    Args:
        belief: (M,) as :func:`tensor_stereo.scores.consensus.consensus_belief` gives it.
        kind: (M,) int64, what the pair of each match is: 0 rectified, 1 not, with epipolar lines, 2 without; None means
            that all are rectified.

    Returns:
        (M, 5) float64, for :data:`tensor_stereo.scores.tolerance.TOLERANCES_PX`, growing with the belief and never
        falling with the tolerance. Gradients flow where the belief lies between 1e-4 and 1 - 1e-4.

    >>> calibrate_consensus(torch.tensor([0.0, 0.5, 1.0]))[:, 1]
    tensor([0.0246, 0.9168, 0.9998], dtype=torch.float64)
    """
    # Linear between knots: exponentials would differ in the last bit between a vector's lanes and its rest, and a batch
    # would not equal the loop over its pairs.
    slope, bias = (
        torch.tensor(_CONSENSUS, dtype=torch.float64, device=belief.device).transpose(0, 1)[..., None].unbind(2)
    )
    end = math.log((1 - _LEAST) / _LEAST)
    logits = torch.linspace(-end, end, _NUM_KNOTS + 1, dtype=torch.float64, device=belief.device)
    knots, values = torch.sigmoid(logits), torch.sigmoid(slope * logits + bias)  # (K,), (5, 3, K)
    place = belief.double().clamp(knots[0], knots[-1])
    k = torch.searchsorted(knots, place.detach(), right=True).clamp(1, len(knots) - 1) - 1
    share = (place - knots.index_select(0, k)) / (knots[1:] - knots[:-1]).index_select(0, k)
    at = k if kind is None else k + len(knots) * kind
    columns = [row.index_select(0, at) + share * row.diff().index_select(0, at) for row in values.flatten(1)]
    return rising(columns)


@torch.no_grad()
def keep_by_target(
    probability: Tensor,
    tested: Tensor,
    ptr: Tensor,
    *,
    target_sensitivity: float | None = None,
    min_precision: float | None = None,
) -> Tensor:
    """In every pair, keep as many of the likeliest matches as the target allows.

    The number of incorrect matches among some is expected to be the sum of 1 - probability. Matches of one probability
    are kept together or not at all.

    Args:
        probability: (M,) calibrated, of each match being correct.
        tested: (M,) bool; other matches are rejected and do not count.
        ptr: (B + 1,) int64 offsets.
        target_sensitivity: least expected fraction of the incorrect matches that is rejected.
        min_precision: least expected fraction of the kept matches that is correct; given instead.

    Returns:
        (M,) bool. Pairs do not depend on each other, nor on the order of their matches.

    Raises:
        ValueError: unless just one target is given, in [0, 1], or for a probability that is NaN.

    >>> probability = torch.tensor([0.9, 0.2, 0.8, 0.5])
    >>> keep_by_target(probability, probability > 0, torch.tensor([0, 4]), min_precision=0.7)
    tensor([ True, False,  True,  True])
    """
    if (target_sensitivity is None) == (min_precision is None):
        raise ValueError(f"give target_sensitivity or min_precision, got {target_sensitivity} and {min_precision}")
    name, target = next(
        (name, value)
        for name, value in (("target_sensitivity", target_sensitivity), ("min_precision", min_precision))
        if value is not None
    )
    if not 0 <= target <= 1:
        raise ValueError(f"{name} must lie in [0, 1], got {target}")
    if not torch.compiler.is_compiling() and bool(probability.isnan().any()):
        raise ValueError(f"probability must not be NaN, got NaN in row {int(probability.isnan().int().argmax())}")
    row = torch.arange(len(tested), device=ptr.device)
    batch = torch.bucketize(row, ptr[1:], right=True)
    likely = torch.where(tested, probability.double(), -1)
    order = likely.argsort(descending=True, stable=True)
    order = order[batch[order].argsort(stable=True)]  # pairs stay in place, the likeliest of each first
    value = likely[order]
    risk = torch.where(tested[order], (1 - value) * _PARTS, 0).floor().long()
    so_far = torch.nn.functional.pad(risk.cumsum(0), (1, 0))
    begin, end = ptr[:-1][batch], ptr[1:][batch]
    wrong = so_far[1:] - so_far[begin]  # expected among the matches down to this one
    whole = so_far[end] - so_far[begin] if min_precision is None else (row + 1 - begin) * _PARTS
    after = torch.minimum(row + 1, end - 1)
    is_last = (after == row) | (value[after] != value)  # of equal ones
    fulfils = tested[order] & is_last & (wrong <= (1 - target) * whole.double())
    least = torch.full_like(ptr[:-1], torch.inf, dtype=torch.float64)
    least.scatter_reduce_(0, batch, torch.where(fulfils, value, torch.inf), "amin")
    return tested & (likely >= least[batch])
