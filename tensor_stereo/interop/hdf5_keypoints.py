"""HDF5 files of keypoints, hloc's and DISK's, with those that improved matches need behind the others."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from tensor_stereo.interop.added_keypoints import Added, AddedKeypoints, extend_rows
from tensor_stereo.interop.hdf5 import Copy, has, open_file, read_numbers, reading
from tensor_stereo.interop.verdicts import Array


def append_keypoints(source: Path, target: Path, added: AddedKeypoints[str]) -> None:
    """Copy a file of keypoints and add more to some images.

    In a group of hloc its descriptors, scores, scales and orientations grow by the values of the keypoints that the new
    ones were matched with. DISK keeps descriptors and scores in files of their own, which stay as they are.

    Args:
        source: The file.
        target: The copy.
        added: Keypoints by the path of their image's dataset.

    Raises:
        ValueError: if the file is damaged.
        OSError: if the copy cannot be written.
    """
    shutil.copyfile(source, target)
    with Copy(target, "r+b") as copy:
        with open_file(source, copy) as file:
            for path, parts in added:
                with reading(source):
                    _append(source, file, path, parts)
                copy.check(source)
        copy.check(source)


# What extractors of hloc store of a keypoint, and the axis of the keypoints.
_OF_KEYPOINTS = {"descriptors": 1, "scores": 0, "keypoint_scores": 0, "scales": 0, "oris": 0, "orientations": 0}


def _append(source: Path, file: Any, path: str, parts: list[Added[str]]) -> None:
    points = file[path][()]  # which was checked when it was read
    folder, _, name = path.rpartition("/")
    if name == "keypoints" and folder:  # a group of hloc
        for other, axis in _OF_KEYPOINTS.items():
            if has(source, file[folder], other):
                _extend_like(source, file, f"{folder}/{other}", axis, len(points), parts)
    _replace(file, path, extend_rows(points, np.concatenate([part.points for part in parts])))


def _extend_like(source: Path, file: Any, path: str, axis: int, count: int, parts: list[Added[str]]) -> None:
    """Extend what has a value for each of ``count`` keypoints."""
    values = _read(source, file, path)
    if values.ndim <= axis or values.shape[axis] != count:
        return
    values, name = np.moveaxis(values, axis, 0), path.rpartition("/")[2]
    more = [_take(source, file, f"{part.partner.rpartition('/')[0]}/{name}", axis, part.rows, values) for part in parts]
    _replace(file, path, np.moveaxis(np.concatenate([values, *more]), 0, axis))


def _take(source: Path, file: Any, path: str, axis: int, rows: Array, like: Array) -> Array:
    """The values of the partners; zeros where there are none of this form."""
    folder, _, name = path.rpartition("/")
    values = like[:0]
    if has(source, file[folder], name) and file[path].ndim == like.ndim:
        values = np.moveaxis(_read(source, file, path), axis, 0)
    if values.shape[1:] != like.shape[1:] or len(values) <= rows.max(initial=-1):
        return np.zeros((len(rows), *like.shape[1:]), like.dtype)
    return values[rows].astype(like.dtype)


def _read(source: Path, file: Any, path: str) -> Array:
    """A dataset of plain numbers with its data in the file, of a size that was checked."""
    folder, _, name = path.rpartition("/")
    return read_numbers(f"{source}, {folder!r}", file[folder], name)


def _replace(file: Any, path: str, values: Array) -> None:
    attributes = dict(file[path].attrs)
    del file[path]
    file.create_dataset(path, data=values).attrs.update(attributes)
