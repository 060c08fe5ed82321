from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import pytest

from tensor_stereo.atomic import whole_file
from tests.awkward_names import NAMES


def write(path: Path, text: str) -> None:
    with whole_file(path) as part:
        part.write_text(text)


@pytest.mark.parametrize("name", [*NAMES, "m" * 250 + ".txt"])
def test_a_file_of_any_name_appears_whole(tmp_path: Path, name: str) -> None:
    write(tmp_path / name, "all")
    assert [(entry.name, entry.read_text()) for entry in tmp_path.iterdir()] == [(name, "all")]


@pytest.mark.parametrize("code", [errno.EINVAL, errno.ENOTSUP, errno.EACCES, errno.EBADF, errno.EIO])
def test_a_folder_that_cannot_be_flushed_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    """As on network mounts and on Windows: the file has its name already."""
    flush = os.fsync

    def refuse_folders(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(code, os.strerror(code))
        flush(descriptor)

    monkeypatch.setattr(os, "fsync", refuse_folders)
    write(tmp_path / "a.txt", "all")
    assert (tmp_path / "a.txt").read_text() == "all"


def test_a_file_system_without_flush_is_no_error_but_lost_data_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    codes = {errno.EINVAL: None, errno.ENOTSUP: None, errno.EIO: OSError, errno.ENOSPC: OSError}
    (tmp_path / "a.txt").write_text("old")
    for code, error in codes.items():

        def refuse(descriptor: int, code: int = code) -> None:
            raise OSError(code, os.strerror(code))

        monkeypatch.setattr(os, "fsync", refuse)
        if error is None:
            write(tmp_path / "a.txt", f"new {code}")
            assert (tmp_path / "a.txt").read_text() == f"new {code}"
            continue
        before = (tmp_path / "a.txt").read_text()
        with pytest.raises(error):
            write(tmp_path / "a.txt", "lost")
        assert (tmp_path / "a.txt").read_text() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]
