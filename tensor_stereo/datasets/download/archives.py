"""Unpacking of archives that nobody vouches for: all members are checked before the first is written."""

from __future__ import annotations

import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import IO, Any, Literal, NamedTuple, TypeAlias

from tensor_stereo.datasets.download.disk_space import check_free_space, explain_full_disk

StepProgress: TypeAlias = Callable[[Literal["check", "unpack"], int, int | None], None]
_Kind: TypeAlias = Literal["file", "folder", "other"]

_CHUNK_BYTES = 1 << 20
_ENDINGS = (".zip", ".tar", ".tar.bz2", ".7z")
_UNREADABLE = (
    *(zipfile.BadZipFile, tarfile.TarError, zlib.error),
    *(EOFError, OSError, RuntimeError),  # of bz2, and of zipfile for passwords and methods that it does not know
)


class _Member(NamedTuple):
    name: str
    kind: _Kind
    size: int


class _Packed(NamedTuple):
    member: _Member
    read: Callable[[], Iterator[bytes]]


def is_archive(name: str) -> bool:
    """Tell by its name whether a file is an archive that :func:`unpack_archive` takes.

    >>> is_archive("monkaa__disparity.tar.bz2"), is_archive("im2.ppm")
    (True, False)
    """
    return name.endswith(_ENDINGS)


def unpack_archive(archive: Path, folder: Path, *, progress: StepProgress) -> list[Path]:
    """Unpack a zip, tar or 7z archive into ``folder``.

    Its files come into place when all of them are unpacked; until then they lie in a hidden folder beside them, which
    is removed if anything fails. They replace files of their names. Rights, owners and times are not taken over.

    Args:
        archive: the archive; it is left as it is.
        folder: an existing folder.
        progress: called with the step (``check``, then ``unpack``), the bytes done, uncompressed, and those in all.

    Returns:
        The files, in the order of the archive.

    Raises:
        ValueError: if the archive is damaged or holds no file, or a member is a link or a device or would lie outside
            ``folder``; nothing is written then. The message names archive and member.
        ImportError: for 7z, if py7zr is not installed; the message says how to install it.
        OSError: if the disk has too little space, before anything is written, or fills up.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with zipfile.ZipFile(f"{folder}/a.zip", "w") as archive:
    ...         archive.writestr("Art/view1.png", b"left")
    ...     [file] = unpack_archive(Path(folder, "a.zip"), Path(folder), progress=lambda *step: None)
    ...     file.relative_to(folder).as_posix(), file.read_bytes()
    ('Art/view1.png', b'left')
    """
    files, num_bytes = _check(archive, progress)
    check_free_space(folder, num_bytes, purpose=f"unpacking {archive}")
    staging = folder / f".{archive.name}"  # hidden: not searched for pairs
    shutil.rmtree(staging, ignore_errors=True)
    try:
        with explain_full_disk(folder):
            staging.mkdir()
            if archive.suffix == ".7z":
                _extract_7z(archive, staging)
            else:
                _extract(archive, staging, num_bytes, progress)
            for file in files:
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (staging / file).replace(folder / file)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    progress("unpack", num_bytes, num_bytes)
    return [folder / file for file in files]


def _check(archive: Path, progress: StepProgress) -> tuple[list[PurePosixPath], int]:
    """Paths of all files, relative to where they go, and their bytes."""
    files: dict[PurePosixPath, None] = {}
    num_bytes = 0
    for member in _list_7z(archive) if archive.suffix == ".7z" else (packed.member for packed in _walk(archive)):
        path = _relative_path(archive, member.name)
        if member.kind == "other" or (member.kind == "file" and not path.parts):
            raise ValueError(f"{archive} is refused: its member {member.name!r} is neither a file nor a folder")
        if member.kind == "file":
            files[path] = None
            num_bytes += member.size
        progress("check", num_bytes, None)
    if not files:
        raise ValueError(f"{archive} holds no file")
    return list(files), num_bytes


