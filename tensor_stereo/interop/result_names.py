"""Names of the results in a file that may have columns of these names already. Imports no torch."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from itertools import count
from typing import NamedTuple

_INLIER, _RELATION = (re.compile(rf"(filter_)?{name}(_\d+)?") for name in ("inlier", "relation"))


class ResultNames(NamedTuple):
    """What the results of a filter are called in one file."""

    inlier: str = "inlier"
    score: str = "score"
    relation: str = "relation"


def earlier_results(names: Sequence[str]) -> Iterator[ResultNames]:
    """Where results of an earlier filter may stand: it writes inlier, score and relation one after the other.

    Args:
        names: Of the columns or arrays of a file, in their order.

    Yields:
        Names whose values can be results; ``score`` is empty where there was none.

    >>> list(earlier_results(["x0", "score", "inlier", "filter_score", "relation"]))
    [ResultNames(inlier='inlier', score='filter_score', relation='relation')]
    """
    for k, name in enumerate(names):
        for length in (1, 2):
            if k + length < len(names) and _INLIER.fullmatch(name) and _RELATION.fullmatch(names[k + length]):
                yield ResultNames(name, names[k + 1] if length == 2 else "", names[k + length])


def later_results(names: Sequence[str], relation: str, improved: Sequence[str]) -> list[str]:
    """The names of improved matches, or those chosen in their place, that stand right behind ``relation``.

    A filter writes them all, but for a score where there is none, one after the other; less is not its work.

    >>> later_results(["x0", "relation", "improved_x1", "origin", "z"], "relation", ["improved_x1", "origin"])
    ['improved_x1', 'origin']
    >>> later_results(["x0", "relation", "origin"], "relation", ["improved_x1", "origin"])
    []
    """
    behind = names[names.index(relation) + 1 :]
    for ours in (improved, [name for name in improved if not name.endswith("score")]):
        own = behind[: len(ours)]
        if len(own) == len(ours) and all(
            re.fullmatch(rf"(filter_)?{one}(_\d+)?", name) for one, name in zip(ours, own, strict=True)
        ):
            return list(own)
    return []


def free_name(name: str, taken: Collection[str]) -> str:
    """The name, or another one like it that is not taken.

    >>> free_name("score", ["score"])
    'filter_score'
    """
    return next(other for other in _candidates(name) if other not in taken)


def name_results(place: str, taken: Collection[str], score_name: str | None = None) -> ResultNames:
    """Choose names that leave every column or array of the user's alone.

    The names are ``inlier``, ``score`` and ``relation``. Where the file has something of such a name, the result is
    called ``filter_inlier``, ``filter_score`` or ``filter_relation``, with a number if that is taken too.

    Args:
        place: File, for errors.
        taken: Names in the file, without those of an earlier filter, which are replaced.
        score_name: Name of the score that the user asks for.

    Raises:
        ValueError: If the file has something of the name ``score_name``.

    >>> name_results("a.csv", ["x0", "score"])
    ResultNames(inlier='inlier', score='filter_score', relation='relation')
    """
    if score_name in taken:
        raise ValueError(f"score_name must be a new name in {place}, which has {score_name!r}")
    chosen = [free_name(name, taken) for name in ResultNames()]
    if score_name is not None:
        chosen[1] = score_name
    return ResultNames(*chosen)


def _candidates(name: str) -> Iterator[str]:
    yield name
    yield f"filter_{name}"
    yield from (f"filter_{name}_{number}" for number in count(2))


def check_score_name(score_name: str | None) -> None:
    """Raise unless a name of the score can be one of a column.

    Raises:
        ValueError: If it is empty, or would be taken for the name of another result.

    >>> check_score_name("confidence")
    """
    if score_name is None:
        return
    if not score_name.strip() or _INLIER.fullmatch(score_name) or _RELATION.fullmatch(score_name):
        raise ValueError(f"score_name must be the name of a column besides inlier and relation, got {score_name!r}")
