"""The forms in which matchers save matches as named arrays.

======================================================  ===============================================================
arrays                                                  written by
======================================================  ===============================================================
``keypoints0``, ``keypoints1`` (M, 2); ``ptr``,         this library, one or many pairs; without ``ptr`` one
``cost``, ``group``
``keypoints0``, ``keypoints1``, ``matches0`` (N0,)      LightGlue, glue-factory, SuperGlue (``match_pairs.py``)
or ``matches1`` (N1,)
the same with ``matches`` (N0,) or (S, 2)               older SuperGlue, LightGlue; ``matches01`` likewise
``mkpts0``, ``mkpts1`` (M, 2), or ``mkpts0_f``          LoFTR and the detector-free matchers after it, with ``mconf``
                                                        and ``m_bids`` or ``b_ids``
``keypoints0``, ``keypoints1``, ``batch_indexes``       kornia's ``LoFTR`` and ``LocalFeatureMatcher``, with
                                                        ``confidence``
======================================================  ===============================================================

Rows of both views are matches only where nothing says otherwise: an array of integers with an entry per keypoint or
two per match, or one whose name speaks of matches, is refused by name if it is none of these, unless ``ptr`` says that
rows are matches. Arrays may have a batch axis of one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from tensor_stereo.interop.index_arrays import INDEX_ARRAYS, Indices, index_matches, one_pair
from tensor_stereo.interop.result_names import earlier_results
from tensor_stereo.interop.verdicts import Array, Improved, Int, Verdicts
from tensor_stereo.ops.segments import check_range
from tensor_stereo.types import Matches

_POINTS = ("keypoints0", "keypoints1")
_ROWS = (_POINTS, ("mkpts0", "mkpts1"), ("mkpts0_f", "mkpts1_f"))
_COARSE = ("mkpts0_c", "mkpts1_c", "mkpts0_f", "mkpts1_f", "i_ids", "j_ids", "b_ids", "m_bids", "gt_mask")  # of LoFTR
_BATCH = ("batch_indexes", "m_bids", "b_ids")  # the pair of each row
_CONFIDENCE = ("confidence", "mconf")
_RAGGED = ("ptr", "cost", "group")  # of this library's own form
# Names of arrays that say which rows are matches, whatever they hold; but not how good a match is.
_SAYS_MATCH = re.compile(r"match|mkpt|kpts|idx|partner|mask|b_?ids", re.IGNORECASE)
_SAYS_QUALITY = re.compile(r"score|conf|prob|dist|sim|cost", re.IGNORECASE)


IMPROVED = tuple(f"improved_{name}" for name in Improved._fields)


class Header(NamedTuple):
    """What is known of an array before it is read."""

    shape: tuple[int, ...]
    dtype: np.dtype[np.generic]


@dataclass(frozen=True)
class Form:
    """How an archive gives its matches.

    Attributes:
        points0: Name of the keypoints of view 0.
        points1: Name of the keypoints of view 1.
        arrays: Names of all arrays that say something of the matches.
        has_indices: Whether index arrays name the partners; else rows are matches.
    """

    points0: str
    points1: str
    arrays: tuple[str, ...]
    has_indices: bool


@dataclass(frozen=True, eq=False)
class ReadPairs:
    """The matches of an archive, and where their verdicts go.

    Attributes:
        matches: All pairs.
        order: (M,) row of the archive of each match; None: the order is the same.
        shape: Of the results, where rows are matches.
        indices: Of the matches, where index arrays name them.
    """

    matches: Matches
    order: Int | None = None
    shape: tuple[int, ...] = ()
    indices: Indices | None = None

    def lay_out(self, verdicts: Verdicts) -> Verdicts:
        """The verdicts in the layout of the archive."""
        if self.indices is not None:
            return verdicts.spread(self.indices.mask)
        if self.order is not None:
            verdicts = verdicts.take(np.argsort(self.order, kind="stable"))
        return verdicts.reshape(self.shape)

    def rows_of(self, rows: Int) -> Int:
        """Where matches stand in the archive: their row, or their place in the index array; -1 stays."""
        places = self.order if self.indices is None else np.flatnonzero(self.indices.mask)
        return rows if places is None else np.where(rows < 0, -1, places[rows])


def find_form(place: str, headers: Mapping[str, Header]) -> Form:
    """Tell the form of an archive by the names of its arrays.

    Raises:
        ValueError: If keypoints are missing, or an array says that rows are no matches and is none that is read.

    >>> points = Header((4, 2), np.dtype(float))
    >>> form = find_form("m.npz", {"mkpts0": points, "mkpts1": points})
    >>> form.points0, form.has_indices
    ('mkpts0', False)
    """
    if any(name in headers for name in INDEX_ARRAYS):
        return _indexed_form(place, headers)
    has_plain = all(name in headers for name in _POINTS)
    has_matched = any(all(name in headers for name in names) for names in _ROWS[1:])
    views = next((names for names in reversed(_ROWS) if all(name in headers for name in names)), None)
    if views is None:
        missing = next(name for name in _POINTS if name not in headers)
        raise ValueError(f"{place} must hold the array {missing!r}, it has {sorted(headers)}")
    of_others = [name for name in (*_BATCH, *_CONFIDENCE) if name in headers]
    of_ours = [name for name in _RAGGED if name in headers]
    batch = next((name for name in _BATCH if name in headers), None)
    if batch is not None and "ptr" in headers:
        raise ValueError(f"{place} holds the pair of each row twice, as 'ptr' and as {batch!r}; leave one of them out")
    arrays = (*views, *of_ours, *of_others)
    if "ptr" not in headers:  # it says that rows are matches
        ours = {name for names in earlier_results(list(headers)) for name in (*names, *IMPROVED)}
        known = {*arrays, *ours, *(_POINTS if has_plain else ()), *(_COARSE if has_matched else ())}
        num_keypoints = {
            length for name in (*_POINTS, *views) if name in headers for length in headers[name].shape[:-1]
        }
        _refuse_unread(place, headers, known, tuple(num_keypoints - {1}))
    return Form(*views, arrays, has_indices=False)


def _indexed_form(place: str, headers: Mapping[str, Header]) -> Form:
    for name in _POINTS:
        if name not in headers:
            raise ValueError(f"{place} must hold the array {name!r}, it has {sorted(headers)}")
    indices = [name for name in INDEX_ARRAYS if name in headers]
    for name in _RAGGED:
        if name in headers:
            raise ValueError(f"{place} holds {indices[0]!r} of one pair, so that {name!r} has no meaning")
    scores = [name for index in indices[:1] for name in INDEX_ARRAYS[index] if name in headers]
    return Form(*_POINTS, (*_POINTS, *indices, *scores), has_indices=True)


def _refuse_unread(place: str, headers: Mapping[str, Header], known: set[str], num_keypoints: tuple[int, ...]) -> None:
    """Raise for an array that may say which rows are matches: by its name, or by integers per row or two per match."""
    for name, header in headers.items():
        shape = header.shape[1:] if header.shape[:1] == (1,) and len(header.shape) > 1 else header.shape
        is_index = (len(shape) == 1 and shape[0] in num_keypoints) or (len(shape) == 2 and 2 in shape)
        by_name = _SAYS_MATCH.search(name) and not _SAYS_QUALITY.search(name)
        is_points = "mkpt" in name.casefold() and "mkpts0" not in known and "mkpts0_f" not in known
        if name in known or not (is_points or (is_index and (by_name or header.dtype.kind in "iu"))):
            continue
        raise ValueError(
            f"{place} pairs the rows of its keypoints, but the array {name!r} may say otherwise. Read are "
            f"{', '.join((*INDEX_ARRAYS, *_BATCH))} and mkpts0 with mkpts1; rename or leave out the array, or add "
            "ptr = [0, M] to say that the rows are the M matches of one pair"
        )


def form_matches(place: str, form: Form, arrays: Mapping[str, Array]) -> ReadPairs:
    """The matches that arrays of a known form give.

    Raises:
        ValueError: If a shape, dtype or value is wrong; the message names array, pair and row.
    """
    for name, array in arrays.items():
        kinds = "iu" if name in ("ptr", "group", *_BATCH) else "fiu"
        if array.dtype.kind not in kinds:
            expected = "integers" if kinds == "iu" else "numbers"
            raise ValueError(f"{place}, array {name!r} must hold {expected}, got {array.dtype}")
    if form.has_indices:
        matches, indices = index_matches(place, arrays)
        return ReadPairs(matches, indices=indices)
    shape = arrays[form.points0].shape
    views = (form.points0, form.points1)
    flat = {name: one_pair(place, name, array, 2 if name in views else 1) for name, array in arrays.items()}
    num_matches = len(flat[form.points0])
    for name, values in flat.items():
        if name != "ptr" and len(values) != num_matches:
            raise ValueError(f"{place}: {name} must have {num_matches} rows as {form.points0} has, got {len(values)}")
    ptr, order = _pairs(flat, num_matches)
    cost = flat.get("cost")
    confidence = next((flat[name] for name in _CONFIDENCE if name in flat), None)
    if cost is None and confidence is not None:
        cost = 1 - confidence.astype(np.float64)
    columns = (flat[form.points0], flat[form.points1], cost, flat.get("group"))
    dtypes = (np.float64, np.float64, np.float64, np.int64)
    points0, points1, cost_, group = (
        None if values is None else torch.from_numpy((values if order is None else values[order]).astype(dtype))
        for values, dtype in zip(columns, dtypes, strict=True)
    )
    try:
        matches = Matches(points0, points1, torch.from_numpy(ptr), cost_, group)  # type: ignore[arg-type]
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error

    def describe(name: str, row: int) -> str:
        given = row if order is None else int(order[row])
        return f"{place}: {name}, row {given} (pair {np.searchsorted(ptr, row, side='right') - 1}),"

    check_range(matches.keypoints0.numpy(), lambda row: describe(form.points0, row))
    check_range(matches.keypoints1.numpy(), lambda row: describe(form.points1, row))
    if matches.cost is not None and bool(matches.cost.isnan().any()):
        name = next(name for name in ("cost", *_CONFIDENCE) if name in flat)
        raise ValueError(f"{describe(name, int(matches.cost.isnan().int().argmax()))} must not be NaN")
    return ReadPairs(matches, order, shape[:-1])


def _pairs(flat: Mapping[str, Array], num_matches: int) -> tuple[Int, Int | None]:
    """(B + 1,) offsets of the pairs, and the order of the rows that makes pairs whole."""
    batch = next((flat[name] for name in _BATCH if name in flat), None)
    if batch is None:
        ptr = flat.get("ptr")
        return np.array([0, num_matches]) if ptr is None else ptr.astype(np.int64), None
    if num_matches == 0:
        return np.array([0, 0]), None
    counts = np.unique(batch, return_counts=True)[1]
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), np.argsort(batch, kind="stable")
