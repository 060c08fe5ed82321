"""Files of matches whose images are looked at, and whose matches are repaired and refined."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import torch

from tensor_stereo import DelaunayFilter, Matches
from tensor_stereo.configs import FileFilterConfig
from tensor_stereo.datasets.images import write_image
from tensor_stereo.datasets.synthetic.rendering import render_pair
from tensor_stereo.interop.match_files import filter_file
from tensor_stereo.interop.match_folders import filter_files
from tensor_stereo.modules import FilterOutput
from tensor_stereo.scores import Origin

IMAGES = ("left/a.png", "right/b.png")
NUM_FREE = 40  # keypoints of view 0 without a partner


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The images of a rendered pair."""
    root = tmp_path_factory.mktemp("images")
    pair = render_pair(2)
    for name, image in zip(IMAGES, (pair.image0, pair.image1), strict=True):
        (root / name).parent.mkdir()
        write_image(root / name, image)
    return root


@pytest.fixture(scope="module")
def points() -> tuple[np.ndarray, np.ndarray]:
    """Keypoints of both views in px that half precision holds; every fourth partner is wrong; some have none."""
    pair = render_pair(2)
    grid = np.stack(np.meshgrid(np.arange(60, 340, 14), np.arange(30, 270, 14)), -1).reshape(-1, 2).astype(np.float64)
    disparity = pair.disparity_gt.numpy()[grid[:, 1].astype(int), grid[:, 0].astype(int)].astype(np.float64)
    disparity = np.round(disparity * 4) / 4
    disparity[::4] += 15
    right = grid - np.stack([disparity, np.zeros(len(grid))], 1)
    return grid, right[:-NUM_FREE]


def direct(points: tuple[np.ndarray, np.ndarray], **free: torch.Tensor) -> tuple[FilterOutput, FilterOutput]:
    """What the library says of the same matches, before and after repair and refinement."""
    pair = render_pair(2)
    left, right = (torch.from_numpy(x) for x in points)
    matches = Matches(left[: len(right)], right, torch.tensor([0, len(right)]))
    views = [pair.image0], [pair.image1]
    output = DelaunayFilter(FileFilterConfig())(matches, images0=views[0], images1=views[1])
    return output, output.repair(*views, **free).refine(*views)


def write_hdf5(path: Path, points: tuple[np.ndarray, np.ndarray], disk: bool) -> dict[str, Any]:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    count = len(points[1])
    names = [name.replace("/", "-") for name in IMAGES]
    keypoints = path / "keypoints.h5"
    with h5py.File(path / "in.h5", "w") as file, h5py.File(keypoints, "w") as features:
        if disk:
            file[f"{names[0]}/{names[1]}"] = np.stack([np.arange(count)] * 2)
        else:
            file[f"{names[0]}/{names[1]}/matches0"] = np.arange(count, dtype=np.int16)
        for name, values in zip(IMAGES, points, strict=True):
            if disk:
                features[name] = values.astype(np.float32)
                continue
            features[f"{name}/keypoints"] = values.astype(np.float16)
            features[f"{name}/descriptors"] = np.tile(np.arange(len(values), dtype=np.float16), (3, 1))
            features[f"{name}/image_size"] = np.array([400, 300])
    return {"source": path / "in.h5", "out": path / "out.h5", "keypoints": keypoints}


