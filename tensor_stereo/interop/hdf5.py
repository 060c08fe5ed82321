"""HDF5 files that are data only: no link is followed, no size is believed before it is checked. Imports no torch."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tensor_stereo.limits import MAX_ROWS

Array = NDArray[Any]
OF_PAIR = ("keypoints0", "keypoints1")


class Copy(io.FileIO):
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
def open_file(path: Path, copy: Copy | None = None) -> Iterator[Any]:
    """An HDF5 file for reading, or its copy for reading and writing.

    Raises:
        ValueError: if the file is damaged.
        ImportError: if h5py is not installed.
    """
    try:
        import h5py
    except ImportError as error:
        raise ImportError(f"h5py must be installed to read {path.name}") from error
    with reading(path):
        # HDF5 1.8 stores attributes of any size
        file = h5py.File(path, "r") if copy is None else h5py.File(copy, "r+", libver=("v108", "latest"))
    try:
        yield file
    finally:
        with reading(path):
            file.close()


@contextmanager
def reading(place: Path | str) -> Iterator[None]:
    """Name the place in whatever the library finds wrong with it."""
    try:
        yield
    except (OSError, RuntimeError, KeyError) as error:
        raise ValueError(f"{place} cannot be read: {error}") from error


def has(place: Path | str, group: Any, name: str | bytes) -> bool:
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


def member(place: Path | str, group: Any, name: str | bytes) -> Any:
    """A member of a group, or None; raises where it is a link."""
    return group[name] if has(place, group, name) else None


def is_exported(source: Path, group: Any) -> bool:
    """Whether a group is a pair with its keypoints, as glue-factory exports it.

    hloc's dense matchers leave keypoints in a group too, with ``scores``; but there ``matches0`` means keypoints of the
    file of features.
    """
    return all(has(source, group, name) for name in OF_PAIR) and not has(source, group, "scores")


def find_exported(source: Path, file: Any) -> list[str]:
    """The groups that hold a pair with its keypoints, as glue-factory exports them.

    Raises:
        ValueError: if another group or dataset is there, so that the keypoints of ``source`` are in another file.
    """
    import h5py

    found, pending = [], [""]
    with reading(source):
        while pending:
            path = pending.pop()
            group = file[f"/{path}"]
            if path and is_exported(source, group):
                found.append(path)
                continue
            for name in reversed(list(group)):
                inner = f"{path}/{name}" if path else name
                if not isinstance(member(source, group, name), h5py.Group):
                    raise ValueError(
                        f"keypoints must be given for files of hloc and DISK: {source} holds {inner!r} outside of any "
                        f"pair with {' and '.join(OF_PAIR)}"
                    )
                pending.append(inner)
    return found


def read(place: str, group: Any, name: str, kinds: str, ndim: int) -> Array:
    """A dataset (N,), (N, 2) or (2, N) of plain numbers, after a look at its form, its size and where its data lies."""
    dataset = _find(place, group, name)
    kind = _kind_of(place, dataset, name)
    if kind not in kinds:
        raise ValueError(
            f"{place}: {name!r} must hold {'numbers' if 'f' in kinds else 'integers'}, got {dataset.dtype}"
        )
    shape = dataset.shape
    if shape is None or len(shape) != ndim or (ndim == 2 and 2 not in shape):
        raise ValueError(f"{place}: {name!r} must have shape {'(N, 2)' if ndim == 2 else '(N,)'}, got {shape}")
    return _read_checked(place, dataset, name)


def read_numbers(place: str, group: Any, name: str) -> Array:
    """A dataset of plain numbers of any shape, after the same look."""
    dataset = _find(place, group, name)
    if _kind_of(place, dataset, name) not in "fiub" or dataset.shape is None:
        raise ValueError(f"{place}: {name!r} must hold numbers, got {dataset.dtype}")
    return _read_checked(place, dataset, name)


def _find(place: str, group: Any, name: str) -> Any:
    import h5py

    dataset = member(place, group, name)
    if dataset is None:
        raise ValueError(f"{place} has no dataset {name!r}")
    if not isinstance(dataset, h5py.Dataset) or dataset.is_virtual or dataset.external:
        raise ValueError(f"{place}: {name!r} must be a dataset with its data in this file")
    return dataset


def _kind_of(place: str, dataset: Any, name: str) -> str:
    try:
        return str(dataset.dtype.kind)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{place}: the type of {name!r} is unknown: {error}") from error


def _read_checked(place: str, dataset: Any, name: str) -> Array:
    shape = dataset.shape
    if max(*shape, 0, math.prod(dataset.chunks or ())) > MAX_ROWS:
        raise ValueError(
            f"{place}: {name!r} must have at most {MAX_ROWS} rows, got {max(shape)} in chunks of {dataset.chunks}"
        )
    if dataset.size and not dataset.id.get_storage_size():
        raise ValueError(f"{place}: {name!r} claims {max(shape)} rows, but holds no data")
    return np.asarray(dataset[()])
