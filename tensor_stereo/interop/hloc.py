"""HDF5 files of hloc: for each pair of images, the partner of every keypoint of the first.

``matches0[i] = j`` says that keypoint i of the first image and keypoint j of the second are a match; -1 is none. The
keypoints are in a second file. hloc counts pixel centres as integers, as this library does; it adds the half pixel of
COLMAP only when it fills a database. Half precision, its default, holds whole pixels beyond 1024 and every second one
beyond 2048: keypoints that fall together are duplicates, which are not tested.

Source: hloc's ``extract_features.py``, ``match_features.py`` and ``utils/io.py``.
"""

from __future__ import annotations

import io
import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tensor_stereo.interop.verdicts import (
    MAX_ROWS,
    Array,
    FilterSummary,
    MatchFilter,
    Verdicts,
    filter_each,
    pick_matches,
)
from tensor_stereo.types import Matches


class _Pair(NamedTuple):
    group: str  # path in the file of matches
    image0: str  # path in the file of keypoints
    image1: str


def filter_hloc(source: Path, target: Path, run: MatchFilter, keypoints: Path) -> FilterSummary:
    """Copy a file of matches with what the filter rejects as -1 in ``matches0``.

    Read are the groups ``name0/name1`` and, as older versions of hloc wrote them, ``name0_name1``, in which ``/`` of
    the names is ``-``, with the datasets ``matches0``, at most (N0,) integers, and optionally ``matching_scores0`` of
    the same length, higher is better. Pairs may be stored in either order, and in both.

    Beside them each group gets ``putative_matches0``, which is ``matches0`` as it was, and of the same length
    ``inlier`` bool, ``score`` float32 and ``relation`` int8, False, 0 and UNTESTED where there is no match. Everything
    else is carried through. Links to other places or files are refused.

    Args:
        source: file of matches.
        target: the copy.
        run: the filter.
        keypoints: file of features: for every image a group by its name with the dataset ``keypoints`` (N, 2).

    Raises:
        ValueError: if a file is damaged or a dataset is wrong; the message names file, pair and row.
        OSError: if the copy cannot be written.
        ImportError: if h5py is not installed.
    """
    try:
        import h5py  # noqa: F401
    except ImportError as error:
        raise ImportError(f"h5py must be installed to read {source.name}") from error
    summary = FilterSummary()
    shutil.copyfile(source, target)
    with _open(source) as matches_file, _open(keypoints) as features, _Copy(target, "r+b") as copy:
        pairs = _find_pairs(source, matches_file, keypoints, _find_images(keypoints, features))
        matches = _read_pairs(source, matches_file, keypoints, features, pairs)
        with _open(source, copy) as result:
            for pair, verdicts in filter_each(matches, run):
                matches0 = matches_file[pair.group]["matches0"][()]
                with _reading(source):
                    _write_verdicts(result[pair.group], matches0, verdicts)
                copy.check(source)
                summary = summary.add(1, verdicts)
        copy.check(source)
    return summary


