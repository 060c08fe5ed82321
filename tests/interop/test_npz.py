from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tensor_stereo import Matches
from tensor_stereo.batching import split_matches
from tensor_stereo.interop import npz
from tensor_stereo.interop.npz import filter_npz
from tests.interop.match_batches import batch, exact_filter, expected_exactly


def arrays_of(matches: Matches) -> dict[str, np.ndarray]:
    names = ("keypoints0", "keypoints1", "ptr", "cost", "group")
    values = {name: getattr(matches, name) for name in names}
    return {name: value.numpy() for name, value in values.items() if value is not None}


def filtered(folder: Path, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    source, target = folder / "in.npz", folder / "out.npz"
    np.savez(source, **arrays)  # type: ignore[arg-type]
    filter_npz(source, target, exact_filter())
    with np.load(target, allow_pickle=False) as result:
        return dict(result)


def header(shape: object, descr: str = "<f8") -> bytes:
    """The first bytes of an array file that claims this shape, whatever it is."""
    text = repr({"descr": descr, "fortran_order": False, "shape": shape}).encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def write_archive(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def array_file(values: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values)
    return buffer.getvalue()


GOOD = {f"keypoints{view}.npy": array_file(np.arange(12.0).reshape(6, 2)) for view in (0, 1)}


@pytest.mark.parametrize("has_group", [False, True])
def test_rows_get_the_verdicts_of_the_same_matches(tmp_path: Path, has_group: bool) -> None:
    matches = batch(3, has_group=has_group)
    arrays = arrays_of(matches)
    result = filtered(tmp_path, arrays)
    assert set(result) == {*arrays, "inlier", "score", "relation"}
    for name, values in arrays.items():
        np.testing.assert_array_equal(result[name], values)
    for name, values in expected_exactly(matches)._asdict().items():
        assert result[name].dtype == values.dtype
        np.testing.assert_array_equal(result[name], values)


def test_one_pair_needs_no_offsets_and_a_batch_is_its_pairs(tmp_path: Path) -> None:
    matches = batch(4)
    whole = filtered(tmp_path, arrays_of(matches))
    parts = []
    for item in split_matches(matches):
        arrays = arrays_of(item)
        del arrays["ptr"]
        parts.append(filtered(tmp_path, arrays))
    for name in ("inlier", "score", "relation"):
        np.testing.assert_array_equal(np.concatenate([part[name] for part in parts]), whole[name])


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<f2", "<i4", "<u2"])
def test_keypoints_of_other_types_are_taken_by_value(tmp_path: Path, dtype: str) -> None:
    arrays = {name: np.round(np.abs(values)) for name, values in arrays_of(batch(5)).items() if name != "ptr"}
    arrays = {name: np.asfortranarray(values) for name, values in arrays.items() if name != "cost"}
    plain = filtered(tmp_path, arrays)
    other = filtered(tmp_path, {name: values.astype(dtype) for name, values in arrays.items()})
    for name in ("inlier", "score", "relation"):
        np.testing.assert_array_equal(other[name], plain[name])


@given(st.integers(0, 10**6), st.booleans())
def test_partners_of_keypoints_get_a_verdict_each(
    tmp_path_factory: pytest.TempPathFactory, seed: int, has_scores: bool
) -> None:
    rng = np.random.default_rng(seed)
    matches = batch(seed, [40])
    # The matches of a batch, scattered over more keypoints than are matched.
    rows0, rows1 = rng.permutation(50)[:40], rng.permutation(45)[:40]
    points0, points1 = np.full((50, 2), np.nan), np.full((45, 2), np.nan)
    points0[rows0], points1[rows1] = matches.keypoints0, matches.keypoints1
    matches0 = rng.integers(-2, 0, 50)
    matches0[rows0] = rows1
    arrays = {"keypoints0": points0, "keypoints1": points1, "matches0": matches0}
    if has_scores:
        arrays["matching_scores0"] = rng.random(50)
    result = filtered(tmp_path_factory.mktemp("npz"), arrays)
    np.testing.assert_array_equal(result["matches0"], matches0)
    order = np.argsort(rows0)
    cost = torch.from_numpy(1 - arrays["matching_scores0"][rows0[order]]) if has_scores else None
    same = Matches(matches.keypoints0[order], matches.keypoints1[order], matches.ptr, cost)
    for name, values in expected_exactly(same)._asdict().items():
        np.testing.assert_array_equal(result[name][rows0[order]], values)
        assert result[name].shape == (50,)
        assert not result[name][matches0 < 0].any()


def test_other_arrays_and_their_compression_are_carried_through(tmp_path: Path) -> None:
    extra = {"names": np.array(["a", "ü"]), "empty": np.zeros((0, 7), dtype=np.float16), "scalar": np.array(3)}
    source, target = tmp_path / "in.npz", tmp_path / "out.npz"
    np.savez_compressed(source, **arrays_of(batch(6)), **extra)  # type: ignore[arg-type]
    filter_npz(source, target, exact_filter())
    with np.load(target, allow_pickle=False) as result:
        for name, values in extra.items():
            np.testing.assert_array_equal(result[name], values)
    with zipfile.ZipFile(target) as archive:
        assert {info.compress_type for info in archive.infolist()} == {zipfile.ZIP_DEFLATED}


def test_filtering_twice_replaces_the_verdicts(tmp_path: Path) -> None:
    first = filtered(tmp_path, arrays_of(batch(7)))
    second = filtered(tmp_path, first)
    assert first.keys() == second.keys()
    for name, values in first.items():
        np.testing.assert_array_equal(second[name], values)


def test_no_matches_give_empty_verdicts(tmp_path: Path) -> None:
    nothing = {"keypoints0": np.zeros((0, 2)), "keypoints1": np.zeros((0, 2))}
    assert filtered(tmp_path, nothing)["inlier"].shape == (0,)
    assert filtered(tmp_path, {**nothing, "ptr": np.array([0, 0, 0])})["score"].shape == (0,)
    unmatched = {"keypoints0": np.zeros((3, 2)), "keypoints1": np.zeros((0, 2)), "matches0": np.full(3, -1)}
    assert filtered(tmp_path, unmatched)["relation"].tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"keypoints1": None}, "must hold the array 'keypoints1', it has"),
        ({"keypoints0": np.zeros((3, 3))}, r"array 'keypoints0' must have shape \(N, 2\).*, got \(3, 3\)"),
        ({"keypoints0": np.zeros((3, 2))}, "in.npz: keypoints1 must have 3 rows as keypoints0 has, got 6"),
        ({"keypoints0": np.zeros((6, 2), dtype=complex)}, "array 'keypoints0' must hold numbers, got complex128"),
        ({"keypoints0": np.zeros((6, 2), dtype=bool)}, "array 'keypoints0' must hold numbers, got bool"),
        ({"keypoints0": np.zeros((6, 2), dtype=object)}, "array 'keypoints0' holds Python objects"),
        ({"ptr": np.array([0, 5])}, "in.npz: ptr must rise from 0 to the number of rows 6"),
        ({"ptr": np.array([0.0, 6.0])}, "array 'ptr' must hold integers, got float64"),
        ({"group": np.zeros(5, dtype=int)}, "in.npz: group must have 6 rows as keypoints0 has, got 5"),
        ({"cost": np.full(6, np.nan)}, r"in.npz: cost, row 0 \(pair 0\), must not be NaN"),
        ({"matches0": np.zeros(6, dtype=int), "ptr": np.array([0, 6])}, "'ptr' has no meaning"),
        ({"matches0": np.full(6, 0.5)}, "array 'matches0' must hold integers, got 0.5"),
        ({"matches0": np.full(6, 6)}, "in.npz: matches0 must be -1, -2 or one of 6 keypoints1"),
        ({"matches0": np.zeros(6, dtype=int), "matching_scores0": np.zeros(5)}, "array 'matching_scores0' must have"),
    ],
)
def test_wrong_arrays_are_named(tmp_path: Path, change: dict[str, np.ndarray | None], message: str) -> None:
    points = np.arange(12.0).reshape(6, 2)
    arrays = {"keypoints0": points, "keypoints1": points, **change}
    with pytest.raises(ValueError, match=message):
        filtered(tmp_path, {name: values for name, values in arrays.items() if values is not None})


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e61, 1e-61])
@pytest.mark.parametrize("name", ["keypoints0", "keypoints1"])
def test_keypoints_out_of_range_are_named_by_row_and_pair(tmp_path: Path, name: str, value: float) -> None:
    arrays = arrays_of(batch(0, [10, 10, 10]))
    arrays[name][23, 1] = value
    with pytest.raises(ValueError, match=rf"in\.npz: {name}, row 23 \(pair 2\), must be finite"):
        filtered(tmp_path, arrays)