@pytest.mark.parametrize("disk", [False, True])
def test_hdf5_files_get_keypoints_for_what_has_moved(
    tmp_path: Path, folder: Path, points: tuple[np.ndarray, np.ndarray], disk: bool
) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    arguments = write_hdf5(tmp_path, points, disk)
    summary = filter_file(**arguments, images=folder, repair=True, refine=True)
    _, better = direct(points, keypoints0=torch.from_numpy(points[0]))
    kept = better.inlier.numpy()
    expected = np.concatenate([better.matches.keypoints0.numpy(), better.matches.keypoints1.numpy()], 1)[kept]
    name0, name1 = (name.replace("/", "-") for name in IMAGES)
    with h5py.File(tmp_path / "out.h5") as file, h5py.File(tmp_path / "out.keypoints.h5") as features:
        if disk:
            rows0, rows1 = file[name0][name1][()]
            left, right = (features[name][()].astype(float) for name in IMAGES)
            origin = file[name0][name1].attrs["origin"]
            inlier = file[name0][name1].attrs["inlier"]
        else:
            matches0 = file[name0][name1]["matches0"][()]
            rows0 = np.flatnonzero(matches0 >= 0)
            rows1 = matches0[rows0]
            left, right = (features[f"{name}/keypoints"][()].astype(float) for name in IMAGES)
            origin = file[name0][name1]["origin"][()][rows0]
            inlier = file[name0][name1]["inlier"][()][: len(points[1])]
            described = features[f"{IMAGES[1]}/descriptors"][0]
            assert len(described) == len(right)
            np.testing.assert_array_equal(described[rows1], rows0)  # those of the partner
            np.testing.assert_array_equal(features[f"{IMAGES[1]}/image_size"], [400, 300])
    found = np.concatenate([left[rows0], right[rows1]], 1)
    order, other = (np.lexsort(np.round(rows, 3).T) for rows in (expected, found))
    np.testing.assert_allclose(found[other], expected[order], atol=1e-4)  # in single precision
    np.testing.assert_array_equal(right[: len(points[1])], points[1])
    assert summary.num_improved == len(rows0) > summary.num_kept
    assert (origin == Origin.REPAIRED).sum() == summary.num_repaired > 0
    assert (origin == Origin.REFINED).sum() == summary.num_refined > 0
    np.testing.assert_array_equal(inlier, direct(points)[0].inlier)  # the verdict on the given ones


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_tables_get_the_improved_partner_beside_the_given_one(
    tmp_path: Path, folder: Path, points: tuple[np.ndarray, np.ndarray], ending: str
) -> None:
    left, right = points[0][: len(points[1])], points[1]
    columns = {"x0": left[:, 0], "y0": left[:, 1], "x1": right[:, 0], "y1": right[:, 1]}
    table = pl.DataFrame(columns).with_columns(pair=pl.lit("p"), image0=pl.lit(IMAGES[0]), image1=pl.lit(IMAGES[1]))
    twice = pl.concat([table, table.with_columns(pair=pl.lit("q"))])[::-1]  # two pairs, against their order
    source, out = tmp_path / f"in{ending}", tmp_path / f"out{ending}"
    twice.write_csv(source) if ending == ".csv" else twice.write_parquet(source)
    filter_file(source, out, images=folder, repair=True, refine=True)
    before, better = direct((left[::-1].copy(), right[::-1].copy()))
    for number in range(2):  # and again over its own result
        found = pl.read_csv(out) if ending == ".csv" else pl.read_parquet(out)
        assert found.columns == [
            *table.columns, "inlier", "score", "relation", "improved_x1", "improved_y1", "improved_inlier",
            "improved_score", "origin",
        ]  # fmt: skip
        assert found.drop(found.columns[7:]).equals(twice)
        for part in (found[: len(table)], found[len(table) :]):
            np.testing.assert_allclose(part["improved_x1"], better.matches.keypoints1[:, 0], atol=1e-9)
            assert part["inlier"].to_list() == before.inlier.tolist()
            assert part["improved_inlier"].to_list() == better.inlier.tolist()
            assert part["origin"].to_list() == [Origin(k).name.lower() for k in better.origin.tolist()]  # type: ignore[union-attr]
        source, out = out, tmp_path / f"again{number}{ending}"
        filter_file(source, out, images=folder, repair=True, refine=True)


