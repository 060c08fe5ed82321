"""NumPy archives of matches: rows of both views, or keypoints with the index of each one's partner."""

from __future__ import annotations

import io
import math
import shutil
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from tensor_stereo.interop.verdicts import (
    MAX_ROWS,
    Array,
    FilterSummary,
    MatchFilter,
    Verdicts,
    filter_matches,
    pick_matches,
)
from tensor_stereo.ops.segments import check_range
from tensor_stereo.types import Matches

_HEADER_BYTES = 10_000  # what NumPy itself accepts of a header, by default
_MAX_RATIO = 1032  # of deflate, by its format
# Name of an array -> kinds of its dtype and number of its axes.
_NUMBERS = "fiu"
_INTEGERS = "iu"
_RAGGED = {
    "keypoints0": (_NUMBERS, 2),
    "keypoints1": (_NUMBERS, 2),
    "ptr": (_INTEGERS, 1),
    "cost": (_NUMBERS, 1),
    "group": (_INTEGERS, 1),
}
_INDEXED = {
    "keypoints0": (_NUMBERS, 2),
    "keypoints1": (_NUMBERS, 2),
    "matches0": (_INTEGERS, 1),
    "matching_scores0": (_NUMBERS, 1),
}


def filter_npz(source: Path, target: Path, run: MatchFilter) -> FilterSummary:
    """Copy an archive and add ``inlier`` bool, ``relation`` int8 and, if the settings name one, ``score`` float64.

    Two forms are read. Rows, the form of :class:`~tensor_stereo.Matches`: ``keypoints0`` and ``keypoints1`` (M, 2), and
    optionally ``ptr`` (B + 1,), ``cost`` (M,) and ``group`` (M,); the results are (M,). One pair, as LightGlue and
    glue-factory have it: ``keypoints0`` (N0, 2), ``keypoints1`` (N1, 2), ``matches0`` (N0,) with -1 and -2, and
    optionally ``matching_scores0`` (N0,), higher is better; the results are (N0,), and False, 0 and UNTESTED where
    there is no match. All other arrays are carried through as they are.

    Nothing is unpickled, and no array is allocated before the shape and dtype of its header fit the member's size.

    Raises:
        ValueError: if the archive is damaged or an array is wrong; the message names file and array, and pair and row.
    """
    try:
        with zipfile.ZipFile(source) as archive:
            members = _check_members(source, archive)
            arrays = {
                name: _read_array(source, archive, members[name], *form)
                for name, form in _form(source, members).items()
                if name in members
            }
            verdicts, num_pairs = _filter_arrays(source, arrays, run)
            kind = members["keypoints0"].compress_type
            with zipfile.ZipFile(target, "w", kind) as result:
                for name, info in members.items():
                    if name not in Verdicts._fields or (name == "score" and verdicts.score is None):
                        _copy_member(archive, info, result)
                for name, values in _to_rows(arrays, verdicts)._asdict().items():
                    if values is None:
                        continue
                    with result.open(f"{name}.npy", "w", force_zip64=True) as file:
                        np.lib.format.write_array(file, values, allow_pickle=False)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError) as error:
        raise ValueError(f"{source} is no readable archive: {error}") from error
    return FilterSummary().add(num_pairs, verdicts)


def holds_indices(source: Path) -> bool:
    """Whether an archive names partners by ``matches0``, as LightGlue and glue-factory do; False if it is damaged."""
    try:
        with zipfile.ZipFile(source) as archive:
            return "matches0.npy" in archive.namelist()
    except (zipfile.BadZipFile, EOFError, NotImplementedError):
        return False


