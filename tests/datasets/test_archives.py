from __future__ import annotations

import io
import random
import stat
import sys
import tarfile
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from tensor_stereo.datasets.download import disk_space
from tensor_stereo.datasets.download.archives import is_archive, unpack_archive

FILES = {"Art/view1.png": b"left", "Art/disp1.png": b"truth" * 1000, "Books/view1.png": b""}


def write_zip(path: Path, files: dict[str, bytes], *, mode: int = stat.S_IFREG | 0o644) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            info = zipfile.ZipInfo(name)
            info.external_attr, info.compress_type = mode << 16, zipfile.ZIP_DEFLATED
            archive.writestr(info, content)
    return path


def write_tar(path: Path, files: dict[str, bytes], *, kind: bytes = tarfile.REGTYPE, link: str = "") -> Path:
    with tarfile.open(path, "w:bz2" if path.suffix == ".bz2" else "w") as archive:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.type, info.linkname, info.size, info.mode = kind, link, len(content), 0o600
            archive.addfile(info, io.BytesIO(content))
    return path


def write_7z(path: Path, files: dict[str, bytes]) -> Path:
    py7zr = pytest.importorskip("py7zr", reason="py7zr is not installed")
    with py7zr.SevenZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(content, name)
    return path


WRITERS = {"a.zip": write_zip, "a.tar": write_tar, "a.tar.bz2": write_tar, "a.7z": write_7z}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "data").mkdir()
    return tmp_path / "data"


def unpack(archive: Path, folder: Path) -> list[tuple[str, int, int | None]]:
    log: list[tuple[str, int, int | None]] = []
    unpack_archive(archive, folder, progress=lambda *step: log.append(step))
    return log


def tree(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("name", WRITERS)
def test_all_files_come_into_place_and_nothing_else(tmp_path, folder, name):
    archive = WRITERS[name](tmp_path / name, FILES)
    files = unpack_archive(archive, folder, progress=lambda *step: None)
    assert tree(folder) == FILES
    assert [file.relative_to(folder).as_posix() for file in files] == list(FILES)
    assert sorted(path.name for path in folder.iterdir()) == ["Art", "Books"]
    assert archive.exists()


@pytest.mark.parametrize("name", WRITERS)
def test_progress_checks_first_and_ends_with_all_bytes(tmp_path, folder, name):
    log = unpack(WRITERS[name](tmp_path / name, FILES), folder)
    steps = [step for step, *_ in log]
    assert steps == sorted(steps)
    assert ("check", 5004, None) in log
    assert log[-1] == ("unpack", 5004, 5004)


def test_files_of_the_same_name_are_replaced_and_others_stay(tmp_path, folder):
    (folder / "Art").mkdir()
    (folder / "Art" / "view1.png").write_bytes(b"old")
    (folder / "Art" / "mine.txt").write_bytes(b"mine")
    unpack(write_zip(tmp_path / "a.zip", FILES), folder)
    assert tree(folder) == FILES | {"Art/mine.txt": b"mine"}


def test_what_a_killed_run_left_is_cleared(tmp_path, folder):
    (folder / ".a.zip" / "Art").mkdir(parents=True)
    (folder / ".a.zip" / "Art" / "half").write_bytes(b"half")
    unpack(write_zip(tmp_path / "a.zip", FILES), folder)
    assert tree(folder) == FILES


OUTSIDE = ["../evil", "Art/../../evil", "/evil", "..\\evil", "\\evil", "C:\\evil", "C:evil", "//host/share/evil"]


@pytest.mark.parametrize("name", ["a.zip", "a.tar"])
@pytest.mark.parametrize("evil", OUTSIDE)
def test_a_member_outside_the_folder_is_refused_before_anything_is_written(tmp_path, folder, name, evil):
    archive = WRITERS[name](tmp_path / name, {"Art/view1.png": b"left", evil: b"evil"})
    with pytest.raises(ValueError, match="would lie outside the folder") as error:
        unpack(archive, folder)
    assert str(archive) in str(error.value)
    assert repr(evil) in str(error.value)
    assert list(folder.iterdir()) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == [name, "data"]


def test_a_member_of_a_7z_archive_outside_the_folder_is_refused(tmp_path, folder, monkeypatch):
    archive = write_7z(tmp_path / "a.7z", FILES)
    py7zr = pytest.importorskip("py7zr")
    monkeypatch.setattr(py7zr.py7zr.ArchiveFile, "filename", property(lambda self: "../evil"))
    with pytest.raises(ValueError, match="would lie outside the folder"):
        unpack(archive, folder)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE])
def test_links_and_devices_in_a_tar_are_refused(tmp_path, folder, kind):
    archive = write_tar(tmp_path / "a.tar", {"Art/view1.png": b""}, kind=kind, link="/etc/passwd")
    with pytest.raises(ValueError, match=r"'Art/view1\.png' is neither a file nor a folder"):
        unpack(archive, folder)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR])
def test_links_and_devices_in_a_zip_are_refused(tmp_path, folder, kind):
    archive = write_zip(tmp_path / "a.zip", {"Art/view1.png": b"/etc/passwd"}, mode=kind | 0o777)
    with pytest.raises(ValueError, match=r"'Art/view1\.png' is neither a file nor a folder"):
        unpack(archive, folder)
    assert list(folder.iterdir()) == []