@pytest.mark.parametrize("indexed", [False, True])
def test_archives_get_improved_matches_as_rows(
    tmp_path: Path, folder: Path, points: tuple[np.ndarray, np.ndarray], indexed: bool
) -> None:
    source, out = tmp_path / "in.npz", tmp_path / "out.npz"
    left, right = points
    if indexed:
        matches0 = np.where(np.arange(len(left)) < len(right), np.arange(len(left)), -1)
        np.savez(source, keypoints0=left, keypoints1=right, matches0=matches0, image0=IMAGES[0], image1=IMAGES[1])
    else:
        left = left[: len(right)]
        np.savez(source, keypoints0=left, keypoints1=right, image0=[IMAGES[0]], image1=[IMAGES[1]])
    summary = filter_file(source, out, images=folder, repair=True)
    free = {"keypoints0": torch.from_numpy(points[0])} if indexed else {}
    before, _ = direct(points)
    pair = render_pair(2)
    better = before.repair([pair.image0], [pair.image1], **free)
    with np.load(out) as arrays:
        np.testing.assert_array_equal(arrays["inlier"][: len(right)], before.inlier)
        np.testing.assert_array_equal(arrays["improved_keypoints1"], better.matches.keypoints1)
        np.testing.assert_array_equal(arrays["improved_keypoints0"], better.matches.keypoints0)
        np.testing.assert_array_equal(arrays["improved_rows"], better.rows)
        np.testing.assert_array_equal(arrays["improved_origin"], better.origin)
        np.testing.assert_array_equal(arrays["improved_inlier"], better.inlier)
        np.testing.assert_allclose(arrays["improved_score"], better.score, atol=1e-9)
        assert (len(better.inlier) > len(right)) == indexed
    assert summary.num_improved == better.inlier.sum() > summary.num_kept
    filter_file(out, tmp_path / "again.npz", images=folder, repair=True)
    with np.load(out) as arrays, np.load(tmp_path / "again.npz") as again:
        assert arrays.files == again.files


def test_superglue_names_the_images_in_the_name_of_the_file(
    tmp_path: Path, folder: Path, points: tuple[np.ndarray, np.ndarray]
) -> None:
    for name in IMAGES:
        (tmp_path / Path(name).name).write_bytes((folder / name).read_bytes())
    left, right = points[0][: len(points[1])], points[1]
    source = tmp_path / "a_b_matches.npz"
    np.savez(source, keypoints0=left, keypoints1=right)
    filter_file(source, tmp_path / "out.npz", images=tmp_path)
    with np.load(tmp_path / "out.npz") as arrays:
        np.testing.assert_array_equal(arrays["inlier"], direct(points)[0].inlier)
        assert "improved_keypoints1" not in arrays.files
    source.rename(tmp_path / "a_c_matches.npz")
    with pytest.raises(ValueError, match=r"a_c_matches\.npz must name its images in the arrays 'image0' and 'image1'"):
        filter_file(tmp_path / "a_c_matches.npz", tmp_path / "out.npz", images=tmp_path)


def test_databases_get_rows_of_keypoints_and_descriptors(
    tmp_path: Path, folder: Path, points: tuple[np.ndarray, np.ndarray]
) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    source, out = tmp_path / "in.db", tmp_path / "out.db"
    left, right = (np.float32(x) for x in points)
    with closing(pycolmap.Database.open(str(source))) as database:
        camera = database.write_camera(pycolmap.Camera(model="SIMPLE_PINHOLE", width=400, height=300, params=[9, 9, 9]))
        for name, own in zip(IMAGES, (left, right), strict=True):
            image = database.write_image(pycolmap.Image(name=name, camera_id=camera))
            rows = np.stack([own[:, 0] + 0.5, own[:, 1] + 0.5, 0 * own[:, 0] + 2, np.arange(len(own))], 1)
            database.write_keypoints(image, rows.astype(np.float32))
        rows = np.stack([np.arange(len(right))] * 2, 1).astype(np.uint32)
        database.write_matches(1, 2, rows)
        database.write_two_view_geometry(1, 2, pycolmap.TwoViewGeometry())
        database.write_image(pycolmap.Image(name="left/bare.png", camera_id=camera))  # without keypoints and matches
        database.write_matches(1, 3, np.zeros((0, 2), np.uint32))
    with closing(sqlite3.connect(source)) as raw, raw:  # descriptors of two bytes, which tell their row
        columns = [row[1] for row in raw.execute("PRAGMA table_info(descriptors)")]
        for image, own in ((1, left), (2, right)):
            data = np.arange(len(own), dtype=np.uint16).tobytes()
            values = {"image_id": image, "rows": len(own), "cols": 2, "data": data, "type": 1}
            marks = ", ".join("?" * len(columns))
            raw.execute(f"INSERT INTO descriptors VALUES ({marks})", [values[name] for name in columns])
    (folder / "left/bare.png").write_bytes((folder / IMAGES[0]).read_bytes())
    summary = filter_file(source, out, images=folder, repair=True, refine=True)
    _, better = direct(points, keypoints0=torch.from_numpy(points[0]))
    kept = better.inlier.numpy()
    with closing(pycolmap.Database.open(str(out))) as database:
        rows = database.read_matches(1, 2)
        one, two = (database.read_keypoints(image) for image in (1, 2))
    np.testing.assert_array_equal(one[rows[:, 0], :2] - 0.5, better.matches.keypoints0[kept])
    np.testing.assert_allclose(two[rows[:, 1], :2] - 0.5, better.matches.keypoints1[kept], atol=1e-4)
    np.testing.assert_array_equal(two[rows[:, 1], 3], rows[:, 0])  # the orientation of the partner
    assert summary.num_improved == len(rows)
    with closing(sqlite3.connect(out)) as raw:
        count, data = raw.execute("SELECT rows, data FROM descriptors WHERE image_id = 2").fetchone()
        assert count == len(two)
        np.testing.assert_array_equal(np.frombuffer(data, np.uint16)[rows[:, 1]], rows[:, 0])
        stored, origin, score = raw.execute(
            "SELECT rows, origin, score FROM tensor_stereo_improved ORDER BY rows DESC"
        ).fetchone()
        assert stored == len(rows)
        np.testing.assert_array_equal(np.frombuffer(origin, np.uint8), better.origin[kept])  # type: ignore[index]
        np.testing.assert_allclose(np.frombuffer(score, "<f4"), better.score[kept], atol=1e-6)  # type: ignore[index]
        assert raw.execute("SELECT count(*) FROM two_view_geometries").fetchone() == (0,)
        assert raw.execute("SELECT rows FROM tensor_stereo_verdicts").fetchall() == [(len(right),), (0,)]


