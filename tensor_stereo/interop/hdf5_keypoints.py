"""HDF5 files of keypoints, hloc's and DISK's, with those that improved matches need behind the others."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from tensor_stereo.interop.added_keypoints import Added, AddedKeypoints, extend_rows
from tensor_stereo.interop.hdf5 import Copy, has, open_file, reading
from tensor_stereo.interop.verdicts import Array


def append_keypoints(source: Path, target: Path, added: AddedKeypoints[str]) -> None:
    """Copy a file of keypoints and add more to some images.

    In a group of hloc every other dataset with as many rows, or columns as its descriptors, grows by the values of the
    keypoints that the new ones were matched with.

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


def _append(source: Path, file: Any, path: str, parts: list[Added[str]]) -> None:
    points = file[path][()]
    folder, _, name = path.rpartition("/")
    if name == "keypoints" and folder:  # a group of hloc
        for other in [one for one in file[folder] if one != name and has(source, file[folder], one)]:
            _extend_like(file, f"{folder}/{other}", len(points), parts)
    _replace(file, path, extend_rows(points, np.concatenate([part.points for part in parts])))


def _extend_like(file: Any, path: str, count: int, parts: list[Added[str]]) -> None:
    """Extend what has a value for each of ``count`` keypoints."""
    shape = getattr(file[path], "shape", None)
    if not shape or count not in shape:
        return
    axis = len(shape) - 1 if shape[-1] == count else 0  # hloc's descriptors are (D, N)
    if shape[axis] != count:
        return
    values = np.moveaxis(file[path][()], axis, 0)
    name = path.rpartition("/")[2]
    more = [_take(file, f"{part.partner.rpartition('/')[0]}/{name}", axis, part.rows, values) for part in parts]
    _replace(file, path, np.moveaxis(np.concatenate([values, *more]), 0, axis))


def _take(file: Any, path: str, axis: int, rows: Array, like: Array) -> Array:
    """The values of the partners; zeros where there are none of this form."""
    values = np.moveaxis(file[path][()], axis, 0) if path in file and file[path].ndim == like.ndim else like[:0]
    if values.shape[1:] != like.shape[1:] or len(values) <= rows.max(initial=-1):
        return np.zeros((len(rows), *like.shape[1:]), like.dtype)
    return values[rows].astype(like.dtype)


def _replace(file: Any, path: str, values: Array) -> None:
    attributes = dict(file[path].attrs)
    del file[path]
    file.create_dataset(path, data=values).attrs.update(attributes)
