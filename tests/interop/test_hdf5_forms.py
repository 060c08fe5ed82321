"""HDF5 files as DISK, tools after it and glue-factory write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tensor_stereo import Matches, filter_file
from tensor_stereo.configs import FileFilterConfig
from tensor_stereo.interop.glue_factory import two_view_filter
from tensor_stereo.interop.hdf5_matches import filter_hdf5
from tests.interop.hloc_files import IMAGES, features, paths, write_features, write_matches
from tests.interop.match_batches import exact_filter, expected_exactly

h5py = pytest.importorskip("h5py", reason="h5py is not installed")

NAMES = tuple(Path(name).stem for name in IMAGES)  # DISK names an image by its file without ending


def write_disk_keypoints(path: Path, seed: int) -> dict[str, np.ndarray]:
    """What ``detect.py`` of DISK writes: one dataset per image."""
    keypoints = {name: values.astype(np.float32) for name, values in zip(NAMES, features(seed).values(), strict=True)}
    with h5py.File(path, "w") as file:
        for name, points in keypoints.items():
            file.create_dataset(name, data=points)
    return keypoints


def disk_pairs(seed: int) -> dict[tuple[str, str], np.ndarray]:
    """(S, 2) rows of both images, one pair with two matches and one with none."""
    rng = np.random.default_rng(seed)
    one, two, three = NAMES
    rows = {
        (one, two): np.stack([rng.permutation(50)[:40], rng.permutation(50)[:40]], 1),
        (one, three): np.repeat(np.arange(50)[:, None], 2, 1),
        (two, three): np.array([[1, 4], [3, 3]]),
        (three, two): np.zeros((0, 2), dtype=np.int64),
    }
    rows[one, two][:30, 1] = rows[one, two][:30, 0]
    return rows


def write_disk_matches(path: Path, pairs: dict[tuple[str, str], np.ndarray], dtype: str, in_rows: bool) -> None:
    """What ``match.py`` of DISK writes, (2, S), or what tools after it write, (S, 2)."""
    with h5py.File(path, "w") as file:
        for (name0, name1), rows in pairs.items():
            values = rows if in_rows else rows.T
            dataset = file.require_group(name0).create_dataset(name1, data=values.astype(dtype))
            dataset.attrs["origin"] = "test"


@pytest.mark.parametrize("in_rows", [False, True])
@pytest.mark.parametrize("dtype", ["int64", "uint16"])
def test_disk_keeps_the_inliers_and_the_attributes_hold_the_rest(tmp_path: Path, in_rows: bool, dtype: str) -> None:
    source, target, keypoints = paths(tmp_path)
    points, pairs = write_disk_keypoints(keypoints, 4), disk_pairs(4)
    write_disk_matches(source, pairs, dtype, in_rows)
    summary = filter_hdf5(source, target, exact_filter(), keypoints)
    assert (summary.num_pairs, summary.num_matches) == (4, 92)
    with h5py.File(target, "r") as file:
        assert set(file) == {name0 for name0, _ in pairs}
        for (name0, name1), rows in pairs.items():
            left, right = (
                torch.from_numpy(points[name][rows[:, view]].astype(np.float64))
                for view, name in enumerate((name0, name1))
            )
            expected = expected_exactly(Matches(left, right, torch.tensor([0, len(rows)])))
            dataset = file[name0][name1]
            kept = dataset[()] if in_rows else dataset[()].T
            np.testing.assert_array_equal(kept, rows[expected.inlier])
            assert dataset.dtype == dtype
            putative = dataset.attrs["putative_matches"]
            np.testing.assert_array_equal(putative if in_rows else putative.T, rows)
            np.testing.assert_array_equal(dataset.attrs["inlier"], expected.inlier)
            assert expected.score is not None
            np.testing.assert_array_equal(dataset.attrs["score"], expected.score.astype(np.float32))
            np.testing.assert_array_equal(dataset.attrs["relation"], expected.relation)
            assert dataset.attrs["origin"] == "test"
    assert 0 < summary.num_kept < summary.num_matches


def test_many_matches_fit_into_the_attributes(tmp_path: Path) -> None:
    """An attribute beyond 64 KB needs the format of HDF5 1.8."""
    source, target, keypoints = paths(tmp_path)
    grid = np.stack(np.meshgrid(np.arange(0.0, 1000, 10), np.arange(0.0, 1000, 10)), -1).reshape(-1, 2)
    grid += np.random.default_rng(0).uniform(0, 4, grid.shape)
    with h5py.File(keypoints, "w") as file:
        file["a"], file["b"] = grid, grid - [7, 0]
    rows = np.repeat(np.arange(len(grid))[None], 2, 0)
    with h5py.File(source, "w") as file:
        file["a/b"] = rows
    assert filter_hdf5(source, target, exact_filter(), keypoints).num_kept == len(grid)
    with h5py.File(target, "r") as file:
        np.testing.assert_array_equal(file["a/b"].attrs["putative_matches"], rows)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((2, 3), dtype=np.int64) + 50, r"pair '1/2': matches must be -1, -2 or one of 50 keypoints0, got 50"),
        (np.zeros((3, 5), dtype=np.int64), r"must have shape \(N, 2\), got \(3, 5\)"),
        (np.zeros((2, 5)), "must be a group with the dataset 'matches0'"),
        (np.zeros(5, dtype=np.int64), "must be a group with the dataset 'matches0'"),
    ],
)
def test_wrong_matches_of_disk_are_named_by_pair(tmp_path: Path, values: np.ndarray, message: str) -> None:
    source, target, keypoints = paths(tmp_path)
    write_disk_keypoints(keypoints, 0)
    with h5py.File(source, "w") as file:
        file[f"{NAMES[0]}/{NAMES[1]}"] = values
    with pytest.raises(ValueError, match=message):
        filter_hdf5(source, target, exact_filter(), keypoints)


def test_an_image_that_disk_did_not_see_is_named(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    write_disk_keypoints(keypoints, 0)
    with h5py.File(source, "w") as file:
        file["1/9"] = np.zeros((2, 5), dtype=np.int64)
    with pytest.raises(ValueError, match=r"'9' must name one image of .*features\.h5, got none"):
        filter_hdf5(source, target, exact_filter(), keypoints)


def exported(seed: int) -> dict[str, np.ndarray]:
    """The predictions of one pair, in half precision as an option of glue-factory leaves them."""
    rng = np.random.default_rng(seed)
    left, right = list(features(seed).values())[:2]
    matches0, matches1 = np.full(50, -1), np.full(50, -1)
    rows0 = rng.permutation(50)[:40]
    rows1 = rows0.copy()
    rows1[:8] = np.roll(rows1[:8], 1)
    matches0[rows0], matches1[rows1] = rows1, rows0
    scores = {f"matching_scores{view}": rng.random(50).astype(np.float16) for view in (0, 1)}
    return {"keypoints0": left, "keypoints1": right, "matches0": matches0, "matches1": matches1, **scores}


def write_exported(path: Path, pairs: dict[str, int]) -> dict[str, dict[str, np.ndarray]]:
    """What ``export_predictions`` of glue-factory writes: a group per pair, whose name may hold "/"."""
    arrays = {name: exported(seed) for name, seed in pairs.items()}
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            group = file.create_group(name)
            for key, value in values.items():
                group.create_dataset(key, data=value)
            group.create_dataset("keypoint_scores0", data=np.zeros(50))
    return arrays


def test_exports_of_glue_factory_need_no_other_file(tmp_path: Path) -> None:
    source, target, _ = paths(tmp_path)
    arrays = write_exported(source, {"v_wall/1_2": 1, "v_wall/1_3": 2, "plain": 3})
    summary = filter_file(source, target, config=FileFilterConfig(score="consensus"))
    assert (summary.num_pairs, summary.num_matches) == (3, 120)
    with h5py.File(target, "r") as file:
        for name, given in arrays.items():
            group = file[name]
            rows0 = np.flatnonzero(given["matches0"] >= 0)
            rows1 = given["matches0"][rows0]
            cost = torch.from_numpy(1 - given["matching_scores0"][rows0].astype(np.float64))
            left, right = (
                torch.from_numpy(given[f"keypoints{view}"][rows].astype(np.float64))
                for view, rows in enumerate((rows0, rows1))
            )
            expected = expected_exactly(Matches(left, right, torch.tensor([0, 40]), cost))
            np.testing.assert_array_equal(group["inlier"][()][rows0], expected.inlier)
            np.testing.assert_array_equal(group["relation"][()][rows0], expected.relation)
            matches0, matches1 = np.full(50, -1), np.full(50, -1)
            matches0[rows0[expected.inlier]] = rows1[expected.inlier]
            matches1[rows1[expected.inlier]] = rows0[expected.inlier]
            np.testing.assert_array_equal(group["matches0"][()], matches0)
            np.testing.assert_array_equal(group["matches1"][()], matches1)
            np.testing.assert_array_equal(group["putative_matches0"][()], given["matches0"])
            np.testing.assert_array_equal(group["matching_scores0"][()], given["matching_scores0"])
            assert 0 < expected.inlier.sum() < 40


def test_a_file_that_needs_keypoints_says_so_and_one_that_has_them_too(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    write_disk_keypoints(keypoints, 0)
    write_disk_matches(source, disk_pairs(0), "int64", in_rows=False)
    with pytest.raises(ValueError, match="keypoints must be given for files of hloc and DISK"):
        filter_file(source, target)
    write_exported(source, {"pair": 0})
    with pytest.raises(ValueError, match="'pair' holds its keypoints, as of glue-factory; leave keypoints out"):
        filter_file(source, target, keypoints=keypoints)


def change_export(name: str, values: Any) -> Any:
    def change(group: Any) -> None:
        if name in group:
            del group[name]
        if values is not None:
            group[name] = values

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (change_export("matches0", None), "pair 'a/b' has no dataset 'matches0'"),
        (change_export("matches1", np.arange(50)), "matches0 and matches1 must name the same matches"),
        (change_export("keypoints1", np.zeros((50, 3))), r"'keypoints1' must have shape \(N, 2\), got \(50, 3\)"),
        (change_export("matching_scores0", np.zeros(49)), r"'matching_scores0' must have shape \(50,\)"),
    ],
)
def test_wrong_exports_are_named_by_pair(tmp_path: Path, change: Any, message: str) -> None:
    source, target, _ = paths(tmp_path)
    write_exported(source, {"a/b": 0})
    with h5py.File(source, "r+") as file:
        change(file["a/b"])
    with pytest.raises(ValueError, match=message):
        filter_file(source, target)


def test_datasets_of_the_user_survive(tmp_path: Path) -> None:
    source, target, _ = paths(tmp_path)
    write_exported(source, {"a/b": 0})
    users = {"score": np.linspace(0, 1, 50), "inlier": np.arange(50)}
    with h5py.File(source, "r+") as file:
        for name, values in users.items():
            file["a/b"][name] = values
    for score in ("consensus", "none", "consensus"):
        filter_hdf5(source, target, two_view_filter(verdict="cardinality", score=score), None)
        target.replace(source)
        with h5py.File(source, "r") as file:
            group = file["a/b"]
            for name, values in users.items():
                np.testing.assert_array_equal(group[name][()], values)
            assert ("filter_score" in group) == (score != "none")
            assert {"filter_inlier", "relation"} <= set(group)


def test_attributes_of_the_user_survive(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    write_disk_keypoints(keypoints, 4)
    write_disk_matches(source, disk_pairs(4), "int64", in_rows=False)
    with h5py.File(source, "r+") as file:
        file["1/2"].attrs["score"] = 0.5
    for _ in range(2):
        filter_hdf5(source, target, exact_filter(), keypoints)
        target.replace(source)
    with h5py.File(source, "r") as file:
        attributes = file["1/2"].attrs
        assert attributes["score"] == 0.5
        assert len(attributes["filter_score"]) == len(attributes["inlier"])


def test_dense_matches_of_hloc_need_the_file_of_features(tmp_path: Path) -> None:
    """``match_dense.py`` leaves the keypoints of the dense matcher beside matches of the aggregated ones."""
    source, target, keypoints = paths(tmp_path)
    given = features(0)
    write_features(keypoints, given)
    matches0 = np.arange(50)
    write_matches(source, {IMAGES[:2]: {"matches0": matches0, "matching_scores0": np.ones(50)}})
    filter_file(source, target, keypoints=keypoints)
    with h5py.File(target, "r") as file:
        expected = file["db-1.jpg/db-2.jpg/matches0"][()]
    with h5py.File(source, "r+") as file:
        group = file["db-1.jpg/db-2.jpg"]
        for view in (0, 1):
            group[f"keypoints{view}"] = np.random.default_rng(view).uniform(0, 300, (80, 2))
        group["scores"] = np.ones(80)
    with pytest.raises(ValueError, match="keypoints must be given for files of hloc and DISK"):
        filter_file(source, target)
    filter_file(source, target, keypoints=keypoints)
    with h5py.File(target, "r") as file:
        np.testing.assert_array_equal(file["db-1.jpg/db-2.jpg/matches0"][()], expected)
    assert (expected >= 0).any()
