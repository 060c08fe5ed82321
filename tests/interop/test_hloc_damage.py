from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tensor_stereo.interop import hdf5
from tensor_stereo.interop.glue_factory import two_view_filter
from tensor_stereo.interop.hdf5_matches import filter_hdf5
from tests.interop.hloc_files import (
    IMAGES,
    features,
    partners,
    paths,
    write_features,
    write_matches,
)

h5py = pytest.importorskip("h5py", reason="h5py is not installed")


def change_group(name: str, values: Any, **options: Any) -> Any:
    def change(group: Any, keypoints: Any) -> None:
        if name in group:
            del group[name]
        if values is not None:
            group.create_dataset(name, data=values, **options)

    return change


def change_keypoints(values: Any) -> Any:
    def change(group: Any, keypoints: Any) -> None:
        del keypoints["db/1.jpg/keypoints"]
        keypoints["db/1.jpg/keypoints"] = values

    return change


def not_a_number(group: Any, keypoints: Any) -> None:
    keypoints["db/2.jpg/keypoints"][group["matches0"][4], 0] = np.nan


def too_long(group: Any, keypoints: Any) -> None:
    for name in ("matches0", "matching_scores0"):
        change_group(name, np.zeros(51, dtype=int if name == "matches0" else float))(group, keypoints)


def huge(group: Any, keypoints: Any) -> None:
    del group["matches0"]
    group.create_dataset("matches0", shape=(2**40,), dtype="i2", chunks=(1024,))


def huge_chunk(group: Any, keypoints: Any) -> None:
    del group["matches0"]
    group.create_dataset("matches0", shape=(50,), maxshape=(None,), dtype="i2", chunks=(2**30,))


def without_data(group: Any, keypoints: Any) -> None:
    del group["matches0"]
    group.create_dataset("matches0", shape=(50,), dtype="i2")


def external_data(group: Any, keypoints: Any) -> None:
    del group["matches0"]
    secret = str(Path(group.file.filename).with_name("secret"))
    group.create_dataset("matches0", shape=(50,), dtype="i2", external=[(secret, 0, 100)])


def virtual(group: Any, keypoints: Any) -> None:
    del group["matches0"]
    layout = h5py.VirtualLayout(shape=(50,), dtype="i2")
    layout[:] = h5py.VirtualSource("other.h5", "a", shape=(50,))
    group.create_virtual_dataset("matches0", layout)


def external_link(group: Any, keypoints: Any) -> None:
    del group["matches0"]
    group["matches0"] = h5py.ExternalLink("other.h5", "/a")


def soft_link(group: Any, keypoints: Any) -> None:
    del group["matching_scores0"]
    group["matching_scores0"] = h5py.SoftLink("/nowhere")


def linked_group(group: Any, keypoints: Any) -> None:
    group.file["x"] = h5py.ExternalLink("other.h5", "/a")


def linked_image(group: Any, keypoints: Any) -> None:
    keypoints["db/3.jpg"] = h5py.ExternalLink("other.h5", "/a")


def circle(group: Any, keypoints: Any) -> None:
    keypoints["db/again"] = keypoints["db"]


def loose(group: Any, keypoints: Any) -> None:
    group.file["x"] = np.zeros(3)