@pytest.mark.parametrize(
    ("members", "message"),
    [
        # Terabytes in the header, 8 bytes in the member.
        ({"keypoints0.npy": header((10**12, 2)) + bytes(8)}, r"'keypoints0' claims 16000000000000 bytes .* holds 8"),
        ({"keypoints0.npy": header((1, 2)) + bytes(24)}, "'keypoints0' claims 16 bytes .* holds 24"),
        ({"keypoints0.npy": header((-1, 2))}, "'keypoints0' has no readable header: its shape must not be negative"),
        ({"keypoints0.npy": header((10**30, 0))}, "'keypoints0' must have at most 67108864 rows"),
        ({"keypoints0.npy": header("x")}, "'keypoints0' has no readable header"),
        ({"keypoints0.npy": header((1, 2), "<q9")}, "'keypoints0' has no readable header"),
        ({"keypoints0.npy": header((1,), "|O") + b"cos\nsystem\n(S'false'\ntR."}, "'keypoints0' holds Python objects"),
        ({"keypoints0.npy": b"\x93NUMPY\x02\x00\xff\xff\xff\xff{"}, "'keypoints0' has no readable header"),
        ({"keypoints0.npy": b"\x93NUMPY\x03\x00\x01\x00\x00\x00{"}, "'keypoints0' has no readable header: its version"),
        ({"keypoints0.npy": b"\x93NUMPY\x01\x00\x10\x27" + b"(" * 10000}, "'keypoints0' has no readable header"),
        ({"keypoints0.npy": b""}, "'keypoints0' has no readable header"),
        ({"../../keypoints2.npy": header((0,))}, r"must be named like 'keypoints0.npy', got '../../keypoints2.npy'"),
        ({"readme.txt": b""}, "must be named like 'keypoints0.npy', got 'readme.txt'"),
    ],
)
def test_lying_headers_and_names_are_refused(tmp_path: Path, members: dict[str, bytes], message: str) -> None:
    source = write_archive(tmp_path / "in.npz", {**GOOD, **members})
    with pytest.raises(ValueError, match=message) as caught:
        filter_npz(source, tmp_path / "out.npz", exact_filter())
    assert str(source) in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["in.npz"]


