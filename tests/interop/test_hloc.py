from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tensor_stereo import DelaunayFilter, Matches
from tensor_stereo.interop import hloc, verdicts
from tensor_stereo.interop.hloc import filter_hloc
from tests.interop.match_batches import expected
from tests.interop.matchers import scene

h5py = pytest.importorskip("h5py", reason="h5py is not installed")

IMAGES = ("db/1.jpg", "db/2.jpg", "query/night_1.jpg")


def features(seed: int, num_keypoints: int = 50) -> dict[str, np.ndarray]:
    """Keypoints as hloc stores them: in half precision, more than are matched."""
    left, right = scene(seed, num_keypoints)
    third = left - torch.tensor([0.0, 7.0])
    return {name: points.numpy().astype(np.float16) for name, points in zip(IMAGES, (left, right, third), strict=True)}


def write_features(path: Path, keypoints: dict[str, np.ndarray]) -> None:
    """What extract_features of hloc writes: one group per image, its descriptors and size beside the keypoints."""
    with h5py.File(path, "w", libver="latest") as file:
        for name, points in keypoints.items():
            group = file.create_group(name)
            group.create_dataset("keypoints", data=points)
            group["keypoints"].attrs["uncertainty"] = 1.0
            group.create_dataset("descriptors", data=np.zeros((16, len(points)), dtype=np.float16))
            group.create_dataset("image_size", data=np.array([320, 240]))


def write_matches(path: Path, pairs: dict[tuple[str, str], dict[str, np.ndarray]], separator: str = "/") -> None:
    """What match_features of hloc writes: "/" of names is "-", int16 partners, half-precision scores."""
    with h5py.File(path, "w", libver="latest") as file:
        for names, arrays in pairs.items():
            group = file.create_group(separator.join(name.replace("/", "-") for name in names))
            for name, values in arrays.items():
                group.create_dataset(name, data=values)


def partners(seed: int, num_keypoints: int = 50, num_rows: int = 50) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    matches0 = np.arange(num_rows, dtype=np.int16) % num_keypoints
    matches0[rng.random(num_rows) < 0.2] = -1
    return {"matches0": matches0, "matching_scores0": rng.random(num_rows).astype(np.float16)}


def some_pairs(seed: int) -> dict[tuple[str, str], dict[str, np.ndarray]]:
    """Pairs in both orders, one without scores, one shorter than its keypoints, one without matches."""
    one, two, three = IMAGES
    return {
        (one, two): partners(seed),
        (two, one): partners(seed + 1),
        (one, three): {"matches0": partners(seed)["matches0"].astype(np.int32)},
        (three, two): partners(seed + 2, num_rows=30),
        (three, one): {"matches0": np.full(50, -1, dtype=np.int16)},
        (three, three): {"matches0": np.zeros(0, dtype=np.int64), "matching_scores0": np.zeros(0, dtype=np.float16)},
    }


def to_matches(
    names: tuple[str, str], arrays: dict[str, np.ndarray], keypoints: dict[str, np.ndarray]
) -> tuple[Matches, np.ndarray]:
    """The matches of a pair in a loop over its rows, and those rows."""
    points0, points1 = (keypoints[name].astype(np.float64) for name in names)
    rows = np.array([i for i, j in enumerate(arrays["matches0"]) if j >= 0], dtype=np.int64)
    left = torch.tensor(np.array([points0[i] for i in rows]).reshape(-1, 2))
    right = torch.tensor(np.array([points1[arrays["matches0"][i]] for i in rows]).reshape(-1, 2))
    scores = arrays.get("matching_scores0")
    cost = None if scores is None else torch.from_numpy(1 - scores.astype(np.float64)[rows])
    return Matches(left, right, torch.tensor([0, len(rows)]), cost), rows


def read_as_hloc(path: Path, name0: str, name1: str) -> np.ndarray:
    """(K, 2) rows of both images, found as hloc's utils/io.py finds them."""
    with h5py.File(path, "r", libver="latest") as file:
        flat0, flat1 = name0.replace("/", "-"), name1.replace("/", "-")
        for pair, is_reversed in (
            (f"{flat0}/{flat1}", False),
            (f"{flat1}/{flat0}", True),
            (f"{flat0}_{flat1}", False),
            (f"{flat1}_{flat0}", True),
        ):
            if pair in file:
                matches0 = file[pair]["matches0"][()]
                kept = np.flatnonzero(matches0 != -1)
                found = np.stack([kept, matches0[kept]], axis=1)
                return found[:, ::-1] if is_reversed else found
    raise AssertionError(f"no pair {name0}, {name1}")