@pytest.fixture
def named(tmp_path: Path, points: tuple[np.ndarray, np.ndarray]) -> Path:
    left, right = points[0][: len(points[1])], points[1]
    columns = {"x0": left[:, 0], "y0": left[:, 1], "x1": right[:, 0], "y1": right[:, 1]}
    table = pl.DataFrame(columns).with_columns(image0=pl.lit(IMAGES[0]), image1=pl.lit(IMAGES[1]))
    table.write_csv(tmp_path / "named.csv")
    return tmp_path / "named.csv"


def test_what_is_wrong_with_images_is_named(tmp_path: Path, folder: Path, named: Path) -> None:
    out, table = tmp_path / "out.csv", pl.read_csv(named)

    def refused(message: str, changed: pl.DataFrame = table, **arguments: Any) -> None:
        changed.write_csv(named)
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            filter_file(named, out, **({"images": folder} | arguments))
        assert not out.exists()

    refused("images must be the folder of the images for repair, got None", images=None, repair=True)
    refused("images must be the folder of the images for refine, got None", images=None, refine=True)
    refused("images", images=tmp_path / "nowhere")
    refused("has no column 'image1', which names the images of each pair", table.drop("image1"))
    refused("column 'image0' must name an image in every row", table.with_columns(image0=pl.lit(None, pl.String)))
    other = pl.when(pl.int_range(len(table)) == 5).then(pl.lit("right/b.png")).otherwise("image0").alias("image0")
    refused("named.csv, line 7: column 'image0' must be the same in all rows of a pair", table.with_columns(other))
    refused("images 'left/a.png' and 'x.png'.*x.png", table.with_columns(image1=pl.lit("x.png")))
    refused("must be named by paths below .*, got '../b.png'", table.with_columns(image1=pl.lit("../b.png")))
    refused("must be named by paths below .*, got '/b.png'", table.with_columns(image1=pl.lit("/b.png")))