def _relative_path(archive: Path, name: str) -> PurePosixPath:
    path = PureWindowsPath(name)  # takes both slashes, and knows drives
    if path.drive or path.root or ".." in path.parts or "\0" in name:
        raise ValueError(f"{archive} is refused: its member {name!r} would lie outside the folder it is unpacked in")
    return PurePosixPath(*path.parts)


def _extract(archive: Path, staging: Path, num_bytes: int, progress: StepProgress) -> None:
    done = 0
    for member, read in _walk(archive):
        if member.kind != "file":
            continue
        path = staging / _relative_path(archive, member.name)
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            for chunk in read():
                file.write(chunk)
                done += len(chunk)
                progress("unpack", done, num_bytes)


def _walk(archive: Path) -> Iterator[_Packed]:
    return _walk_zip(archive) if archive.suffix == ".zip" else _walk_tar(archive)


def _walk_zip(archive: Path) -> Iterator[_Packed]:
    with _explain_damage(archive), zipfile.ZipFile(archive) as opened:
        for info in opened.infolist():
            mode = stat.S_IFMT(info.external_attr >> 16)  # 0 where the archive was not made on Unix
            kind: _Kind = "folder" if info.is_dir() else "file"
            if mode not in (0, stat.S_IFDIR if kind == "folder" else stat.S_IFREG):
                kind = "other"

            def read(info: zipfile.ZipInfo = info) -> Iterator[bytes]:
                return _read(archive, lambda: opened.open(info))

            yield _Packed(_Member(info.filename, kind, info.file_size), read)


def _walk_tar(archive: Path) -> Iterator[_Packed]:
    mode: Literal["r:bz2", "r:"] = "r:bz2" if archive.suffix == ".bz2" else "r:"
    with _explain_damage(archive), tarfile.open(archive, mode) as opened:
        for info in opened:
            kind: _Kind = "folder" if info.isdir() else "file" if info.isreg() else "other"

            def read(info: tarfile.TarInfo = info) -> Iterator[bytes]:
                return _read(archive, lambda: opened.extractfile(info))

            yield _Packed(_Member(info.name, kind, info.size), read)


def _read(archive: Path, open_member: Callable[[], IO[bytes] | None]) -> Iterator[bytes]:
    with _explain_damage(archive):
        member = open_member()
        if member is None:
            return
        with member:
            while chunk := member.read(_CHUNK_BYTES):
                yield chunk


def _list_7z(archive: Path) -> list[_Member]:
    members = []
    with _open_7z(archive) as opened:
        for info in opened.files:
            is_file = not (info.is_directory or info.is_symlink or info.is_junction or info.is_socket)
            is_folder = info.is_directory and not info.is_symlink and not info.is_junction
            kind: _Kind = "file" if is_file else "folder" if is_folder else "other"
            members.append(_Member(info.filename, kind, info.uncompressed or 0))
    return members


def _extract_7z(archive: Path, staging: Path) -> None:
    with _open_7z(archive) as opened:
        opened.extractall(staging)


@contextmanager
def _open_7z(archive: Path) -> Iterator[Any]:
    try:
        py7zr = import_module("py7zr")
    except ImportError as error:
        raise ImportError(
            f"{archive} is a 7z archive, and py7zr, which unpacks it, is not installed: pip install py7zr, then give "
            "the same command again. The archive stays where it is"
        ) from error
    try:
        with py7zr.SevenZipFile(archive) as opened:
            yield opened
    except OSError:
        raise
    except Exception as error:  # damage shows as whatever the reader or a decompressor stumbles over
        raise _unreadable(archive, error) from error


@contextmanager
def _explain_damage(archive: Path) -> Iterator[None]:
    try:
        yield
    except _UNREADABLE as error:
        raise _unreadable(archive, error) from error


def _unreadable(archive: Path, reason: object) -> ValueError:
    return ValueError(f"{archive} is no readable archive ({reason}); delete it to have it downloaded again")
