from __future__ import annotations

import hashlib
import io
import json
import logging.handlers
import os
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import pooch
import pytest

from tensor_stereo.datasets import find_pairs
from tensor_stereo.datasets.download import fetch as fetching
from tensor_stereo.datasets.download import transfer
from tensor_stereo.datasets.download.archives import is_archive
from tensor_stereo.datasets.download.fetch import DownloadProgress, download_releases
from tensor_stereo.datasets.download.releases import RELEASES, Release, RemoteFile
from tests.datasets.file_server import Site, serve

ART = "/stereo/data/scenes2005/ThirdSize/zip-2views/Art-2views.zip"


def image(name: str, width: int = 447) -> bytes:
    """An image in the format that its name tells; other files are empty."""
    if not name.endswith((".png", ".ppm", ".pgm")):
        return b""
    shape = (2, width) if name.endswith(".pgm") or "disp" in name else (2, width, 3)
    return bytes(cv2.imencode(name[-4:], np.full(shape, 9, dtype=np.uint8))[1])


def pack(name: str, files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    if name.endswith(".zip"):
        with zipfile.ZipFile(buffer, "w") as archive:
            for path, content in files.items():
                archive.writestr(path, content)
    elif name.endswith(".7z"):
        py7zr = pytest.importorskip("py7zr", reason="py7zr is not installed")
        with py7zr.SevenZipFile(buffer, "w") as archive:
            for path, content in files.items():
                archive.writestr(content, path)
    else:
        with tarfile.open(fileobj=buffer, mode="w:bz2" if name.endswith(".bz2") else "w") as archive:
            for path, content in files.items():
                info = tarfile.TarInfo(path)
                info.size = len(content)
                archive.addfile(info, io.BytesIO(content))
    return buffer.getvalue()


def members(release: str, file: RemoteFile) -> list[str]:
    """What an archive of a release holds, as published, cut down to a few frames."""
    stem = file.name.partition(".")[0]
    scene = stem.partition("-")[0]
    match release:
        case "middlebury-2003":
            return [f"{scene}/{name}.png" for name in ("im2", "im6", "disp2", "disp6")]
        case "middlebury-2005" | "middlebury-2006":
            return [f"{scene}/{name}" for name in ("view1.png", "view5.png", "disp1.png", "disp5.png", "dmin.txt")]
        case "middlebury-2014":
            return [f"{stem}/{name}" for name in ("im0.png", "im1.png", "disp0.pfm", "calib.txt")]
        case "middlebury-2021":
            names = ("im0.png", "im1.png", "disp0.pfm", "calib.txt")
            return [f"data/{scene}/{name}" for scene in ("artroom1", "chess2") for name in names]
        case "middeval3-q" | "middeval3-h" | "middeval3-f":
            size = stem[-1]
            if "GT0" in stem:
                return [f"MiddEval3/training{size}/Piano/{name}" for name in ("disp0GT.pfm", "mask0nocc.png")]
            scenes = (f"training{size}/Piano", f"test{size}/Plants")
            return [f"MiddEval3/{scene}/{name}" for scene in scenes for name in ("im0.png", "im1.png", "calib.txt")]
        case "kitti-2012" | "kitti-2015":
            images = ("colored_0", "colored_1") if release == "kitti-2012" else ("image_2", "image_3")
            maps = ("disp_occ", "disp_noc") if release == "kitti-2012" else ("disp_occ_0", "disp_noc_0")
            frames = [f"{part}/{name}/000000_10.png" for part in ("training", "testing") for name in images]
            return frames + [f"training/{name}/000000_10.png" for name in maps]
        case "eth3d-two-view":
            names = ("disp0GT.pfm", "mask0nocc.png") if stem.endswith("gt") else ("im0.png", "im1.png", "calib.txt")
            return [f"forest_1s/{name}" for name in names]
        case "flyingthings3d" | "driving" | "monkaa":
            folder = stem.partition("__")[2]
            ending = "pfm" if folder == "disparity" else "png"
            return [f"{folder}/TRAIN/A/0000/{side}/0006.{ending}" for side in ("left", "right")]
        case "sintel-stereo":
            names = ("clean_left", "clean_right", "final_left", "final_right", "disparities", "occlusions")
            return [f"training/{name}/alley_1/frame_0001.png" for name in names]
    raise AssertionError(release)


def publish(release: Release) -> dict[str, bytes]:
    files = {}
    for file in release.files:
        if is_archive(file.name):
            width = 450 if release.name == "middlebury-2003" else 447
            content = pack(file.name, {name: image(name, width) for name in members(release.name, file)})
        else:
            content = image(file.name, 384 if file.folder == "tsukuba" else 434)
        files[urlsplit(file.url).path] = content
    return files


@pytest.fixture(autouse=True)
def _no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transfer, "_PAUSES_S", ())
    monkeypatch.setenv("no_proxy", "*")