def paths(folder: Path) -> tuple[Path, Path, Path]:
    return folder / "matches.h5", folder / "out.h5", folder / "features.h5"


@pytest.mark.parametrize("separator", ["/", "_"])
@settings(max_examples=15)
@given(seed=st.integers(0, 10**6))
def test_every_pair_gets_the_verdicts_of_its_matches(
    tmp_path_factory: pytest.TempPathFactory, separator: str, seed: int
) -> None:
    source, target, keypoints = paths(tmp_path_factory.mktemp("hloc"))
    points, pairs = features(seed), some_pairs(seed)
    write_features(keypoints, points)
    write_matches(source, pairs, separator)
    summary = filter_hloc(source, target, DelaunayFilter(), keypoints)
    assert summary.num_pairs == len(pairs)
    assert summary.num_matches == sum(int((arrays["matches0"] >= 0).sum()) for arrays in pairs.values())
    with h5py.File(target) as result:
        for names, arrays in pairs.items():
            group = result[separator.join(name.replace("/", "-") for name in names)]
            matches, rows = to_matches(names, arrays, points)
            verdict = expected(matches)
            np.testing.assert_array_equal(group["inlier"][()][rows], verdict.inlier)
            np.testing.assert_array_equal(group["score"][()][rows], verdict.score.astype(np.float32))
            np.testing.assert_array_equal(group["relation"][()][rows], verdict.relation)
            unmatched = arrays["matches0"] < 0
            for name, dtype in (("inlier", np.bool_), ("score", np.float32), ("relation", np.int8)):
                assert group[name].dtype == dtype
                assert not group[name][()][unmatched].any()
            kept = np.where(unmatched | group["inlier"][()], arrays["matches0"], -1)
            np.testing.assert_array_equal(group["matches0"][()], kept)
            assert group["matches0"].dtype == arrays["matches0"].dtype
            np.testing.assert_array_equal(group["putative_matches0"][()], arrays["matches0"])


@pytest.mark.parametrize("separator", ["/", "_"])
def test_hloc_reads_the_inliers_in_either_order(tmp_path: Path, separator: str) -> None:
    source, target, keypoints = paths(tmp_path)
    one, two, _ = IMAGES
    points, arrays = features(1), partners(1)
    write_features(keypoints, points)
    write_matches(source, {(one, two): arrays}, separator)
    summary = filter_hloc(source, target, DelaunayFilter(), keypoints)
    matches, rows = to_matches((one, two), arrays, points)
    kept = rows[expected(matches).inlier]
    assert len(kept) == summary.num_kept > 0
    np.testing.assert_array_equal(read_as_hloc(target, one, two), np.stack([kept, arrays["matches0"][kept]], axis=1))
    np.testing.assert_array_equal(read_as_hloc(target, two, one), np.stack([arrays["matches0"][kept], kept], axis=1))


def test_blocks_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, target, keypoints = paths(tmp_path)
    write_features(keypoints, features(2))
    write_matches(source, some_pairs(2))
    filter_hloc(source, target, DelaunayFilter(), keypoints)
    for block in (1, 60):
        monkeypatch.setattr(verdicts, "BLOCK_MATCHES", block)
        other = tmp_path / f"{block}.h5"
        filter_hloc(source, other, DelaunayFilter(), keypoints)
        assert other.read_bytes() == target.read_bytes()


