"""NumPy archives of matches: read without trust, and written again with the verdicts."""

from __future__ import annotations

import io
import math
import shutil
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tokenize import TokenError

import numpy as np

from tensor_stereo.interop.npz_forms import Header, find_form, form_matches
from tensor_stereo.interop.result_names import earlier_results, name_results
from tensor_stereo.interop.verdicts import Array, FilterSummary, MatchFilter, filter_matches
from tensor_stereo.limits import MAX_ROWS

_HEADER_BYTES = 10_000  # what NumPy itself accepts of a header, by default
_MAX_RATIO = 1032  # of deflate, by its format


def filter_npz(source: Path, target: Path, run: MatchFilter, *, score_name: str | None = None) -> FilterSummary:
    """Copy an archive and add ``inlier`` bool, ``relation`` int8 and, if the settings name one, ``score`` float64.

    The forms that are read are those of :mod:`tensor_stereo.interop.npz_forms`. The results have a value for each row
    of the matches, or for each entry of the index array, where they are False, 0 and UNTESTED if there is no match. All
    other arrays are carried through as they are. Names of results that the archive uses for something else are chosen
    as in :func:`~tensor_stereo.interop.result_names.name_results`.

    Nothing is unpickled, and no array is allocated before the shape and dtype of its header fit the member's size.

    Raises:
        ValueError: if the archive is damaged or an array is wrong; the message names file and array, and pair and row.
    """
    try:
        with zipfile.ZipFile(source) as archive, _headers_of_python_2():
            members = _check_members(source, archive)
            form = find_form(str(source), {name: header for name, (_, header) in members.items()})

            def read(name: str) -> Array:
                return _read_array(source, archive, members[name][0])

            arrays = {name: read(name) for name in form.arrays}
            ours = _earlier(members)
            names = name_results(str(source), members.keys() - ours, score_name)
            read_pairs = form_matches(str(source), form, arrays)
            verdicts = filter_matches(read_pairs.matches, run)
            kind = members[form.points0][0].compress_type
            results = dict(zip(names, read_pairs.lay_out(verdicts), strict=True))
            with zipfile.ZipFile(target, "w", kind) as result:
                for name, (info, _) in members.items():
                    if name not in ours:
                        _copy_member(archive, info, result)
                for name, values in results.items():
                    if values is not None:
                        with result.open(f"{name}.npy", "w", force_zip64=True) as file:
                            np.lib.format.write_array(file, values, allow_pickle=False)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError) as error:
        raise ValueError(f"{source} is no readable archive: {error}") from error
    return FilterSummary().add(read_pairs.matches.num_pairs, verdicts)


@contextmanager
def _headers_of_python_2() -> Iterator[None]:
    """Read what Python 2 has written without NumPy's advice to write it again."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Reading `.npy` or `.npz` file required", UserWarning)
        yield


def _earlier(members: Mapping[str, tuple[zipfile.ZipInfo, Header]]) -> set[str]:
    """The arrays that an earlier filter wrote."""
    for names in earlier_results(list(members)):
        inlier, relation = (members[name][1] for name in (names.inlier, names.relation))
        if inlier.dtype == np.bool_ and relation == (inlier.shape, np.dtype(np.int8)):
            return {name for name in names if name}
    return set()


def _check_members(source: Path, archive: zipfile.ZipFile) -> dict[str, tuple[zipfile.ZipInfo, Header]]:
    """The members by name of their array; raises unless all hold plain arrays of the size that they claim."""
    members: dict[str, tuple[zipfile.ZipInfo, Header]] = {}
    num_bytes_left = source.stat().st_size  # members must not overlap
    for info in archive.infolist():
        name = info.filename.removesuffix(".npy")
        if name == info.filename or "/" in name or "\\" in name:
            raise ValueError(f"{source}: every member must be named like 'keypoints0.npy', got {info.filename!r}")
        if name in members:
            raise ValueError(f"{source} holds the array {name!r} twice")
        place = f"{source}, array {name!r}"
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.flag_bits & 1:
            raise ValueError(f"{place} must be stored or deflated without a password, as NumPy writes it")
        num_bytes_left -= info.compress_size
        if info.header_offset < 0 or num_bytes_left < 0 or info.file_size > _MAX_RATIO * info.compress_size:
            raise ValueError(f"{place} claims {info.file_size} bytes, which the archive cannot hold")
        shape, dtype, header_bytes = _read_header(place, archive, info)
        if dtype.hasobject:  # of a size that only unpickling would tell; it is copied as it is, if nobody reads it
            members[name] = info, Header(shape, dtype)
            continue
        num_bytes = math.prod(shape) * dtype.itemsize
        if header_bytes + num_bytes != info.file_size:
            held = f"holds {info.file_size - header_bytes}"
            raise ValueError(f"{place} claims {num_bytes} bytes as {shape} {dtype}, but the member {held}")
        members[name] = info, Header(shape, dtype)
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
    except (ValueError, TypeError, SyntaxError, TokenError, RecursionError, MemoryError) as error:
        raise ValueError(f"{place} has no readable header: {error}") from error
    return shape, dtype, head.tell()


def _read_array(source: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Array:
    """One array whose header and size were checked."""
    place = f"{source}, array {info.filename.removesuffix('.npy')!r}"
    shape, dtype, _ = _read_header(place, archive, info)
    if dtype.hasobject:
        raise ValueError(f"{place} holds Python objects, which are not loaded; save it with a plain dtype")
    if max(shape, default=0) > MAX_ROWS:
        raise ValueError(f"{place} must have at most {MAX_ROWS} rows, got {max(shape)}")
    with archive.open(info) as member:
        array: Array = np.lib.format.read_array(member, allow_pickle=False)
    return array


def _copy_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, result: zipfile.ZipFile) -> None:
    """Copy one member through a small buffer."""
    copy = zipfile.ZipInfo(info.filename, info.date_time)
    copy.compress_type, copy.file_size = info.compress_type, info.file_size
    with archive.open(info) as read, result.open(copy, "w") as write:
        shutil.copyfileobj(read, write)