@pytest.fixture
def site() -> Iterator[Site]:
    with serve(Site(publish(RELEASES["middlebury-2005"]))) as served:
        yield served


def fetch(site: Site, out: Path, *names: str) -> list[Path]:
    return download_releases(names or ["middlebury-2005"], out, base_url=site.url)


def lock(out: Path) -> dict[str, dict[str, object]]:
    entries = json.loads((out / "checksums.json").read_text())["entries"]
    return {urlsplit(url).path: entry for url, entry in entries.items()}


PAIRS = {
    "middlebury-2001": ("middlebury-2001", 7, {8, 16}),
    "middlebury-2003": ("middlebury-2003", 2, {4}),
    "middlebury-2005": ("middlebury-2005", 6, {3}),
    "middlebury-2006": ("middlebury-2006", 21, {3}),
    "middlebury-2014": ("middlebury-2014", 23, {1}),
    "middlebury-2021": ("middlebury-2021", 2, {1}),
    "middeval3-q": ("middeval3", 2, {1, None}),
    "middeval3-h": ("middeval3", 2, {1, None}),
    "middeval3-f": ("middeval3", 2, {1, None}),
    "kitti-2012": ("kitti-2012", 2, {256, None}),
    "kitti-2015": ("kitti-2015", 2, {256, None}),
    "eth3d-two-view": ("eth3d", 1, {1}),
    "flyingthings3d": ("flyingthings3d", 2, {1}),
    "driving": ("driving", 2, {1}),
    "monkaa": ("monkaa", 2, {1}),
    "sintel-stereo": ("sintel", 2, {1}),
}


@pytest.mark.parametrize("name", RELEASES)
def test_a_release_arrives_as_find_pairs_reads_it(tmp_path, name):
    dataset, num_pairs, scales = PAIRS[name]
    with serve(Site(publish(RELEASES[name]))) as site:
        assert fetch(site, tmp_path / "data", name) == [tmp_path / "data" / name]
    pairs = find_pairs(tmp_path / "data")
    assert len(pairs) == num_pairs
    assert {pair.gt_scale for pair in pairs} == scales
    assert all(pair.dataset.startswith(dataset) for pair in pairs)
    files = [path for path in (tmp_path / "data").rglob("*") if path.is_file()]
    assert not [path for path in files if is_archive(path.name) or ".part" in path.name]
    assert not list((tmp_path / "data").rglob(".*"))


def test_a_second_run_asks_for_nothing(site, tmp_path):
    fetch(site, tmp_path)
    before = (tmp_path / "checksums.json").read_bytes()
    site.requests.clear()
    fetch(site, tmp_path)
    assert site.requests == []
    assert (tmp_path / "checksums.json").read_bytes() == before


@pytest.mark.parametrize("damage", [Path.unlink, Path.touch])
def test_files_that_are_gone_or_cut_short_are_fetched_again(site, tmp_path, damage):
    fetch(site, tmp_path)
    site.requests.clear()
    map_ = tmp_path / "middlebury-2005" / "Art" / "disp1.png"
    content = map_.read_bytes()
    map_.unlink()
    map_.touch()
    damage(map_)
    fetch(site, tmp_path)
    assert [path for path, *_ in site.requests] == [ART]
    assert map_.read_bytes() == content


def test_the_lock_file_holds_hashes_and_what_came_of_each_file(site, tmp_path):
    fetch(site, tmp_path)
    assert set(lock(tmp_path)) == set(site.files)
    entry = lock(tmp_path)[ART]
    assert entry["sha256"] == hashlib.sha256(site.files[ART]).hexdigest()
    assert entry["files"]["middlebury-2005/Art/view1.png"] == len(image("view1.png"))
    assert len(entry["files"]) == 5