def test_everything_else_is_carried_through_and_a_second_run_replaces(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    one, two, _ = IMAGES
    write_features(keypoints, features(1))
    write_matches(source, {(one, two): partners(1)})
    with h5py.File(source, "r+") as file:
        file.attrs["matcher"] = "lightglue"
        group = file["db-1.jpg/db-2.jpg"]
        group.create_dataset("scores", data=np.arange(4.0), compression="gzip")
        compressed = group["matches0"][()]
        del group["matches0"]
        group.create_dataset("matches0", data=compressed, chunks=(7,), compression="gzip", shuffle=True)
        group["matches0"].attrs["note"] = 5
    before = source.read_bytes()
    first = filter_hloc(source, target, DelaunayFilter(), keypoints)
    second = filter_hloc(target, tmp_path / "again.h5", DelaunayFilter(), keypoints)
    assert source.read_bytes() == before
    assert 0 < second.num_matches == first.num_kept < first.num_matches
    with h5py.File(tmp_path / "again.h5") as file, h5py.File(target) as once:
        assert file.attrs["matcher"] == "lightglue"
        group = file["db-1.jpg/db-2.jpg"]
        assert group["scores"][()].tolist() == [0.0, 1.0, 2.0, 3.0]
        assert group["matches0"].attrs["note"] == 5
        assert group["matches0"].compression == "gzip"
        putative = once["db-1.jpg/db-2.jpg/matches0"][()]
        np.testing.assert_array_equal(group["putative_matches0"][()], putative)


def test_names_that_look_alike_are_refused_only_where_they_matter(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    points = features(4)
    one, two, three = IMAGES
    write_features(keypoints, {**points, "db-1.jpg": points[one]})
    write_matches(source, {(two, three): partners(4)})
    assert filter_hloc(source, target, DelaunayFilter(), keypoints).num_pairs == 1
    write_matches(source, {(one, two): partners(4)})
    message = r"matches\.h5: 'db-1\.jpg' must name one image of .*features\.h5, got \["
    with pytest.raises(ValueError, match=message):
        filter_hloc(source, target, DelaunayFilter(), keypoints)


def test_a_joined_name_must_split_in_one_way(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    points = features(5)["db/1.jpg"]
    write_features(keypoints, dict.fromkeys(("a", "a_b", "b_c", "c"), points))
    write_matches(source, {("a", "b_c"): partners(5)}, "_")
    with pytest.raises(ValueError, match=r"'a_b_c' must join two images of .*, 2 ways are known"):
        filter_hloc(source, target, DelaunayFilter(), keypoints)


def test_images_may_be_named_like_datasets(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    points = features(6)
    names = "keypoints/1.jpg", "matches0"
    write_features(keypoints, dict(zip(names, (points["db/1.jpg"], points["db/2.jpg"]), strict=True)))
    write_matches(source, {names: partners(6)})
    assert filter_hloc(source, target, DelaunayFilter(), keypoints).num_kept > 0


def test_a_file_without_pairs_passes(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    write_features(keypoints, {})
    write_matches(source, {})
    assert filter_hloc(source, target, DelaunayFilter(), keypoints) == verdicts.FilterSummary()
    with h5py.File(target) as result:
        assert len(result) == 0


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
        (change_group("matching_scores0", np.zeros(49)), "'matching_scores0' must have 50 rows, got 49"),
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
        filter_hloc(source, target, DelaunayFilter(), keypoints)
    assert str(tmp_path) in str(caught.value)
    assert (tmp_path / "secret").read_bytes() == bytes(100)
    assert not (tmp_path / "other.h5").exists()


def test_links_in_place_of_the_results_are_replaced_and_not_followed(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    write_features(keypoints, features(8))
    write_matches(source, {(IMAGES[0], IMAGES[1]): partners(8)})
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["a"] = np.zeros(50)
    before = (tmp_path / "other.h5").read_bytes()
    with h5py.File(source, "r+") as file:
        file["db-1.jpg/db-2.jpg/score"] = h5py.ExternalLink("other.h5", "/a")
        file["db-1.jpg/db-2.jpg/inlier"] = h5py.ExternalLink("none.h5", "/a")
    filter_hloc(source, target, DelaunayFilter(), keypoints)
    assert (tmp_path / "other.h5").read_bytes() == before
    with h5py.File(target) as result:
        group = result["db-1.jpg/db-2.jpg"]
        assert all(isinstance(group.get(name, getlink=True), h5py.HardLink) for name in ("score", "inlier"))


def test_damaged_files_are_named(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    write_features(keypoints, features(9))
    write_matches(source, {(IMAGES[0], IMAGES[1]): partners(9)})
    for path in (source, keypoints):
        data = path.read_bytes()
        for damaged in (data[: len(data) // 2], data[:30] + bytes(60) + data[90:], b""):
            path.write_bytes(damaged)
            with pytest.raises(ValueError, match=path.name):
                filter_hloc(source, target, DelaunayFilter(), keypoints)
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
        filter_hloc(source, target, DelaunayFilter(), keypoints)


def test_the_error_without_h5py_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(ImportError, match=r"h5py must be installed to read matches\.h5"):
        filter_hloc(tmp_path / "matches.h5", tmp_path / "out.h5", DelaunayFilter(), tmp_path / "features.h5")


def test_the_limit_is_the_one_of_the_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, target, keypoints = paths(tmp_path)
    write_features(keypoints, features(10))
    write_matches(source, {(IMAGES[0], IMAGES[1]): partners(10)})
    monkeypatch.setattr(hloc, "MAX_ROWS", 49)
    with pytest.raises(ValueError, match="must have at most 49 rows, got 50"):
        filter_hloc(source, target, DelaunayFilter(), keypoints)
