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

from tensor_stereo.interop.image_filter import ImageFilter, PairImages, filter_pairs
from tensor_stereo.interop.image_folder import ImageFolder
from tensor_stereo.interop.index_arrays import one_pair
from tensor_stereo.interop.npz_forms import IMPROVED, Header, ReadPairs, find_form, form_matches
from tensor_stereo.interop.result_names import earlier_results, free_name, later_results, name_results
from tensor_stereo.interop.verdicts import Array, FilterSummary, MatchFilter
from tensor_stereo.limits import MAX_ROWS

_HEADER_BYTES = 10_000  # what NumPy itself accepts of a header, by default
_MAX_RATIO = 1032  # of deflate, by its format
_IMAGES = ("image0", "image1")


def filter_npz(source: Path, target: Path, run: MatchFilter, *, score_name: str | None = None) -> FilterSummary:
    """Copy an archive and add ``inlier`` bool, ``relation`` int8 and, if the settings name one, ``score`` float64.

    The forms that are read are those of :mod:`tensor_stereo.interop.npz_forms`. The results have a value for each row
    of the matches, or for each entry of the index array, where they are False, 0 and UNTESTED if there is no match. All
    other arrays are carried through as they are. Names of results that the archive uses for something else are chosen
    as in :func:`~tensor_stereo.interop.result_names.name_results`.

    A filter that looks at the images finds their names in the arrays ``image0`` and ``image1``, a text each or one for
    every pair, or in a file name as SuperGlue's ``match_pairs.py`` chooses it, ``left_right_matches.npz``. If it
    repairs or refines, arrays with a row per match follow, first those given, whatever the form:
    ``improved_keypoints0``, ``improved_keypoints1``, ``improved_inlier``, ``improved_score``, ``improved_relation``,
    ``improved_origin``, values of :class:`tensor_stereo.scores.Origin`, and ``improved_rows``, the row of the match in
    the archive, or its place in the index array counted along the rows, and -1 for keypoints that had no partner.

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
            images = []
            if isinstance(run, ImageFilter):
                named = {name: read(name) for name in _IMAGES if name in members}
                images = _images(source, named, read_pairs, arrays[form.points0], run.images)
            verdicts, improved = filter_pairs(read_pairs.matches, images, run)
            kind = members[form.points0][0].compress_type
            results: dict[str, Array | None] = dict(zip(names, read_pairs.lay_out(verdicts), strict=True))
            if improved is not None:
                improved = improved._replace(rows=read_pairs.rows_of(improved.rows))
                free = (free_name(name, {*(members.keys() - ours), *names}) for name in IMPROVED)
                results |= dict(zip(free, improved, strict=True))
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
    return FilterSummary().add(read_pairs.matches.num_pairs, verdicts, improved)


def _images(
    source: Path, named: Mapping[str, Array], pairs: ReadPairs, keypoints0: Array, folder: ImageFolder
) -> list[PairImages]:
    """The images of each pair, by arrays or by the name of the file."""
    count = pairs.matches.num_pairs
    points = None if pairs.indices is None else one_pair(str(source), "keypoints0", keypoints0, 2)
    if len(named) == len(_IMAGES):
        names: list[list[str]] = []
        for name, array in named.items():
            texts = array.reshape(-1)
            if array.dtype.kind != "U" or len(texts) != count:
                given = f"{array.shape} {array.dtype}"
                raise ValueError(f"{source}, array {name!r} must hold a text for each of {count} pairs, got {given}")
            names.append(texts.tolist())
        return [PairImages(name0, name1, points) for name0, name1 in zip(*names, strict=True)]
    stem = source.stem.removesuffix("_matches")
    cuts = [k for k, letter in enumerate(stem) if letter == "_"] if stem != source.stem else []
    found = [(folder.find(stem[:k]), folder.find(stem[k + 1 :])) for k in cuts]
    known = [PairImages(name0, name1, points) for name0, name1 in found if name0 is not None and name1 is not None]
    if len(known) != 1 or count != 1:
        raise ValueError(
            f"{source} must name its images in the arrays 'image0' and 'image1', or be called 'left_right_matches.npz' "
            f"after two of {folder.root}"
        )
    return known


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
            return {name for name in (*names, *later_results(list(members), names.relation, IMPROVED)) if name}
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