def test_a_broken_download_is_resumed_by_the_next_run(site, tmp_path):
    site.cuts = [100]
    with pytest.raises(OSError, match="the same command goes on from there") as error:
        fetch(site, tmp_path)
    assert site.url + ART in str(error.value)
    assert not (tmp_path / "checksums.json").exists()
    site.requests.clear()
    fetch(site, tmp_path)
    assert site.requests[0] == (ART, "bytes=100-", '"1"')
    assert [asked for _, asked, _ in site.requests[1:]] == [None] * 5
    assert len(find_pairs(tmp_path)) == 6


def test_a_changed_file_is_refused_until_its_entry_is_deleted(site, tmp_path):
    fetch(site, tmp_path)
    (tmp_path / "middlebury-2005" / "Art" / "view1.png").unlink()
    old = hashlib.sha256(site.files[ART]).hexdigest()
    site.files[ART] = pack("Art-2views.zip", {"Art/view1.png": image("view1.png", 463)})
    with pytest.raises(ValueError, match="is not what") as error:
        fetch(site, tmp_path)
    new = hashlib.sha256(site.files[ART]).hexdigest()
    for part in ("Art-2views.zip", old, new, f"delete the entry https://vision.middlebury.edu{ART}"):
        assert part in str(error.value)
    assert sorted(path.name for path in (tmp_path / "middlebury-2005").iterdir() if path.is_file()) == []
    record = json.loads((tmp_path / "checksums.json").read_text())
    del record["entries"][f"https://vision.middlebury.edu{ART}"]
    (tmp_path / "checksums.json").write_text(json.dumps(record))
    fetch(site, tmp_path)
    assert lock(tmp_path)[ART]["sha256"] == new


def test_a_mirror_keeps_the_path_of_the_source(site, tmp_path):
    site.files = {f"/mirror{path}": content for path, content in site.files.items()}
    download_releases(["middlebury-2005"], tmp_path, base_url=f"{site.url}/mirror/")
    assert {path for path, *_ in site.requests} == set(site.files)
    assert ART in lock(tmp_path)


def test_archives_that_lie_there_are_not_fetched(site, tmp_path):
    (tmp_path / "middlebury-2005").mkdir()
    (tmp_path / "middlebury-2005" / "Art-2views.zip").write_bytes(site.files[ART])
    fetch(site, tmp_path)
    assert ART not in [path for path, *_ in site.requests]
    assert len(find_pairs(tmp_path)) == 6


def test_releases_named_twice_are_fetched_once(site, tmp_path):
    assert fetch(site, tmp_path, "middlebury-2005", "middlebury-2005") == [tmp_path / "middlebury-2005"]
    assert len(site.requests) == 6


def test_progress_tells_file_step_and_bytes(site, tmp_path):
    log: list[DownloadProgress] = []
    download_releases(["middlebury-2005"], tmp_path, base_url=site.url, progress=log.append)
    of_art = [step for step in log if step.file == "Art-2views.zip"]
    assert list(dict.fromkeys(step.step for step in of_art)) == ["download", "check", "unpack"]
    size = len(site.files[ART])
    assert [step for step in of_art if step.step == "download"][-1] == DownloadProgress(
        "Art-2views.zip", "download", size, size
    )
    assert of_art[-1].bytes_done == of_art[-1].bytes_total


def test_pooch_writes_nothing_between_the_progress(site, tmp_path):
    handler = logging.handlers.BufferingHandler(100)
    logger = pooch.get_logger()
    logger.addHandler(handler)
    before = logger.level
    logger.setLevel(logging.DEBUG)
    try:
        fetch(site, tmp_path)
        assert handler.buffer == []
        assert logger.level == logging.DEBUG
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)


def test_a_missing_file_is_named_with_its_status(site, tmp_path):
    del site.files[ART]
    with pytest.raises(OSError, match=f"{site.url}{ART}: the server answered 404 Not Found"):
        fetch(site, tmp_path)


def test_an_archive_that_reaches_outside_writes_and_records_nothing(site, tmp_path):
    site.files[ART] = pack("a.zip", {"Art/view1.png": b"", "../../evil.png": b"evil"})
    with pytest.raises(ValueError, match=r"'\.\./\.\./evil\.png' would lie outside"):
        fetch(site, tmp_path / "data")
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["Art-2views.zip"]


def test_a_page_of_text_instead_of_an_archive_or_image_is_not_recorded(tmp_path):
    page = b"<html>Please log in</html>"
    for name, file in (("middlebury-2005", "Art-2views.zip"), ("middlebury-2001", "im2.ppm")):
        message = f"{file}.*delete it to have it downloaded again"
        with (
            serve(Site(dict.fromkeys(publish(RELEASES[name]), page))) as site,
            pytest.raises(ValueError, match=message),
        ):
            fetch(site, tmp_path, name)
        assert not (tmp_path / "checksums.json").exists()