class _Copy(io.FileIO):
    """A file that keeps errors of writing to itself: after one, HDF5 crashes when it frees what it could not write."""

    error: OSError | None = None

    def write(self, data: Any, /) -> int:
        view = memoryview(data).cast("B")
        num_bytes = len(view)
        with self._noting():
            while view:
                view = view[super().write(view) :]
        return num_bytes

    def truncate(self, size: int | None = None, /) -> int:
        with self._noting():
            super().truncate(size)
        return 0 if size is None else size

    @contextmanager
    def _noting(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.error = self.error or error

    def check(self, source: Path) -> None:
        """Raise if something could not be written."""
        if self.error is not None:
            raise OSError(f"the copy of {source} cannot be written: {self.error}") from self.error


@contextmanager
def _open(path: Path, copy: _Copy | None = None) -> Iterator[Any]:
    """An HDF5 file for reading, or its copy for reading and writing."""
    import h5py

    with _reading(path):
        file = h5py.File(path, "r") if copy is None else h5py.File(copy, "r+")
    try:
        yield file
    finally:
        with _reading(path):
            file.close()


@contextmanager
def _reading(place: Path | str) -> Iterator[None]:
    """Name the place in whatever the library finds wrong with it."""
    try:
        yield
    except (OSError, RuntimeError, KeyError) as error:
        raise ValueError(f"{place} cannot be read: {error}") from error


def _find_images(keypoints: Path, features: Any) -> dict[str, list[str]]:
    """The images that have keypoints, by their name as the file of matches spells it."""
    import h5py

    images: dict[str, list[str]] = {}
    pending, seen = [""], set()
    with _reading(keypoints):
        while pending:
            path = pending.pop()
            group = features[f"/{path}"]
            address = h5py.h5o.get_info(group.id).addr
            if address in seen:
                raise ValueError(f"{keypoints}: group {path!r} is also known by another name")
            seen.add(address)
            if _has(keypoints, group, "keypoints") and isinstance(group["keypoints"], h5py.Dataset):
                images.setdefault(path.replace("/", "-"), []).append(path)
                continue
            folders = [name for name in group if _has(keypoints, group, name) and isinstance(group[name], h5py.Group)]
            pending += [f"{path}/{name}" if path else name for name in folders]
    return images


def _find_pairs(source: Path, matches_file: Any, keypoints: Path, images: dict[str, list[str]]) -> Iterator[_Pair]:
    """The pairs of the file of matches in both layouts."""
    import h5py

    with _reading(source):
        for name0 in matches_file:
            group = matches_file[name0] if _has(source, matches_file, name0) else None
            if not isinstance(group, h5py.Group):
                raise ValueError(f"{source}: {name0!r} must be a group of pairs, got a dataset")
            if _has(source, group, "matches0") and isinstance(group["matches0"], h5py.Dataset):
                cuts = (k for k, letter in enumerate(name0) if letter == "_")
                known = [(name0[:k], name0[k + 1 :]) for k in cuts if name0[:k] in images and name0[k + 1 :] in images]
                if len(known) != 1:
                    raise ValueError(
                        f"{source}: {name0!r} must join two images of {keypoints}, {len(known)} ways are known"
                    )
                yield _Pair(name0, *(_only(source, keypoints, name, images) for name in known[0]))
                continue
            for name1 in group:
                if not (_has(source, group, name1) and isinstance(group[name1], h5py.Group)):
                    raise ValueError(f"{source}: '{name0}/{name1}' must be a group with the dataset 'matches0'")
                yield _Pair(f"{name0}/{name1}", *(_only(source, keypoints, name, images) for name in (name0, name1)))


def _only(source: Path, keypoints: Path, name: str, images: dict[str, list[str]]) -> str:
    """The one image that a name of the file of matches can mean."""
    found = images.get(name, [])
    if len(found) != 1:
        raise ValueError(f"{source}: {name!r} must name one image of {keypoints}, got {found or 'none'}")
    return found[0]


def _read_pairs(
    source: Path, matches_file: Any, keypoints: Path, features: Any, pairs: Iterator[_Pair]
) -> Iterator[tuple[_Pair, Matches]]:
    for pair in pairs:
        place = f"{source}, pair '{pair.group}'"
        with _reading(place):
            group = matches_file[pair.group]
            matches0 = _read(place, group, "matches0", "iu", 1)
            has_scores = _has(place, group, "matching_scores0")
            scores = _read(place, group, "matching_scores0", "f", 1) if has_scores else None
        if scores is not None and len(scores) != len(matches0):
            raise ValueError(f"{place}: 'matching_scores0' must have {len(matches0)} rows, got {len(scores)}")
        points0, points1 = (_read_keypoints(keypoints, features, image) for image in (pair.image0, pair.image1))
        yield pair, pick_matches(place, points0, points1, matches0, scores)


def _read_keypoints(keypoints: Path, features: Any, image: str) -> Array:
    place = f"{keypoints}, image {image!r}"
    with _reading(place):
        return _read(place, features[image], "keypoints", "fiu", 2)


def _has(place: Path | str, group: Any, name: str | bytes) -> bool:
    """Whether a group has a member; raises where it is a link, before anything looks where that leads."""
    import h5py

    if not isinstance(name, str):  # what h5py makes of bytes that are no UTF-8
        raise ValueError(f"{place}: {group.name} has a member whose name is no text, {name!r}")
    links = group.id.links
    if not links.exists(name.encode()):
        return False
    if links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
        raise ValueError(f"{place}: {group.name.rstrip('/')}/{name} is a link, which is not followed")
    return True


def _read(place: str, group: Any, name: str, kinds: str, ndim: int) -> Array:
    """A dataset of plain numbers, after a look at its form, its size and where its data lies."""
    import h5py

    if not _has(place, group, name):
        raise ValueError(f"{place} has no dataset {name!r}")
    dataset = group[name]
    if not isinstance(dataset, h5py.Dataset) or dataset.is_virtual or dataset.external:
        raise ValueError(f"{place}: {name!r} must be a dataset with its data in this file")
    try:
        dtype = dataset.dtype
    except (ValueError, TypeError) as error:
        raise ValueError(f"{place}: the type of {name!r} is unknown: {error}") from error
    if dtype.kind not in kinds:
        raise ValueError(f"{place}: {name!r} must hold {'numbers' if 'f' in kinds else 'integers'}, got {dtype}")
    if dataset.ndim != ndim or dataset.shape is None or (ndim == 2 and dataset.shape[1] != 2):
        raise ValueError(f"{place}: {name!r} must have shape {'(N, 2)' if ndim == 2 else '(N,)'}, got {dataset.shape}")
    if max(dataset.shape[0], math.prod(dataset.chunks or ())) > MAX_ROWS:
        sizes = f"got {dataset.shape[0]} in chunks of {dataset.chunks}"
        raise ValueError(f"{place}: {name!r} must have at most {MAX_ROWS} rows, {sizes}")
    if dataset.size and not dataset.id.get_storage_size():
        raise ValueError(f"{place}: {name!r} claims {dataset.shape[0]} rows, but holds no data")
    array: Array = dataset[()]
    return array


def _write_verdicts(group: Any, matches0: Array, verdicts: Verdicts) -> None:
    wide = verdicts.spread(matches0 >= 0)
    score = None if wide.score is None else wide.score.astype(np.float32)
    results = {"putative_matches0": matches0, **wide._asdict(), "score": score}
    for name, values in results.items():
        if group.id.links.exists(name.encode()):  # of an earlier filter
            del group[name]
        if values is not None:
            group.create_dataset(name, data=values)
    group["matches0"][...] = np.where((matches0 < 0) | wide.inlier, matches0, -1)