def test_files_of_glue_factory_name_no_images(tmp_path: Path, folder: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    with h5py.File(tmp_path / "in.h5", "w") as file:
        for name, values in (("keypoints0", np.eye(2)), ("keypoints1", np.eye(2)), ("matches0", np.array([0, 1]))):
            file[f"pair/{name}"] = values
    with pytest.raises(ValueError, match=r"images must be None for .*in\.h5: pairs of glue-factory do not name"):
        filter_file(tmp_path / "in.h5", tmp_path / "out.h5", images=folder)


def test_folders_of_files_share_the_images(tmp_path: Path, folder: Path, named: Path) -> None:
    out = tmp_path / "out"
    summary = filter_files(tmp_path, out, images=folder, repair=True)
    assert summary.errors == {}
    assert summary.matches.num_repaired > 0
    assert json.loads((out / "filter.json").read_text())["repair"] is True
    with pytest.raises(ValueError, match="holds results of other settings"):
        filter_files(tmp_path, out, images=folder)


def test_columns_of_the_user_behind_earlier_results_stay(tmp_path: Path, folder: Path, named: Path) -> None:
    out, again = tmp_path / "out.csv", tmp_path / "again.csv"
    filter_file(named, out)
    pl.read_csv(out).with_columns(origin=pl.lit("cam A")).write_csv(out)
    filter_file(out, again, images=folder, repair=True)
    found = pl.read_csv(again)
    assert set(found["origin"]) == {"cam A"}
    assert set(found["filter_origin"]) == {"given", "repaired"}


def test_keypoints_beside_a_result_replace_nothing_that_is_read(
    tmp_path: Path, folder: Path, points: tuple[np.ndarray, np.ndarray]
) -> None:
    arguments = write_hdf5(tmp_path, points, disk=False)
    keypoints = arguments["keypoints"].rename(tmp_path / "out.keypoints.h5")
    before = keypoints.read_bytes()
    with pytest.raises(
        ValueError, match="out, whose keypoints go into a file beside it, must be another file than key"
    ):
        filter_file(tmp_path / "in.h5", tmp_path / "out.h5", keypoints=keypoints, images=folder, refine=True)
    assert keypoints.read_bytes() == before


def test_whole_keypoints_become_fractions_and_scores_follow(
    tmp_path: Path, folder: Path, points: tuple[np.ndarray, np.ndarray]
) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    arguments = write_hdf5(tmp_path, points, disk=False)
    name0, name1 = (name.replace("/", "-") for name in IMAGES)
    with h5py.File(tmp_path / "in.h5", "r+") as file, h5py.File(arguments["keypoints"], "r+") as features:
        file[f"{name0}/{name1}/matching_scores0"] = np.full(len(points[1]), 0.25, np.float16)
        for name, values in zip(IMAGES, points, strict=True):
            del features[f"{name}/keypoints"]
            features[f"{name}/keypoints"] = values.astype(np.int32)
    filter_file(**arguments, images=folder, repair=True, refine=True)
    with h5py.File(tmp_path / "out.h5") as file, h5py.File(tmp_path / "out.keypoints.h5") as features:
        right = features[f"{IMAGES[1]}/keypoints"][()]
        assert right.dtype == np.float32
        assert (right[len(points[1]) :] % 1 != 0).any()
        group = file[f"{name0}/{name1}"]
        assert len(group["matching_scores0"]) == len(group["matches0"]) == len(points[0])
        repaired = group["origin"][()] == Origin.REPAIRED
        assert (group["matching_scores0"][()][repaired] >= 0.5).all()
        np.testing.assert_array_equal(group["putative_matching_scores0"], np.full(len(points[1]), 0.25))
    again = {"keypoints": tmp_path / "out.keypoints.h5", "images": folder}
    filter_file(tmp_path / "out.h5", tmp_path / "again.h5", **again, refine=True)


def test_results_of_calls_without_images_go_on(tmp_path: Path, named: Path) -> None:
    out = tmp_path / "out"
    filter_files(tmp_path, out)
    settings = json.loads((out / "filter.json").read_text())
    for name in ("images", "repair", "refine"):  # as an earlier version wrote it
        del settings[name]
    (out / "filter.json").write_text(json.dumps(settings))
    assert filter_files(tmp_path, out).num_found == 1


def test_a_table_without_rows_has_the_same_columns(tmp_path: Path, folder: Path, named: Path) -> None:
    out, empty = tmp_path / "out.csv", tmp_path / "empty.csv"
    filter_file(named, out, images=folder, repair=True)
    pl.read_csv(named)[:0].write_csv(named)
    filter_file(named, empty, images=folder, repair=True)
    assert pl.read_csv(empty).columns == pl.read_csv(out).columns
