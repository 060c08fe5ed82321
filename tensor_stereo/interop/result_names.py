"""Names of the results in a file that may have columns of these names already. Imports no torch."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

RESULTS = ("inlier", "score", "relation")


class ResultNames(NamedTuple):
    """What the results of a filter are called in one file."""

    inlier: str = "inlier"
    score: str = "score"
    relation: str = "relation"


def name_results(
    place: str, taken: Collection[str], *, ours: Collection[str] = (), score_name: str | None = None
) -> ResultNames:
    """Choose names that leave every column or array of the user's alone.

    The names are ``inlier``, ``score`` and ``relation``. Where the file has something else of such a name, the result
    is called ``filter_inlier``, ``filter_score`` or ``filter_relation``.

    Args:
        place: File, for errors.
        taken: Names in the file.
        ours: Those of ``RESULTS`` in the file that an earlier filter wrote, so that they are replaced.
        score_name: Name of the score that the user asks for; it must be a new one, or one of ours.

    Raises:
        ValueError: If the file has something else of the name ``score_name``.

    >>> name_results("a.csv", ["x0", "score"])
    ResultNames(inlier='inlier', score='filter_score', relation='relation')
    """
    chosen = {}
    for name in RESULTS:
        other = f"filter_{name}"
        is_free = name not in taken or (name in ours and other not in taken)
        chosen[name] = name if is_free else other
    if score_name is not None:
        if score_name in taken and score_name not in (*ours, "filter_score"):
            raise ValueError(f"score_name must be a new name in {place}, which has {score_name!r}")
        chosen["score"] = score_name
    return ResultNames(**chosen)


def result_in(taken: Collection[str], name: str) -> str | None:
    """The name that a result of an earlier filter would have among the names of a file.

    >>> result_in(["inlier", "filter_inlier"], "inlier"), result_in(["inlier"], "inlier"), result_in([], "inlier")
    ('filter_inlier', 'inlier', None)
    """
    return next((other for other in (f"filter_{name}", name) if other in taken), None)


def check_score_name(score_name: str | None) -> None:
    """Raise unless a name of the score can be one of a column.

    Raises:
        ValueError: If it is empty or the name of another result.

    >>> check_score_name("confidence")
    """
    if score_name is not None and (not score_name.strip() or score_name in ("inlier", "relation")):
        raise ValueError(f"score_name must be the name of a column besides inlier and relation, got {score_name!r}")