def loose_below(group: Any, keypoints: Any) -> None:
    group.file["db-1.jpg/x"] = np.zeros(3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (change_group("matches0", None), "pair 'db-1.jpg/db-2.jpg' has no dataset 'matches0'"),
        (change_group("matches0", np.zeros(50)), "pair .*: 'matches0' must hold integers, got float64"),
        (change_group("matches0", np.zeros((50, 2), int)), r"'matches0' must have shape \(N,\), got \(50, 2\)"),
        (too_long, "matches0 has 51 rows, but there are 50 keypoints0"),
        (change_group("matches0", np.full(50, 50)), "must be -1, -2 or one of 50 keypoints1, got 50 in row 0"),
        (change_group("matches0", np.full(50, -30000)), "got -30000 in row 0"),
        (change_group("matches0", h5py.Empty("i2")), "'matches0' must have shape"),
        (
            change_group("matching_scores0", np.zeros(49)),
            r"'matching_scores0' must have shape \(50,\) as matches0",
        ),
        (change_group("matching_scores0", np.full(50, np.nan)), "matching_scores0 must not be NaN, got NaN in row"),
        (change_group("matching_scores0", ["a"] * 50), "'matching_scores0' must hold numbers, got object"),
        (change_keypoints(np.zeros((50, 3))), r"image 'db/1.jpg': 'keypoints' must have shape \(N, 2\), got \(50, 3\)"),
        (change_keypoints([b"a"]), "image 'db/1.jpg': 'keypoints' must hold numbers"),
        (not_a_number, r"pair 'db-1.jpg/db-2.jpg': keypoints1, row 4, must be finite, .* got \(nan, "),
        (huge, r"'matches0' must have at most \d+ rows, got 1099511627776"),
        (huge_chunk, r"'matches0' must have at most \d+ rows, got 50 in chunks of \(1073741824,\)"),
        (without_data, "'matches0' claims 50 rows, but holds no data"),
        (external_data, "'matches0' must be a dataset with its data in this file"),
        (virtual, "'matches0' must be a dataset with its data in this file"),
        (external_link, "/db-1.jpg/db-2.jpg/matches0 is a link, which is not followed"),
        (soft_link, "/db-1.jpg/db-2.jpg/matching_scores0 is a link"),
        (linked_group, r"matches\.h5: /x is a link"),
        (linked_image, r"features\.h5: /db/3.jpg is a link"),
        (circle, r"features\.h5: group 'db(/again)?' is also known by another name"),
        (loose, r"matches\.h5: 'x' must be a group of pairs, got a dataset"),
        (loose_below, r"matches\.h5: 'db-1.jpg/x' must be a group with the dataset 'matches0'"),
    ],
)
def test_what_is_wrong_is_named_by_file_and_pair(tmp_path: Path, change: Any, message: str) -> None:
    source, target, keypoints = paths(tmp_path)
    arrays = partners(7)
    arrays["matches0"] = np.arange(50, dtype=np.int16)
    write_features(keypoints, features(7))
    write_matches(source, {(IMAGES[0], IMAGES[1]): arrays})
    (tmp_path / "secret").write_bytes(bytes(100))
    with h5py.File(source, "r+") as file, h5py.File(keypoints, "r+") as points:
        change(file["db-1.jpg/db-2.jpg"], points)
    with pytest.raises(ValueError, match=message) as caught:
        filter_hdf5(source, target, two_view_filter(), keypoints)
    assert str(tmp_path) in str(caught.value)
    assert (tmp_path / "secret").read_bytes() == bytes(100)
    assert not (tmp_path / "other.h5").exists()


def test_links_with_names_of_results_stay_and_are_not_followed(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    write_features(keypoints, features(8))
    write_matches(source, {(IMAGES[0], IMAGES[1]): partners(8)})
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["a"] = np.zeros(50)
    before = (tmp_path / "other.h5").read_bytes()
    with h5py.File(source, "r+") as file:
        file["db-1.jpg/db-2.jpg/score"] = h5py.ExternalLink("other.h5", "/a")
        file["db-1.jpg/db-2.jpg/inlier"] = h5py.ExternalLink("none.h5", "/a")
    filter_hdf5(source, target, two_view_filter(), keypoints)
    assert (tmp_path / "other.h5").read_bytes() == before
    with h5py.File(target) as result:
        group = result["db-1.jpg/db-2.jpg"]
        for name in ("score", "inlier"):
            assert isinstance(group.get(name, getlink=True), h5py.ExternalLink)
            assert isinstance(group.get(f"filter_{name}", getlink=True), h5py.HardLink)


def test_damaged_files_are_named(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    write_features(keypoints, features(9))
    write_matches(source, {(IMAGES[0], IMAGES[1]): partners(9)})
    for path in (source, keypoints):
        data = path.read_bytes()
        for damaged in (data[: len(data) // 2], data[:30] + bytes(60) + data[90:], b""):
            path.write_bytes(damaged)
            with pytest.raises(ValueError, match=path.name):
                filter_hdf5(source, target, two_view_filter(), keypoints)
        path.write_bytes(data)
    with h5py.File(source, "r+") as file:
        group = file["db-1.jpg/db-2.jpg"]
        del group["matches0"]
        group.create_dataset("matches0", data=np.arange(50), compression="gzip")
        place = group["matches0"].id.get_chunk_info(0).byte_offset
    data = bytearray(source.read_bytes())
    data[place : place + 8] = bytes(8)
    source.write_bytes(data)
    with pytest.raises(ValueError, match=r"matches\.h5, pair 'db-1.jpg/db-2.jpg' cannot be read"):
        filter_hdf5(source, target, two_view_filter(), keypoints)


def test_the_error_without_h5py_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(ImportError, match=r"h5py must be installed to read matches\.h5"):
        filter_hdf5(tmp_path / "matches.h5", tmp_path / "out.h5", two_view_filter(), tmp_path / "features.h5")


def test_the_limit_is_the_one_of_the_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, target, keypoints = paths(tmp_path)
    write_features(keypoints, features(10))
    write_matches(source, {(IMAGES[0], IMAGES[1]): partners(10)})
    monkeypatch.setattr(hdf5, "MAX_ROWS", 49)
    with pytest.raises(ValueError, match="must have at most 49 rows, got 50"):
        filter_hdf5(source, target, two_view_filter(), keypoints)
