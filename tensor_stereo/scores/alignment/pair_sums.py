"""Sums over the rows of every pair."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from tensor_stereo.batching import ptr_to_batch
from tensor_stereo.types import Matches


class PairSums(NamedTuple):
    """Which pair some of the matches belong to, which lie pair by pair.

    >>> of_pairs = PairSums(torch.tensor([0, 0, 1]), torch.tensor([0, 2, 3]))
    >>> of_pairs.sum(torch.tensor([1.0, 2.0, 4.0]))
    tensor([3., 4.])
    """

    batch: Tensor  # (K,)
    ptr: Tensor  # (B + 1,)

    def sum(self, values: Tensor) -> Tensor:
        """(B, ...) sums of (K, ...) values over the rows of each pair, in their order."""
        if torch.compiler.is_compiling():  # it knows no sums of segments
            return values.new_zeros(len(self.ptr) - 1, *values.shape[1:]).index_add(0, self.batch, values)
        return torch.segment_reduce(values, "sum", offsets=self.ptr)  # four times as fast

    def spread(self, values: Tensor) -> Tensor:
        """(K, ...) rows of (B, ...) values, each that of its pair."""
        return values.index_select(0, self.batch)


def say(relative: Tensor) -> Tensor:
    """The weights of Geman & McClure (1987) in a fit, of residuals over their scale.

    >>> say(torch.tensor([0.0, 1.0]))
    tensor([1.0000, 0.2500])
    """
    return 1 / (1 + relative.square()).square()


def select_rows(matches: Matches, chosen: Tensor) -> tuple[Tensor, PairSums]:
    """The rows (K,) where a (M,) mask holds, and the pairs that they belong to.

    >>> points = torch.zeros(3, 2)
    >>> chosen = torch.tensor([True, False, True])
    >>> rows, of_pairs = select_rows(Matches(points, points, torch.tensor([0, 2, 3])), chosen)
    >>> rows, of_pairs.ptr
    (tensor([0, 2]), tensor([0, 1, 2]))
    """
    rows = chosen.nonzero()[:, 0]
    batch = ptr_to_batch(matches.ptr).index_select(0, rows)
    return rows, PairSums(batch, functional.pad(chosen.cumsum(0), (1, 0)).index_select(0, matches.ptr))
