from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import polars as pl
import pytest

from tensor_stereo.datasets import find_pairs, read_pair, write_pfm
from tensor_stereo.datasets.manifest import SCHEMA, build_manifest, read_manifest, write_manifest
from tests.awkward_names import NAMES


def _scene(folder: Path) -> None:
    folder.mkdir(parents=True)
    for name in ("view1.ppm", "view5.ppm", "disp1.pgm"):
        (folder / name).write_bytes(b"P6 64 48 255 ")


def _list(folder: Path, text: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("a.ppm", "b.ppm", "c.ppm", "d.pgm"):
        (folder / name).write_bytes(b"P6 7 5 255 ")
    path = folder / "mine.csv"
    path.write_text(text)
    return path


def test_a_manifest_holds_what_find_pairs_finds(tmp_path: Path) -> None:
    for name in ("Books", "Art"):
        _scene(tmp_path / "2005" / name)
    manifest = build_manifest([tmp_path])
    assert dict(manifest.schema) == SCHEMA
    assert manifest["width_px"].to_list() == [64, 64]
    write_manifest(manifest, tmp_path / "out" / "m.parquet")
    assert read_manifest(tmp_path / "out" / "m.parquet") == find_pairs(tmp_path)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["m.parquet"]


def test_pairs_below_several_roots_count_once(tmp_path: Path) -> None:
    _scene(tmp_path / "2005" / "Art")
    one = build_manifest([tmp_path])
    assert build_manifest([tmp_path, tmp_path / "2005", tmp_path / "2005" / "Art"]).equals(one)


def test_real_folders_survive_the_round_trip(data_root: Path, tmp_path: Path) -> None:
    write_manifest(build_manifest([data_root]), tmp_path / "m.parquet")
    assert read_manifest(tmp_path / "m.parquet") == find_pairs(data_root.resolve())


def test_a_list_names_pairs_relative_to_its_folder(tmp_path: Path) -> None:
    path = _list(tmp_path / "x", "image0,image1,disparity_gt,gt_scale,scene\na.ppm,b.ppm,d.pgm,4,one\nb.ppm,c.ppm,,,\n")
    first, second = build_manifest([path]).rows(named=True)
    assert first["dataset"] == second["dataset"] == "mine"
    by_scene = {row["scene"]: row for row in (first, second)}
    assert by_scene["one"]["gt_scale"] == 4.0
    assert by_scene["one"]["disparity_gt"] == str(tmp_path / "x" / "d.pgm")
    assert by_scene["b"]["disparity_gt"] is None
    assert by_scene["b"]["height_px"] == 5


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("image0\na.ppm\n", ValueError, "no column 'image1'"),
        ("image0,image1\na.ppm,\n", ValueError, "line 2: column 'image1' is empty"),
        ("image0,image1\na.ppm,b.ppm\na.ppm,z.ppm\n", FileNotFoundError, "line 3: column 'image1'"),
        ("image0,image1,left\na.ppm,b.ppm,1\n", ValueError, "unknown column 'left'"),
        ("image0,image1,gt_scale\na.ppm,b.ppm,-1\n", ValueError, "line 2: column 'gt_scale'"),
        ("image0,image1,gt_scale\na.ppm,b.ppm,x\n", ValueError, "line 2: column 'gt_scale'"),
        ("image0,image1,disparity_gt\na.ppm,b.ppm,d.pgm\n", ValueError, "column 'gt_scale' is empty"),
        ("image0,image1\na.ppm,b.ppm\na.ppm,c.ppm\n", ValueError, "two pairs are named mine/a"),
    ],
)
def test_a_wrong_list_names_file_row_and_column(
    tmp_path: Path, text: str, error: type[Exception], message: str
) -> None:
    path = _list(tmp_path, text)
    with pytest.raises(error, match=message) as caught:
        build_manifest([path])
    assert "mine" in str(caught.value)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("image0", "/no/such/file.png", "row 2: column 'image0' names /no/such/file.png"),
        ("scene", None, "row 2: column 'scene' is empty"),
        ("gt_scale", -3.0, "row 2: column 'gt_scale' must be positive"),
        ("width_px", 0, "row 2: column 'width_px' must be positive"),
        ("dataset", "middlebury-2005", None),
    ],
)
def test_a_wrong_manifest_names_file_row_and_column(
    tmp_path: Path, column: str, value: object, message: str | None
) -> None:
    for name in ("Art", "Books"):
        _scene(tmp_path / "2005" / name)
    manifest = build_manifest([tmp_path])
    values = manifest[column].to_list()
    values[1] = value
    path = tmp_path / "m.parquet"
    write_manifest(manifest.with_columns(pl.Series(column, values, dtype=SCHEMA[column])), path)
    if message is None:
        assert len(read_manifest(path)) == 2
        return
    with pytest.raises(ValueError, match=message) as caught:
        read_manifest(path)
    assert str(path) in str(caught.value)


def test_what_is_no_manifest_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.parquet").touch()
    pl.DataFrame({"image0": [1]}).write_parquet(tmp_path / "other.parquet")
    with pytest.raises(FileNotFoundError, match="no manifest"):
        read_manifest(tmp_path / "none.parquet")
    with pytest.raises(ValueError, match="no readable Parquet"):
        read_manifest(tmp_path / "empty.parquet")
    with pytest.raises(ValueError, match="no column 'dataset'"):
        read_manifest(tmp_path / "other.parquet")
    with pytest.raises(ValueError, match=r"must end in \.parquet"):
        write_manifest(pl.DataFrame(schema=SCHEMA), tmp_path / "m.csv")
    with pytest.raises(ValueError, match="at least one"):
        build_manifest([])
    with pytest.raises(TypeError, match="sequence of paths"):
        build_manifest(str(tmp_path))  # type: ignore[arg-type]


