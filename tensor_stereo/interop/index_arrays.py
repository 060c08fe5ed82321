"""Index arrays: which keypoint of one view matches which of the other, in the forms that matchers write."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tensor_stereo.interop.verdicts import Array, Bool, Float, Int, pair_matches
from tensor_stereo.types import Matches

# Name of an index array -> names of its confidences, higher is better. The first array that is there lays out the
# results; the others must name the same matches.
INDEX_ARRAYS: dict[str, tuple[str, ...]] = {
    "matches0": ("matching_scores0", "match_confidence0"),
    "matches": ("match_confidence", "scores", "confidence"),
    "matches01": ("match_confidence", "scores", "confidence"),
    "matches1": ("matching_scores1", "match_confidence1"),
}


class Indices(NamedTuple):
    """The matches of one pair, as rows of its keypoints.

    Attributes:
        rows0: (M,) rows of ``keypoints0``.
        rows1: (M,) rows of ``keypoints1``.
        mask: where the index array holds a match, in the shape of the results; M places are True.
    """

    rows0: Int
    rows1: Int
    mask: Bool

    def pairs(self) -> set[tuple[int, int]]:
        """The matches without their order."""
        return set(zip(self.rows0.tolist(), self.rows1.tolist(), strict=True))


def index_matches(place: str, arrays: Mapping[str, Array], *, may_be_short: bool = False) -> tuple[Matches, Indices]:
    """The matches of one pair that is given by keypoints and index arrays.

    Args:
        place: File and pair, for errors.
        arrays: ``keypoints0`` (N0, 2) and ``keypoints1`` (N1, 2) in px, and at least one of ``INDEX_ARRAYS``:
            ``matches0`` (N0,) and ``matches1`` (N1,), the row of the partner in the other view; ``matches`` and
            ``matches01``, the same as ``matches0`` or (S, 2) rows of both views. -1 is no match and -2 "ignore". Every
            array may have a batch axis of one in front. Confidences have a value for each entry of their index array.
        may_be_short: Whether the last keypoints may have no entry in an index array, as hloc leaves them out.

    Returns:
        The matches, with the cost 1 - confidence where there is one, and their indices.

    Raises:
        ValueError: If a shape or value is wrong, or two index arrays name different matches.

    >>> arrays = {"keypoints0": np.eye(2), "keypoints1": np.eye(2), "matches": np.array([[0, 1]])}
    >>> matches, indices = index_matches("m.npz", arrays)
    >>> matches.keypoints1.tolist(), indices.mask
    ([[0.0, 1.0]], array([ True]))
    """
    points0, points1 = (one_pair(place, name, arrays[name], 2) for name in ("keypoints0", "keypoints1"))
    is_batch = arrays["keypoints0"].ndim == 3
    found = {
        name: _read_indices(place, name, arrays[name], (len(points0), len(points1)), is_batch, may_be_short)
        for name in INDEX_ARRAYS
        if name in arrays
    }
    name, indices = next(iter(found.items()))
    for other, also in found.items():
        # a matcher that is not mutual may match a keypoint of view 1 twice, of which matches1 knows one
        if not (also.pairs() <= indices.pairs() if other == "matches1" else also.pairs() == indices.pairs()):
            raise ValueError(f"{place}: {name} and {other} must name the same matches; leave one of them out")
    cost = _cost(place, name, arrays, indices)
    return pair_matches(place, points0, points1, indices.rows0, indices.rows1, cost), indices


def one_pair(place: str, name: str, array: Array, ndim: int) -> Array:
    """An array without its batch axis of one.

    Raises:
        ValueError: if it has another number of axes, or not two coordinates where there are two.

    >>> one_pair("m.npz", "keypoints0", np.zeros((1, 5, 2)), 2).shape
    (5, 2)
    """
    array = array[0] if array.ndim == ndim + 1 and len(array) == 1 else array
    if array.ndim != ndim or (ndim == 2 and array.shape[1] != 2):
        expected = "(N, 2), or (1, N, 2)" if ndim == 2 else "(N,), or (1, N)"
        raise ValueError(f"{place}, array {name!r} must have shape {expected}, got {array.shape}")
    return array


def _read_indices(
    place: str, name: str, array: Array, num_keypoints: tuple[int, int], is_batch: bool, may_be_short: bool
) -> Indices:
    sizes = num_keypoints[::-1] if name == "matches1" else num_keypoints
    per_keypoint = name in ("matches0", "matches1")
    # (1, 2) is one match, or the partners of two keypoints with a batch axis of one
    is_one_match = array.shape[1:] == (2,) and not (is_batch and sizes[0] == 2)
    of_both = not per_keypoint and array.ndim >= 2 and (len(array) != 1 or array.ndim > 2 or is_one_match)
    values = _whole_numbers(place, name, array)
    if of_both:
        rows = one_pair(place, name, values, 2)
        for view, size in enumerate(num_keypoints):
            _check_rows(place, name, rows[:, view], size, f"keypoints{view}")
        mask: Bool = np.all(rows >= 0, axis=1)
        kept = rows[mask]
        return Indices(kept[:, 0], kept[:, 1], mask.reshape(array.shape[:-1]))
    partner = one_pair(place, name, values, 1)
    if len(partner) > sizes[0] or (len(partner) < sizes[0] and not may_be_short):
        view = int(name == "matches1")
        raise ValueError(f"{place}: {name} has {len(partner)} rows, but there are {sizes[0]} keypoints{view}")
    _check_rows(place, name, partner, sizes[1], "keypoints0" if name == "matches1" else "keypoints1")
    rows0 = np.flatnonzero(partner >= 0)
    rows1 = partner[rows0]
    if name == "matches1":
        rows0, rows1 = rows1, rows0
    return Indices(rows0, rows1, (partner >= 0).reshape(array.shape))


def _whole_numbers(place: str, name: str, array: Array) -> Int:
    """An index array as integers."""
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{place}, array {name!r} must hold integers, got {array.dtype}")
    wide = array.astype(np.float64)
    wrong = ~((wide == np.round(wide)) & (np.abs(wide) < 2**53))
    if wrong.any():
        given = array.reshape(-1)[int(wrong.reshape(-1).argmax())]
        raise ValueError(f"{place}, array {name!r} must hold integers, got {given}")
    return array.astype(np.int64)


def _check_rows(place: str, name: str, rows: Int, size: int, keypoints: str) -> None:
    wrong = (rows < -2) | (rows >= size)
    if wrong.any():
        row = int(wrong.argmax())
        raise ValueError(f"{place}: {name} must be -1, -2 or one of {size} {keypoints}, got {rows[row]} in row {row}")


def _cost(place: str, name: str, arrays: Mapping[str, Array], indices: Indices) -> Float | None:
    """1 - confidence of each match, by the first of the confidences that is there."""
    given = next((given for given in INDEX_ARRAYS[name] if given in arrays), None)
    if given is None:
        return None
    values = arrays[given]
    if values.dtype.kind not in "iuf":
        raise ValueError(f"{place}: {given} must hold numbers, got {values.dtype}")
    if values.size != indices.mask.size or values.ndim > 2:
        raise ValueError(
            f"{place}, array {given!r} must have shape {indices.mask.shape} as {name} has, got {values.shape}"
        )
    confidence = values.reshape(indices.mask.shape)[indices.mask].astype(np.float64)
    if np.isnan(confidence).any():
        row = int(np.flatnonzero(indices.mask)[int(np.isnan(confidence).argmax())])
        raise ValueError(f"{place}: {given} must not be NaN, got NaN in row {row}")
    return 1 - confidence