def _check_members(source: Path, archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """The members by name of their array; raises unless all hold plain arrays of the size that they claim."""
    members: dict[str, zipfile.ZipInfo] = {}
    num_bytes_left = source.stat().st_size  # members must not overlap
    for info in archive.infolist():
        name = info.filename.removesuffix(".npy")
        if name == info.filename or "/" in name or "\\" in name:
            raise ValueError(f"{source}: every member must be named like 'keypoints0.npy', got {info.filename!r}")
        if name in members:
            raise ValueError(f"{source} holds the array {name!r} twice")
        members[name] = info
        place = f"{source}, array {name!r}"
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.flag_bits & 1:
            raise ValueError(f"{place} must be stored or deflated without a password, as NumPy writes it")
        num_bytes_left -= info.compress_size
        if info.header_offset < 0 or num_bytes_left < 0 or info.file_size > _MAX_RATIO * info.compress_size:
            raise ValueError(f"{place} claims {info.file_size} bytes, which the archive cannot hold")
        shape, dtype, header_bytes = _read_header(place, archive, info)
        if dtype.hasobject:
            raise ValueError(f"{place} holds Python objects, which are not loaded; save it with a plain dtype")
        num_bytes = math.prod(shape) * dtype.itemsize
        if header_bytes + num_bytes != info.file_size:
            held = f"holds {info.file_size - header_bytes}"
            raise ValueError(f"{place} claims {num_bytes} bytes as {shape} {dtype}, but the member {held}")
    return members


def _read_header(
    place: str, archive: zipfile.ZipFile, info: zipfile.ZipInfo
) -> tuple[tuple[int, ...], np.dtype[np.generic], int]:
    """Shape, dtype and the bytes before the data, from a bounded piece of the member."""
    with archive.open(info) as member:
        head = io.BytesIO(member.read(_HEADER_BYTES))
    try:
        version = np.lib.format.read_magic(head)
        if version == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(head)
        elif version == (2, 0):
            shape, _, dtype = np.lib.format.read_array_header_2_0(head)
        else:
            raise ValueError(f"its version must be 1.0 or 2.0, got {version}")
        if any(length < 0 for length in shape):
            raise ValueError(f"its shape must not be negative, got {shape}")
    except (ValueError, TypeError, SyntaxError) as error:
        raise ValueError(f"{place} has no readable header: {error}") from error
    return shape, dtype, head.tell()


def _form(source: Path, members: Mapping[str, object]) -> dict[str, tuple[str, int]]:
    """The arrays to read, from the names that are there."""
    is_indexed = "matches0" in members
    for name in ("keypoints0", "keypoints1"):
        if name not in members:
            raise ValueError(f"{source} must hold the array {name!r}, it has {sorted(members)}")
    if is_indexed:
        for name in ("ptr", "cost", "group"):
            if name in members:
                raise ValueError(f"{source} holds 'matches0' of one pair, so that {name!r} has no meaning")
    return _INDEXED if is_indexed else _RAGGED


def _read_array(source: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo, kinds: str, ndim: int) -> Array:
    """One array whose header and size were checked."""
    place = f"{source}, array {info.filename.removesuffix('.npy')!r}"
    shape, dtype, _ = _read_header(place, archive, info)
    if dtype.kind not in kinds:
        raise ValueError(f"{place} must hold {'integers' if kinds == _INTEGERS else 'numbers'}, got {dtype}")
    if len(shape) != ndim or (ndim == 2 and shape[1] != 2):
        raise ValueError(f"{place} must have shape {'(N, 2)' if ndim == 2 else '(N,)'}, got {shape}")
    if shape[0] > MAX_ROWS:
        raise ValueError(f"{place} must have at most {MAX_ROWS} rows, got {shape[0]}")
    with archive.open(info) as member:
        array: Array = np.lib.format.read_array(member, allow_pickle=False)
    return array


def _filter_arrays(source: Path, arrays: Mapping[str, Array], run: MatchFilter) -> tuple[Verdicts, int]:
    """Verdicts on the matches, and the number of pairs."""
    if "matches0" in arrays:
        scores = arrays.get("matching_scores0")
        if scores is not None and scores.shape != arrays["matches0"].shape:
            expected, given = arrays["matches0"].shape, scores.shape
            raise ValueError(f"{source}, array 'matching_scores0' must have shape {expected}, got {given}")
        views = arrays["keypoints0"], arrays["keypoints1"]
        matches = pick_matches(str(source), *views, arrays["matches0"], scores)
    else:
        matches = _ragged_matches(source, arrays)
    return filter_matches(matches, run), matches.num_pairs


def _ragged_matches(source: Path, arrays: Mapping[str, Array]) -> Matches:
    """The matches of the form with rows."""
    num_matches = len(arrays["keypoints0"])
    ptr, cost, group = (arrays.get(name) for name in ("ptr", "cost", "group"))
    ptr = np.array([0, num_matches]) if ptr is None else ptr.astype(np.int64)
    try:
        matches = Matches(
            torch.from_numpy(arrays["keypoints0"].astype(np.float64)),
            torch.from_numpy(arrays["keypoints1"].astype(np.float64)),
            torch.from_numpy(ptr),
            None if cost is None else torch.from_numpy(cost.astype(np.float64)),
            None if group is None else torch.from_numpy(group.astype(np.int64)),
        )
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error

    def describe(name: str, row: int) -> str:
        return f"{source}: {name}, row {row} (pair {np.searchsorted(ptr, row, side='right') - 1}),"

    check_range(matches.keypoints0.numpy(), lambda row: describe("keypoints0", row))
    check_range(matches.keypoints1.numpy(), lambda row: describe("keypoints1", row))
    if matches.cost is not None and bool(matches.cost.isnan().any()):
        raise ValueError(f"{describe('cost', int(matches.cost.isnan().int().argmax()))} must not be NaN")
    return matches


def _to_rows(arrays: Mapping[str, Array], verdicts: Verdicts) -> Verdicts:
    """The verdicts in the layout of the arrays."""
    return verdicts.spread(arrays["matches0"] >= 0) if "matches0" in arrays else verdicts


def _copy_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, result: zipfile.ZipFile) -> None:
    """Copy one member through a small buffer."""
    copy = zipfile.ZipInfo(info.filename, info.date_time)
    copy.compress_type, copy.file_size = info.compress_type, info.file_size
    with archive.open(info) as read, result.open(copy, "w") as write:
        shutil.copyfileobj(read, write)