def test_a_name_says_nothing_of_the_encoding(tmp_path: Path) -> None:
    """A list of one's own that is named after a release with maps in colours."""
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), np.full((4, 5), 9, np.uint8))
    write_pfm(tmp_path / "d.pfm", np.full((4, 5), 2, np.float32))
    (tmp_path / "sintel-mine.csv").write_text("image0,image1,disparity_gt\na.png,b.png,d.pfm\n")
    write_manifest(build_manifest([tmp_path / "sintel-mine.csv"]), tmp_path / "m.parquet")
    pair = read_pair(read_manifest(tmp_path / "m.parquet")[0])
    assert pair.disparity_gt is not None
    assert (pair.disparity_gt == 2).all()
    (tmp_path / "wrong.csv").write_text("image0,image1,gt_encoding\na.png,b.png,colour\n")
    with pytest.raises(ValueError, match=r"wrong\.csv, line 2: column 'gt_encoding'.*'colour'"):
        build_manifest([tmp_path / "wrong.csv"])


@pytest.mark.parametrize("name", NAMES)
def test_files_of_any_name_are_indexed_and_read(tmp_path: Path, name: str) -> None:
    """In folders of a release and in lists, beside what the name would match if it were a pattern."""
    values = {"view1.png": 10, "view5.png": 20}
    scene, other = tmp_path / name / "2005" / name, tmp_path / "2005" / "run 1"
    for folder, offset in ((scene, 0), (other, 100)):
        folder.mkdir(parents=True)
        for file, value in values.items():
            cv2.imwrite(str(folder / file), np.full((4, 5), value + offset, np.uint8))
    for ending, value in ((".a.png", 30), (".b.png", 40)):
        (tmp_path / name / f"{name}{ending}").write_bytes(cv2.imencode(".png", np.full((4, 5), value, np.uint8))[1])
    listed = pl.DataFrame({"image0": [f"{name}.a.png"], "image1": [f"{name}.b.png"], "dataset": ["listed"]})
    path = tmp_path / name / f"{name}.csv"
    with path.open("wb") as file:
        listed.write_csv(file)
    target = tmp_path / name / f"{name}.parquet"
    write_manifest(build_manifest([tmp_path / name, path]), target)
    found = {files.dataset: (files, read_pair(files)) for files in read_manifest(target)}
    assert set(found) == {"middlebury-2005", "listed"}
    assert found["middlebury-2005"][0].scene == name
    assert found["listed"][0].scene == f"{name}.a"
    for dataset, expected in (("middlebury-2005", (10, 20)), ("listed", (30, 40))):
        pair = found[dataset][1]
        assert (int(pair.image0[0, 0, 0]), int(pair.image1[0, 0, 0])) == expected


@pytest.mark.parametrize("bits", ["12", " 12", "12.0", " 12.0 "])
def test_blanks_and_decimals_in_a_list_do_not_count(tmp_path: Path, bits: str) -> None:
    path = _list(
        tmp_path,
        "image0, image1 ,disparity_gt,gt_scale,gt_encoding,sample_bits,scene\n"
        f" a.ppm ,b.ppm,\td.pgm, 8.0 , scaled,{bits}, one \n\n",
    )
    [row] = build_manifest([path]).rows(named=True)
    assert (row["gt_scale"], row["gt_encoding"], row["sample_bits"], row["scene"]) == (8.0, "scaled", 12, "one")
    assert row["image0"] == str((tmp_path / "a.ppm").resolve())


@pytest.mark.parametrize("bits", ["7", "17", "12.5", "x", "nan", "inf"])
def test_wrong_bits_in_a_list_name_file_line_and_column(tmp_path: Path, bits: str) -> None:
    path = _list(tmp_path, f"image0,image1,sample_bits\na.ppm,b.ppm,{bits}\n")
    with pytest.raises(ValueError, match=r"mine\.csv, line 2: column 'sample_bits'"):
        build_manifest([path])


def test_bits_of_samples_go_through_a_manifest(tmp_path: Path) -> None:
    _scene(tmp_path / "2005" / "Art")
    path = _list(tmp_path / "x", "image0,image1,sample_bits\na.ppm,b.ppm,10\nb.ppm,c.ppm,\n")
    write_manifest(build_manifest([tmp_path / "2005", path], sample_bits=12), tmp_path / "m.parquet")
    pairs = {pair.scene: pair.sample_bits for pair in read_manifest(tmp_path / "m.parquet")}
    assert pairs == {"Art": 12, "a": 10, "b": 12}
    with pytest.raises(ValueError, match="sample_bits must lie in"):
        build_manifest([path], sample_bits=3)


def test_a_manifest_of_before_has_no_bits(tmp_path: Path) -> None:
    _scene(tmp_path / "2005" / "Art")
    write_manifest(build_manifest([tmp_path]).drop("sample_bits"), tmp_path / "m.parquet")
    assert read_manifest(tmp_path / "m.parquet") == find_pairs(tmp_path)


def test_wrong_bits_in_a_manifest_name_row_and_column(tmp_path: Path) -> None:
    _scene(tmp_path / "2005" / "Art")
    manifest = build_manifest([tmp_path]).with_columns(pl.lit(33, dtype=pl.Int32).alias("sample_bits"))
    write_manifest(manifest, tmp_path / "m.parquet")
    with pytest.raises(ValueError, match=r"row 1: column 'sample_bits' must lie in \[8, 16\], got 33"):
        read_manifest(tmp_path / "m.parquet")