def test_an_interruption_while_hashing_keeps_the_download(site, tmp_path, monkeypatch):
    def interrupt(*args: object, **kwargs: object) -> bool:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("pooch.core.hash_matches", interrupt)
        with pytest.raises(KeyboardInterrupt):
            fetch(site, tmp_path)
    site.requests.clear()
    fetch(site, tmp_path)
    assert ART not in [path for path, *_ in site.requests]
    assert len(find_pairs(tmp_path)) == 6


def test_a_file_system_without_links_does(site, tmp_path, monkeypatch):
    def refuse(*args: object) -> None:
        raise PermissionError("no links here")

    monkeypatch.setattr(os, "link", refuse)
    fetch(site, tmp_path)
    assert len(find_pairs(tmp_path)) == 6
    assert not list(tmp_path.rglob("*.part*"))


def test_7z_archives_stay_until_their_library_is_there(tmp_path, monkeypatch):
    release = RELEASES["eth3d-two-view"]
    with serve(Site(dict.fromkeys((urlsplit(file.url).path for file in release.files), b"7z"))) as site:
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, "py7zr", None)
            with pytest.raises(ImportError, match="pip install py7zr"):
                fetch(site, tmp_path, release.name)
        archive = tmp_path / release.name / "two_view_training.7z"
        assert archive.read_bytes() == b"7z"
        site.requests.clear()
        site.files.update(publish(release))
        archive.write_bytes(site.files["/data/two_view_training.7z"])
        fetch(site, tmp_path, release.name)
        assert [path for path, *_ in site.requests] == ["/data/two_view_training_gt.7z"]


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"version": 2, "entries": {}}', '{"version": 1, "entries": {"a": {"sha256": ""}}}']
)
def test_a_damaged_lock_file_is_named(tmp_path, text):
    (tmp_path / "checksums.json").write_text(text)
    with pytest.raises(ValueError, match=r"checksums\.json is no readable record of downloads"):
        download_releases(["middlebury-2005"], tmp_path, base_url="http://127.0.0.1:9")


def test_a_lock_file_that_cannot_be_written_leaves_the_old_one(site, tmp_path, monkeypatch):
    fetch(site, tmp_path)
    before = (tmp_path / "checksums.json").read_bytes()
    (tmp_path / "middlebury-2005" / "Art" / "view1.png").unlink()
    replace = Path.replace

    def refuse(self: Path, target: Path) -> Path:
        if target.name == "checksums.json":
            raise PermissionError("not allowed")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(PermissionError):
        fetch(site, tmp_path)
    assert (tmp_path / "checksums.json").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checksums.json", "middlebury-2005"]


def test_arguments_are_checked_before_anything_is_made(tmp_path):
    out = tmp_path / "data"
    with pytest.raises(ValueError, match=r"unknown release 'kitti-2051'; known are middlebury-2001, .*sintel-stereo"):
        download_releases(["middlebury-2005", "kitti-2051"], out)
    with pytest.raises(ValueError, match="at least one release"):
        download_releases([], out)
    with pytest.raises(TypeError, match="names must be a sequence of releases, got the string 'kitti-2015'"):
        download_releases("kitti-2015", out)
    for base_url in ("mirror.example.org", "file:///data", "https://"):
        with pytest.raises(ValueError, match=f"base_url must be an address .*, got '{base_url}'"):
            download_releases(["kitti-2015"], out, base_url=base_url)
    assert not out.exists()


def test_the_table_names_every_file_once_and_over_https():
    files = [(release.name, file) for release in RELEASES.values() for file in release.files]
    assert len({file.url for _, file in files}) == len(files)
    assert len({(name, file.folder, file.name) for name, file in files}) == len(files)
    assert all(file.url.startswith("https://") for _, file in files)
    assert list(PAIRS) == list(RELEASES)


def test_the_module_imports_no_heavy_library():
    code = (
        "import sys, tensor_stereo.datasets.download.fetch;"
        "print(sorted({'torch', 'pooch', 'requests', 'py7zr', 'polars'} & sys.modules.keys()))"
    )
    path = os.pathsep.join(filter(None, sys.path))
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, check=True, env={**os.environ, "PYTHONPATH": path})
    assert result.stdout.strip() == "[]"
    assert fetching.LOCK_NAME == "checksums.json"
