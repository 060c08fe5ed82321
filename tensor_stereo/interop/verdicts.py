"""Matches from files through the filter: blocks of bounded size, and checks that name the place of what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from tensor_stereo.batching import collate_matches, select_pairs
from tensor_stereo.modules import FilterOutput
from tensor_stereo.ops.segments import check_range
from tensor_stereo.types import Matches, Relation

Array = NDArray[Any]
Int = NDArray[np.int64]
Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int8 = NDArray[np.int8]
Key = TypeVar("Key")
MatchFilter: TypeAlias = Callable[[Matches], FilterOutput]

BLOCK_MATCHES = 1 << 17  # about 200 MB while the filter runs
MAX_ROWS = 1 << 26  # matches of a table, keypoints of an image: 1 GB of coordinates a view


@dataclass(frozen=True)
class FilterSummary:
    """Counts over the putative matches of a file."""

    num_pairs: int = 0
    num_matches: int = 0
    num_kept: int = 0
    num_rejected: int = 0
    num_untested: int = 0
    num_agreeing: int = 0  # whose neighbours in one view contain those in the other

    def add(self, num_pairs: int, verdicts: Verdicts) -> FilterSummary:
        """The counts with those of ``num_pairs`` more pairs."""
        num_matches, num_kept = len(verdicts.inlier), int(verdicts.inlier.sum())
        num_untested = int((verdicts.relation == Relation.UNTESTED).sum())
        return FilterSummary(
            self.num_pairs + num_pairs,
            self.num_matches + num_matches,
            self.num_kept + num_kept,
            self.num_rejected + num_matches - num_kept - num_untested,
            self.num_untested + num_untested,
            self.num_agreeing + int(((verdicts.relation > 0) & (verdicts.relation < Relation.CONFLICT)).sum()),
        )


class Verdicts(NamedTuple):
    """Verdict on every match."""

    inlier: Bool  # (M,)
    score: Float | None  # (M,) in [0, 1], higher is better, 0 for untested matches; None if the settings ask for none
    relation: Int8  # (M,) values of Relation

    def spread(self, mask: Bool) -> Verdicts:
        """The same at the M True places of ``mask`` (N,); no inlier, 0 and UNTESTED elsewhere."""
        return self._map(lambda values: _spread(values, mask))

    def take(self, rows: Int) -> Verdicts:
        """The verdicts of ``rows``, in their order."""
        return self._map(lambda values: values[rows])

    def _map(self, change: Callable[[Array], Array]) -> Verdicts:
        return Verdicts(*(None if values is None else change(values) for values in self))  # type: ignore[arg-type]


def _spread(values: Array, mask: Bool) -> Array:
    wide = np.zeros(len(mask), values.dtype)
    wide[mask] = values
    return wide


def filter_matches(matches: Matches, run: MatchFilter) -> Verdicts:
    """Run a filter over a batch, in blocks of whole pairs with about ``BLOCK_MATCHES`` matches.

    Args:
        matches: B pairs on the CPU.
        run: a filter that takes Matches and returns a FilterOutput; pairs must not depend on each other.

    Example:
        >>> from tensor_stereo import DelaunayFilter
        >>> points = torch.tensor([[0.0, 0.0], [9.0, 1.0], [1.0, 8.0], [8.0, 9.0]])
        >>> filter_matches(Matches(points, points - 1, torch.tensor([0, 4])), DelaunayFilter()).inlier
        array([ True,  True,  True,  True])
    """
    ptr = matches.ptr.numpy()
    parts: list[Verdicts] = []
    start = 0
    while start < matches.num_pairs or not parts:  # of no pairs there are verdicts too, empty ones
        fitting = int(np.searchsorted(ptr, ptr[start] + BLOCK_MATCHES, side="right")) - 1
        stop = min(max(fitting, start + 1), matches.num_pairs)  # a pair is never cut
        output = run(select_pairs(matches, start, stop))
        score = None if output.score is None else output.score.detach().double().numpy()
        parts.append(Verdicts(output.inlier.numpy(), score, output.relation.numpy()))
        start = stop
    columns = zip(*parts, strict=True)
    return Verdicts(*(None if values[0] is None else np.concatenate(values) for values in columns))  # type: ignore[arg-type]


def filter_each(items: Iterable[tuple[Key, Matches]], run: MatchFilter) -> Iterator[tuple[Key, Verdicts]]:
    """Run a filter over a stream of pairs, in the blocks of :func:`filter_matches`.

    Args:
        items: a key for each pair, and its matches; some pairs may have a cost and others none.
        run: a filter for :func:`filter_matches`.

    Yields:
        Every key with its verdicts, in order.
    """
    block: list[tuple[Key, Matches]] = []
    num_matches = 0
    for key, matches in items:
        is_full = num_matches + matches.num_matches > BLOCK_MATCHES
        if block and (is_full or (matches.cost is None) != (block[0][1].cost is None)):
            yield from _filter_block(block, run)
            block, num_matches = [], 0
        block.append((key, matches))
        num_matches += max(matches.num_matches, 1)  # empty pairs take memory too
    if block:
        yield from _filter_block(block, run)


def _filter_block(block: list[tuple[Key, Matches]], run: MatchFilter) -> Iterator[tuple[Key, Verdicts]]:
    verdicts = filter_matches(collate_matches([matches for _, matches in block]), run)
    cuts = np.cumsum([matches.num_matches for _, matches in block])[:-1]
    columns = ([None] * len(block) if values is None else np.split(values, cuts) for values in verdicts)
    for (key, _), *values in zip(block, *columns, strict=True):
        yield key, Verdicts(*values)


def pick_matches(place: str, keypoints0: Array, keypoints1: Array, matches0: Array, scores0: Array | None) -> Matches:
    """One pair's matches from the partner of each keypoint, in the order of view 0.

    Args:
        place: file and pair, for errors.
        keypoints0: (N0, 2), (x, y) in px.
        keypoints1: (N1, 2).
        matches0: at most (N0,) integers: a row of ``keypoints1``, -1 for none, -2 for "ignore".
        scores0: one score per row of ``matches0``, higher is better; the cost is 1 - score.

    Raises:
        ValueError: if a partner does not exist, a matched keypoint is not finite or a score is NaN.

    >>> points = np.eye(2)
    >>> pick_matches("m.npz", points, points, np.array([-1, 0]), None).keypoints1
    tensor([[1., 0.]], dtype=torch.float64)
    """
    if len(matches0) > len(keypoints0):
        raise ValueError(f"{place}: matches0 has {len(matches0)} rows, but there are {len(keypoints0)} keypoints0")
    partner = matches0.astype(np.int64)
    wrong = (partner < -2) | (partner >= len(keypoints1))
    if wrong.any():
        row = int(wrong.argmax())
        known = f"one of {len(keypoints1)} keypoints1"
        raise ValueError(f"{place}: matches0 must be -1, -2 or {known}, got {partner[row]} in row {row}")
    rows0 = np.flatnonzero(partner >= 0)
    rows1 = partner[rows0]
    cost = None
    if scores0 is not None:
        cost = 1 - scores0[rows0].astype(np.float64)
        if np.isnan(cost).any():
            raise ValueError(f"{place}: matching_scores0 must not be NaN, got NaN in row {rows0[np.isnan(cost)][0]}")
    return pair_matches(place, keypoints0, keypoints1, rows0, rows1, cost)


def pair_matches(
    place: str,
    keypoints0: Array,
    keypoints1: Array,
    rows0: Int,
    rows1: Int,
    cost: Float | None = None,
) -> Matches:
    """One pair's matches from existing rows of both views; raises ValueError if a keypoint is not finite."""
    views = keypoints0[rows0].astype(np.float64), keypoints1[rows1].astype(np.float64)
    for name, points, rows in zip(("keypoints0", "keypoints1"), views, (rows0, rows1), strict=True):
        check_range(points, lambda k, name=name, rows=rows: f"{place}: {name}, row {rows[k]},")  # type: ignore[misc]
    ptr = torch.tensor([0, len(rows0)])
    left, right = (torch.from_numpy(points) for points in views)
    return Matches(left, right, ptr, None if cost is None else torch.from_numpy(cost))
