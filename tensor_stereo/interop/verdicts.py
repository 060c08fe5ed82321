"""Matches from files through the filter: blocks of bounded size, and checks that name the place of what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import astuple, dataclass
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from tensor_stereo.batching import collate_matches, select_pairs
from tensor_stereo.modules import FilterOutput
from tensor_stereo.ops.segments import check_range
from tensor_stereo.scores import Origin
from tensor_stereo.types import Matches, Relation

Array = NDArray[Any]
Int = NDArray[np.int64]
Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int8 = NDArray[np.int8]
Key = TypeVar("Key")
MatchFilter: TypeAlias = Callable[[Matches], FilterOutput]

BLOCK_MATCHES = 1 << 17  # about 200 MB while the filter runs


@dataclass(frozen=True)
class FilterSummary:
    """Counts over the putative matches of a file."""

    num_pairs: int = 0
    num_matches: int = 0
    num_kept: int = 0
    num_rejected: int = 0
    num_untested: int = 0
    num_agreeing: int = 0  # whose neighbours in one view contain those in the other
    num_rectified: int = 0  # pairs that the score took for rectified; 0 where it does not ask
    num_improved: int = 0  # kept after repair and refinement; 0 without
    num_refined: int = 0  # of these, given ones that have moved
    num_repaired: int = 0  # of these, such with another partner, or of keypoints that had none

    def add(self, num_pairs: int, verdicts: Verdicts, improved: Improved | None = None) -> FilterSummary:
        """The counts with those of ``num_pairs`` more pairs."""
        num_matches, num_kept = len(verdicts.inlier), int(verdicts.inlier.sum())
        num_untested = int((verdicts.relation == Relation.UNTESTED).sum())
        num_agreeing = int(((verdicts.relation > 0) & (verdicts.relation < Relation.CONFLICT)).sum())
        num_rejected = num_matches - num_kept - num_untested
        summary = self + FilterSummary(num_pairs, num_matches, num_kept, num_rejected, num_untested, num_agreeing)
        if improved is None:
            return summary
        origins = improved.origin[improved.inlier]
        refined, repaired = (int((origins == int(origin)).sum()) for origin in (Origin.REFINED, Origin.REPAIRED))
        return summary + FilterSummary(num_improved=len(origins), num_refined=refined, num_repaired=repaired)

    def __add__(self, other: FilterSummary) -> FilterSummary:
        return FilterSummary(*(mine + more for mine, more in zip(astuple(self), astuple(other), strict=True)))


class RectifiedCount:
    """A filter that counts the pairs that it takes for rectified.

    >>> from tensor_stereo import DelaunayFilter
    >>> left = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) * 100
    >>> count = RectifiedCount(DelaunayFilter(rectified="auto"))
    >>> _ = count(Matches(left, left - torch.tensor([2.0, 0.0]), torch.tensor([0, 50])))
    >>> count.num_rectified
    1
    """

    def __init__(self, run: MatchFilter) -> None:
        self.num_rectified = 0
        self._run = run

    def __call__(self, matches: Matches) -> FilterOutput:
        output = self._run(matches)
        if output.alignment is not None:
            self.num_rectified += int(output.alignment.rectified.sum())
        return output


class Verdicts(NamedTuple):
    """Verdict on every match."""

    inlier: Bool  # (M,)
    score: Float | None  # (M,) in [0, 1], higher is better, 0 for untested matches; None if the settings ask for none
    relation: Int8  # (M,) values of Relation

    def spread(self, mask: Bool) -> Verdicts:
        """The same at the M True places of ``mask``, in its shape; no inlier, 0 and UNTESTED elsewhere."""
        return self._map(lambda values: _spread(values, mask))

    def take(self, rows: Int) -> Verdicts:
        """The verdicts of ``rows``, in their order."""
        return self._map(lambda values: values[rows])

    def reshape(self, shape: tuple[int, ...]) -> Verdicts:
        """The same in another shape."""
        return self._map(lambda values: values.reshape(shape))

    def _map(self, change: Callable[[Array], Array]) -> Verdicts:
        return Verdicts(*(None if values is None else change(values) for values in self))  # type: ignore[arg-type]


class Improved(NamedTuple):
    """The matches of one or several pairs after repair and refinement, first those given, in their order.

    Attributes:
        keypoints0: (K, 2) px.
        keypoints1: (K, 2) px.
        rows: (K,) row of the given match, -1 for a keypoint that had no partner.
        origin: (K,) values of :class:`tensor_stereo.scores.Origin`.
        inlier: (K,) the verdict on the match as it is now.
        score: (K,) None if the settings ask for none.
        relation: (K,) values of Relation.
    """

    keypoints0: Float
    keypoints1: Float
    rows: Int
    origin: Int8
    inlier: Bool
    score: Float | None
    relation: Int8

    def take(self, rows: Int) -> Improved:
        """Some of them, in the order of ``rows``."""
        return Improved(*(None if values is None else values[rows] for values in self))  # type: ignore[arg-type]


Arrays = TypeVar("Arrays", Verdicts, Improved)


def concatenate(kind: type[Arrays], parts: Sequence[Arrays]) -> Arrays:
    """One after the other; what the first part lacks the whole lacks."""
    columns = zip(*parts, strict=True)
    return kind(*(None if values[0] is None else np.concatenate(values) for values in columns))  # type: ignore[arg-type]


def to_verdicts(output: FilterOutput) -> Verdicts:
    """The verdicts of a filter as arrays."""
    score = None if output.score is None else output.score.detach().double().numpy()
    return Verdicts(output.inlier.numpy(), score, output.relation.numpy())


def to_improved(output: FilterOutput) -> Improved:
    """What the filter said of repaired or refined matches, as arrays."""
    count = output.matches.num_matches
    left, right = (
        points.detach().double().numpy() for points in (output.matches.keypoints0, output.matches.keypoints1)
    )
    rows = np.arange(count) if output.rows is None else output.rows.numpy()
    origin = np.zeros(count, np.int8) if output.origin is None else output.origin.numpy()
    inlier, score, relation = to_verdicts(output)
    return Improved(left, right, rows, origin, inlier, score, relation)


def _spread(values: Array, mask: Bool) -> Array:
    wide = np.zeros(mask.shape, values.dtype)
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
        parts.append(to_verdicts(run(select_pairs(matches, start, stop))))
        start = stop
    return concatenate(Verdicts, parts)


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