def test_more_rows_than_the_limit_are_refused_before_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(npz, "MAX_ROWS", 5)
    source = write_archive(tmp_path / "in.npz", GOOD)
    with pytest.raises(ValueError, match="array 'keypoints0' must have at most 5 rows, got 6"):
        filter_npz(source, tmp_path / "out.npz", exact_filter())


@pytest.mark.parametrize(("field", "size", "claimed"), [(24, 2**32 - 2, 2**32 - 2), (20, 2**20, 10**6 + 128)])
def test_sizes_that_the_archive_cannot_hold_are_refused(tmp_path: Path, field: int, size: int, claimed: int) -> None:
    source = write_archive(tmp_path / "in.npz", {**GOOD, "z.npy": header((10**6,), "|u1") + bytes(10**6)})
    data = bytearray(source.read_bytes())
    entry = data.rindex(b"PK\x01\x02")  # the directory's record of z.npy, which has its size packed and unpacked
    data[entry + field : entry + field + 4] = size.to_bytes(4, "little")
    source.write_bytes(data)
    with pytest.raises(ValueError, match=f"array 'z' claims {claimed} bytes, which the archive cannot hold"):
        filter_npz(source, tmp_path / "out.npz", exact_filter())


def test_a_name_that_occurs_twice_is_refused(tmp_path: Path) -> None:
    source = write_archive(tmp_path / "in.npz", GOOD)
    with zipfile.ZipFile(source, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("keypoints0.npy", GOOD["keypoints0.npy"])
    with pytest.raises(ValueError, match="holds the array 'keypoints0' twice"):
        filter_npz(source, tmp_path / "out.npz", exact_filter())


def test_other_compressions_are_refused(tmp_path: Path) -> None:
    source = write_archive(tmp_path / "in.npz", GOOD, zipfile.ZIP_LZMA)
    with pytest.raises(ValueError, match="array 'keypoints0' must be stored or deflated"):
        filter_npz(source, tmp_path / "out.npz", exact_filter())


def test_damaged_data_is_noticed(tmp_path: Path) -> None:
    source = write_archive(tmp_path / "in.npz", GOOD, zipfile.ZIP_STORED)
    data = source.read_bytes()
    place = data.index(np.array(5.0).tobytes())
    source.write_bytes(data[:place] + b"\x01" + data[place + 1 :])
    with pytest.raises(ValueError, match=r"in\.npz is no readable archive: Bad CRC-32"):
        filter_npz(source, tmp_path / "out.npz", exact_filter())
    source.write_bytes(data[:-30])
    with pytest.raises(ValueError, match=r"in\.npz is no readable archive"):
        filter_npz(source, tmp_path / "out.npz", exact_filter())
    source.write_bytes(data[40:])  # its directory points before its beginning
    with pytest.raises(ValueError, match="which the archive cannot hold"):
        filter_npz(source, tmp_path / "out.npz", exact_filter())


@pytest.mark.parametrize("text", [b"{'a':" * 1900, b"-" * 9000 + b"1", b"(" * 9000])
def test_a_header_nested_too_deeply_is_refused(tmp_path: Path, text: bytes) -> None:
    head = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text
    source = write_archive(tmp_path / "in.npz", {**GOOD, "z.npy": head})
    with pytest.raises(ValueError, match="array 'z' has no readable header"):
        filter_npz(source, tmp_path / "out.npz", exact_filter())


def test_headers_of_python_2_are_read(tmp_path: Path) -> None:
    """Its integers end in L."""
    points = array_file(np.arange(12.0).reshape(6, 2))
    old = points.replace(b"(6, 2), }", b"(6L, 2L)}")
    assert old != points
    source = write_archive(tmp_path / "in.npz", {**GOOD, "keypoints0.npy": old})
    assert filter_npz(source, tmp_path / "out.npz", exact_filter()).num_matches == 6
