from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tensor_stereo.interop import verdicts
from tensor_stereo.interop.hdf5_matches import filter_hdf5
from tests.interop.hloc_files import (
    IMAGES,
    features,
    partners,
    paths,
    read_as_hloc,
    some_pairs,
    to_matches,
    write_features,
    write_matches,
)
from tests.interop.match_batches import exact_filter, expected_exactly

h5py = pytest.importorskip("h5py", reason="h5py is not installed")


@pytest.mark.filterwarnings("ignore::tensor_stereo.scores.DomainWarning")  # not all of the pairs agree
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
    summary = filter_hdf5(source, target, exact_filter(), keypoints)
    assert summary.num_pairs == len(pairs)
    assert summary.num_matches == sum(int((arrays["matches0"] >= 0).sum()) for arrays in pairs.values())
    with h5py.File(target) as result:
        for names, arrays in pairs.items():
            group = result[separator.join(name.replace("/", "-") for name in names)]
            matches, rows = to_matches(names, arrays, points)
            verdict = expected_exactly(matches)
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
    summary = filter_hdf5(source, target, exact_filter(), keypoints)
    matches, rows = to_matches((one, two), arrays, points)
    kept = rows[expected_exactly(matches).inlier]
    assert len(kept) == summary.num_kept > 0
    np.testing.assert_array_equal(read_as_hloc(target, one, two), np.stack([kept, arrays["matches0"][kept]], axis=1))
    np.testing.assert_array_equal(read_as_hloc(target, two, one), np.stack([arrays["matches0"][kept], kept], axis=1))


def test_blocks_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, target, keypoints = paths(tmp_path)
    write_features(keypoints, features(2))
    write_matches(source, some_pairs(2))
    filter_hdf5(source, target, exact_filter(), keypoints)
    for block in (1, 60):
        monkeypatch.setattr(verdicts, "BLOCK_MATCHES", block)
        other = tmp_path / f"{block}.h5"
        filter_hdf5(source, other, exact_filter(), keypoints)
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
    first = filter_hdf5(source, target, exact_filter(), keypoints)
    second = filter_hdf5(target, tmp_path / "again.h5", exact_filter(), keypoints)
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
    assert filter_hdf5(source, target, exact_filter(), keypoints).num_pairs == 1
    write_matches(source, {(one, two): partners(4)})
    message = r"matches\.h5: 'db-1\.jpg' must name one image of .*features\.h5, got \["
    with pytest.raises(ValueError, match=message):
        filter_hdf5(source, target, exact_filter(), keypoints)


def test_a_joined_name_must_split_in_one_way(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    points = features(5)["db/1.jpg"]
    write_features(keypoints, dict.fromkeys(("a", "a_b", "b_c", "c"), points))
    write_matches(source, {("a", "b_c"): partners(5)}, "_")
    with pytest.raises(ValueError, match=r"'a_b_c' must join two images of .*, 2 ways are known"):
        filter_hdf5(source, target, exact_filter(), keypoints)


def test_images_may_be_named_like_datasets(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    points = features(6)
    names = "keypoints/1.jpg", "matches0"
    write_features(keypoints, dict(zip(names, (points["db/1.jpg"], points["db/2.jpg"]), strict=True)))
    write_matches(source, {names: partners(6)})
    assert filter_hdf5(source, target, exact_filter(), keypoints).num_kept > 0


def test_a_file_without_pairs_passes(tmp_path: Path) -> None:
    source, target, keypoints = paths(tmp_path)
    write_features(keypoints, {})
    write_matches(source, {})
    assert filter_hdf5(source, target, exact_filter(), keypoints) == verdicts.FilterSummary()
    with h5py.File(target) as result:
        assert len(result) == 0