def test_links_in_a_7z_archive_are_refused(tmp_path, folder):
    py7zr = pytest.importorskip("py7zr", reason="py7zr is not installed")
    (tmp_path / "link").symlink_to("/etc/passwd")
    with py7zr.SevenZipFile(tmp_path / "a.7z", "w") as archive:
        archive.write(tmp_path / "link", "Art/view1.png")
    with pytest.raises(ValueError, match=r"'Art/view1\.png' is neither a file nor a folder"):
        unpack(tmp_path / "a.7z", folder)
    assert list(folder.iterdir()) == []


def test_folders_and_names_with_backslashes_are_taken(tmp_path, folder):
    unpack(write_zip(tmp_path / "a.zip", {"Art/": b"", "./Art\\view1.png": b"left"}, mode=0), folder)
    assert tree(folder) == {"Art/view1.png": b"left"}


def test_rights_of_members_are_not_taken_over(tmp_path, folder):
    archive = tmp_path / "a.tar"
    with tarfile.open(archive, "w") as opened:
        info = tarfile.TarInfo("run.sh")
        info.mode = 0o6777
        opened.addfile(info)
    unpack(archive, folder)
    assert not (folder / "run.sh").stat().st_mode & 0o7111


@pytest.mark.parametrize("name", ["a.zip", "a.tar", "a.tar.bz2", "a.7z"])
@pytest.mark.parametrize("content", [b"", b"<html>Please log in</html>"])
def test_a_file_that_is_no_archive_is_named(tmp_path, folder, name, content):
    if name == "a.7z":
        pytest.importorskip("py7zr", reason="py7zr is not installed")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=r"is no readable archive .*; delete it to have it downloaded again") as error:
        unpack(tmp_path / name, folder)
    assert str(tmp_path / name) in str(error.value)


@pytest.mark.parametrize("is_cut", [False, True])
@pytest.mark.parametrize("name", WRITERS)
def test_a_damaged_archive_leaves_nothing(tmp_path, folder, name, is_cut):
    if name == "a.tar" and not is_cut:
        pytest.skip("a tar without compression has no checksum over its files")
    noise = random.Random(0).randbytes(1_250_000).hex().encode()  # three blocks of bzip2
    archive = WRITERS[name](tmp_path / name, {"first.png": b"whole", "second.png": noise})
    content = archive.read_bytes()
    middle = len(content) // 2
    if is_cut:
        content = content[:middle]
    else:
        damage = bytes(byte ^ 255 for byte in content[middle : middle + 64])
        content = content[:middle] + damage + content[middle + 64 :]
    archive.write_bytes(content)
    with pytest.raises(ValueError, match="is no readable archive"):
        unpack(archive, folder)
    assert list(folder.iterdir()) == []


def test_an_encrypted_zip_is_named(tmp_path, folder):
    archive = write_zip(tmp_path / "a.zip", FILES)
    content = bytearray(archive.read_bytes())
    for start in (b"PK\x03\x04", b"PK\x01\x02"):  # bit 0 of the flags, APPNOTE 4.4.4
        at = content.index(start)
        content[at + (6 if start == b"PK\x03\x04" else 8)] |= 1
    archive.write_bytes(content)
    with pytest.raises(ValueError, match=r"is no readable archive .*encrypted"):
        unpack(archive, folder)
    assert list(folder.iterdir()) == []


def test_an_archive_without_files_is_refused(tmp_path, folder):
    with pytest.raises(ValueError, match="holds no file"):
        unpack(write_zip(tmp_path / "a.zip", {"Art/": b""}, mode=0), folder)


@pytest.mark.parametrize("name", WRITERS)
def test_an_archive_larger_than_the_disk_is_not_begun(tmp_path, folder, name, monkeypatch):
    archive = WRITERS[name](tmp_path / name, FILES)
    monkeypatch.setattr(disk_space.shutil, "disk_usage", lambda folder: SimpleNamespace(free=5003))
    with pytest.raises(OSError, match=r"unpacking .* needs 5,004 bytes, but the disk of .* has only 5,003 left"):
        unpack(archive, folder)
    assert list(folder.iterdir()) == []
    monkeypatch.setattr(disk_space.shutil, "disk_usage", lambda folder: SimpleNamespace(free=5004))
    unpack(archive, folder)


def test_7z_without_its_library_says_what_to_install(tmp_path, folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "py7zr", None)
    (tmp_path / "a.7z").write_bytes(b"7z\xbc\xaf\x27\x1c")
    with pytest.raises(ImportError, match="py7zr, which unpacks it, is not installed: pip install py7zr") as error:
        unpack(tmp_path / "a.7z", folder)
    assert str(tmp_path / "a.7z") in str(error.value)
    assert (tmp_path / "a.7z").exists()


@pytest.mark.parametrize("name", ["im2.ppm", "a.zip.part", "a.zip.part.json", "archive"])
def test_other_files_are_no_archives(name):
    assert not is_archive(name)
