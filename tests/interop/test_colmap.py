from __future__ import annotations

import sqlite3
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tensor_stereo import Matches
from tensor_stereo.interop import colmap, verdicts
from tensor_stereo.interop.colmap import TABLE, filter_colmap
from tests.interop.match_batches import exact_filter, expected_exactly
from tests.interop.matchers import scene

MAX_IMAGES = 2147483647  # COLMAP's documentation: pair_id = image_id1 * 2147483647 + image_id2, the smaller id first


@pytest.fixture
def pycolmap() -> Any:
    return pytest.importorskip("pycolmap", reason="pycolmap is not installed")


def keypoints(seed: int, num_keypoints: int = 50) -> list[np.ndarray]:
    """Of three images, at corners of pixels as COLMAP counts them, the third with scale and orientation."""
    left, right = scene(seed, num_keypoints)
    third = torch.cat([right - torch.tensor([3.0, 0.0]), torch.ones(num_keypoints, 2)], dim=1)
    return [points.numpy() + np.float32(0.5) * (points.shape[1] == 2) for points in (left, right, third)]


def rows_of(seed: int, num_rows: int, num_keypoints: int = 50) -> np.ndarray:
    """Matches of equal rows in random order, one of which occurs twice."""
    rows = np.random.default_rng(seed).permutation(num_keypoints)[:num_rows]
    rows[-1:] = rows[:1]
    return np.stack([rows, rows], axis=1).astype(np.uint32)


def some_pairs(seed: int) -> dict[tuple[int, int], np.ndarray]:
    return {(1, 2): rows_of(seed, 45), (1, 3): rows_of(seed, 0), (2, 3): rows_of(seed + 1, 30)}


def write_database(pycolmap: Any, path: Path, seed: int) -> None:
    """What COLMAP's feature extraction, matching and verification leave behind."""
    with closing(pycolmap.Database.open(str(path))) as database:
        camera = database.write_camera(pycolmap.Camera(model="SIMPLE_PINHOLE", width=320, height=240, params=[9, 9, 9]))
        for number, points in enumerate(keypoints(seed)):
            image = database.write_image(pycolmap.Image(name=f"{number}.png", camera_id=camera))
            database.write_keypoints(image, points)
            assert image == number + 1
        for (image1, image2), rows in some_pairs(seed).items():
            database.write_matches(image2, image1, rows[:, ::-1])  # in the other order
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = rows[:3]
            database.write_two_view_geometry(image1, image2, geometry)


def write_tables(path: Path, seed: int) -> None:
    """The two tables that are read, without COLMAP."""
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY NOT NULL, rows, cols, data BLOB)")
        database.execute("CREATE TABLE matches (pair_id INTEGER PRIMARY KEY NOT NULL, rows, cols, data BLOB)")
        for number, points in enumerate(keypoints(seed)):
            database.execute("INSERT INTO keypoints VALUES (?, ?, ?, ?)", (number + 1, *points.shape, points.tobytes()))
        for (image1, image2), rows in some_pairs(seed).items():
            pair_id = image1 * MAX_IMAGES + image2
            database.execute("INSERT INTO matches VALUES (?, ?, ?, ?)", (pair_id, *rows.shape, rows.tobytes()))


def to_matches(seed: int, images: tuple[int, int], rows: np.ndarray) -> Matches:
    points = keypoints(seed)
    views = (points[image - 1][rows[:, view], :2].astype(np.float64) for view, image in enumerate(images))
    return Matches(*map(torch.from_numpy, views), ptr=torch.tensor([0, len(rows)]))


def query(path: Path, text: str) -> list[Any]:
    with closing(sqlite3.connect(path)) as database:
        return database.execute(text).fetchall()


def execute(path: Path, text: str, *values: object) -> None:
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(text, values)


@pytest.mark.parametrize("seed", range(5))
def test_colmap_reads_the_inliers_and_the_table_holds_the_rest(pycolmap: Any, tmp_path: Path, seed: int) -> None:
    source, target = tmp_path / "in.db", tmp_path / "out.db"
    write_database(pycolmap, source, seed)
    before = source.read_bytes()
    summary = filter_colmap(source, target, exact_filter())
    assert source.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.db", "out.db"]
    assert (summary.num_pairs, summary.num_matches) == (3, 75)
    table = {row[0]: row[1:] for row in query(target, f"SELECT * FROM {TABLE}")}
    assert len(table) == 3
    kept = 0
    with closing(pycolmap.Database.open(str(target))) as database:
        for images, rows in some_pairs(seed).items():
            verdict = expected_exactly(to_matches(seed, images, rows))
            np.testing.assert_array_equal(database.read_matches(*images), rows[verdict.inlier])
            num_rows, num_cols, data, inlier, score, relation = table[pycolmap.image_pair_to_pair_id(*images)]
            assert (num_rows, num_cols) == (len(rows), 2)
            np.testing.assert_array_equal(np.frombuffer(data or b"", "<u4").reshape(-1, 2), rows)
            np.testing.assert_array_equal(np.frombuffer(inlier, np.bool_), verdict.inlier)
            np.testing.assert_array_equal(np.frombuffer(score, "<f4"), verdict.score.astype(np.float32))
            np.testing.assert_array_equal(np.frombuffer(relation, np.int8), verdict.relation)
            assert database.exists_two_view_geometry(*images) == verdict.inlier.all()
            kept += int(verdict.inlier.sum())
        assert database.num_matches() == kept == summary.num_kept
        assert [image.name for image in database.read_all_images()] == ["0.png", "1.png", "2.png"]
        for image, points in enumerate(keypoints(seed), start=1):
            np.testing.assert_array_equal(database.read_keypoints(image), points)


def test_pairs_are_numbered_as_documented(pycolmap: Any) -> None:
    assert pycolmap.pair_id_to_image_pair(5 * MAX_IMAGES + 7) == (5, 7)


def test_the_copy_is_the_source_but_for_what_was_filtered(pycolmap: Any, tmp_path: Path) -> None:
    source, target = tmp_path / "in.db", tmp_path / "out.db"
    write_database(pycolmap, source, 0)
    filter_colmap(source, target, exact_filter())
    for text in ("SELECT * FROM cameras", "SELECT * FROM images", "SELECT * FROM keypoints", "PRAGMA user_version"):
        assert query(source, text) == query(target, text)
    schema = "SELECT name, sql FROM sqlite_master WHERE name != ? ORDER BY name".replace("?", f"'{TABLE}'")
    assert query(source, schema) == query(target, schema)
    assert query(source, "PRAGMA journal_mode") == [("wal",)]
    assert query(target, "PRAGMA journal_mode") == [("delete",)]  # readable where no file can be made beside it


def test_a_database_without_the_other_tables_and_blocks_make_no_difference(
    pycolmap: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, tables = tmp_path / "whole.db", tmp_path / "tables.db"
    write_database(pycolmap, whole, 1)
    write_tables(tables, 1)
    outs = [tmp_path / f"out{k}.db" for k in range(3)]
    filter_colmap(whole, outs[0], exact_filter())
    filter_colmap(tables, outs[1], exact_filter())
    monkeypatch.setattr(verdicts, "BLOCK_MATCHES", 1)
    filter_colmap(tables, outs[2], exact_filter())
    one, two, three = (query(out, f"SELECT pair_id, rows, inlier, score, relation FROM {TABLE}") for out in outs)
    assert one == two == three


def test_filtering_twice_replaces_the_verdicts(pycolmap: Any, tmp_path: Path) -> None:
    write_tables(tmp_path / "in.db", 0)
    first = filter_colmap(tmp_path / "in.db", tmp_path / "once.db", exact_filter())
    second = filter_colmap(tmp_path / "once.db", tmp_path / "twice.db", exact_filter())
    assert 0 < second.num_matches == first.num_kept < first.num_matches
    assert query(tmp_path / "twice.db", f"SELECT sum(rows) FROM {TABLE}") == [(second.num_matches,)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("UPDATE keypoints SET rows = 1000000000 WHERE image_id = 1", r"table 'keypoints' must have 0\.\.\d+ rows"),
        ("UPDATE keypoints SET rows = 49 WHERE image_id = 1", "'keypoints' claims 49 x 2 values .* its data has 400"),
        ("UPDATE keypoints SET rows = -1 WHERE image_id = 1", "got -1 and 2"),
        ("UPDATE keypoints SET rows = 'x' WHERE image_id = 1", "got 'x' and 2"),
        ("UPDATE keypoints SET data = NULL WHERE image_id = 2", "'keypoints' claims 50 x 2 values"),
        ("UPDATE keypoints SET rows = 100, cols = 1 WHERE image_id = 2", "'keypoints' must have 2 or more cols, got 1"),
        ("UPDATE matches SET rows = 90, cols = 1", "'matches' must have 2 cols, got 1"),
        ("UPDATE matches SET data = hex(data) WHERE rows = 45", "'matches' claims 45 x 2 values"),
        ("UPDATE matches SET rows = 1 WHERE rows = 0", "'matches' claims 1 x 2 values of 4 bytes, its data has 0"),
        (
            "DELETE FROM keypoints WHERE image_id = 3",
            r"\(images 2 and 3\): row \d+ of the matches names keypoint 49 of view 1, there are 0 keypoints",
        ),
        (
            "UPDATE keypoints SET rows = 40, data = substr(data, 1, 320) WHERE image_id = 1",
            "names keypoint 4. of view 0",
        ),
        ("UPDATE matches SET pair_id = -5 WHERE rows = 45", "pair_id -5 must be a number that COLMAP gives"),
        (
            "UPDATE matches SET pair_id = 5 WHERE rows = 45",
            r"pair_id 5 \(images 0 and 5\): row .* of view 0, there are 0 keypoints",
        ),
    ],
)
def test_wrong_rows_are_named_by_table_and_pair(pycolmap: Any, tmp_path: Path, change: str, message: str) -> None:
    source, target = tmp_path / "in.db", tmp_path / "out.db"
    write_tables(source, 0)
    execute(source, change)
    with pytest.raises(ValueError, match=message) as caught:
        filter_colmap(source, target, exact_filter())
    assert str(source) in str(caught.value)


def test_keypoints_that_are_no_numbers_are_named_by_pair_and_row(pycolmap: Any, tmp_path: Path) -> None:
    source = tmp_path / "in.db"
    write_tables(source, 0)
    row = int(rows_of(0, 45)[7, 0])
    points = keypoints(0)[1]
    points[row, 1] = np.nan
    execute(source, "UPDATE keypoints SET data = ? WHERE image_id = 2", points.tobytes())
    with pytest.raises(ValueError, match=rf"\(images 1 and 2\): keypoints1, row {row}, must be finite"):
        filter_colmap(source, tmp_path / "out.db", exact_filter())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("DROP TABLE matches", r"has no table 'matches', it has \['keypoints'\]"),
        ("ALTER TABLE keypoints DROP COLUMN cols", "table 'keypoints' has no column 'cols'"),
        ("ALTER TABLE matches RENAME TO m; CREATE VIEW matches AS SELECT * FROM m", "has no table 'matches'"),
        ("DROP TABLE matches; CREATE VIRTUAL TABLE matches USING fts5(pair_id)", "has no table 'matches'"),
        (
            "CREATE TRIGGER t AFTER UPDATE ON matches BEGIN DELETE FROM keypoints; END",
            r"must have no triggers, which COLMAP does not write, got \['t'\]",
        ),
        (f"CREATE VIEW {TABLE} AS SELECT 1", "is no readable COLMAP database: use DROP VIEW"),
    ],
)
def test_another_schema_is_refused(tmp_path: Path, change: str, message: str) -> None:
    source = tmp_path / "in.db"
    write_tables(source, 0)
    with closing(sqlite3.connect(source)) as database:
        database.executescript(change)
    with pytest.raises(ValueError, match=message) as caught:
        filter_colmap(source, tmp_path / "out.db", exact_filter())
    assert str(source) in str(caught.value)


def test_damaged_and_unfinished_databases_are_refused(pycolmap: Any, tmp_path: Path) -> None:
    source, target = tmp_path / "in.db", tmp_path / "out.db"
    write_database(pycolmap, source, 0)
    data = source.read_bytes()
    for damaged in (data[:5000], data[:16] + b"x" * 500 + data[516:], data[: len(data) // 2]):
        source.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"in\.db is no readable COLMAP database"):
            filter_colmap(source, target, exact_filter())
    source.write_bytes(data)
    with closing(pycolmap.Database.open(str(source))) as database:
        database.write_matches(2, 2, rows_of(0, 4))
        with pytest.raises(ValueError, match=r"in\.db is not finished, see in\.db-wal"):
            filter_colmap(source, target, exact_filter())
    assert filter_colmap(source, target, exact_filter()).num_pairs == 4


def test_the_error_without_pycolmap_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    write_tables(tmp_path / "in.db", 0)
    with pytest.raises(ImportError, match=r"pycolmap must be installed to read in\.db"):
        filter_colmap(tmp_path / "in.db", tmp_path / "out.db", exact_filter())


def test_a_full_disk_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_tables(tmp_path / "in.db", 0)

    def fill(source: Path, database: sqlite3.Connection, run: object) -> verdicts.FilterSummary:
        database.execute("PRAGMA max_page_count = 1")  # as few pages as the file has
        database.execute("CREATE TABLE more (data)")
        database.execute("INSERT INTO more VALUES (zeroblob(100000))")
        raise AssertionError("the database took it")

    monkeypatch.setattr(colmap, "_filter_copy", fill)
    with pytest.raises(OSError, match=r"the copy of .*in\.db cannot be written: database or disk is full"):
        filter_colmap(tmp_path / "in.db", tmp_path / "out.db", exact_filter())


EMPTY_KEYPOINTS = (
    "DELETE FROM keypoints WHERE image_id = 3",
    "UPDATE keypoints SET rows = 0, cols = 0, data = NULL WHERE image_id = 3",
    "UPDATE keypoints SET rows = 0, cols = 4, data = x'' WHERE image_id = 3",
)
EMPTY_MATCHES = (
    "UPDATE matches SET rows = 0, cols = 2, data = NULL WHERE pair_id % 2147483647 = 3",
    "UPDATE matches SET rows = 0, cols = 0, data = x'' WHERE pair_id % 2147483647 = 3",
    "DELETE FROM matches WHERE pair_id % 2147483647 = 3",
)
OTHER_TABLES = (
    "SELECT 1",
    "DELETE FROM images WHERE image_id = 3",
    "DELETE FROM images",
    "DROP TABLE images",
    "DELETE FROM two_view_geometries",
    "UPDATE two_view_geometries SET rows = 0, cols = 0, data = NULL",
    "DROP TABLE two_view_geometries",
)


@pytest.mark.parametrize("keypoints_are", EMPTY_KEYPOINTS)
@pytest.mark.parametrize("matches_are", EMPTY_MATCHES)
@pytest.mark.parametrize("other", OTHER_TABLES)
def test_an_image_without_features_makes_empty_pairs(
    pycolmap: Any, tmp_path: Path, keypoints_are: str, matches_are: str, other: str
) -> None:
    source, target = tmp_path / "in.db", tmp_path / "out.db"
    write_database(pycolmap, source, 0)
    expected = filter_colmap(source, target, exact_filter())
    left = query(target, "SELECT rows, data FROM matches WHERE pair_id = 2147483649")
    execute(source, "PRAGMA foreign_keys = OFF")
    for change in (keypoints_are, matches_are, other):
        execute(source, change)
    summary = filter_colmap(source, target, exact_filter())
    assert summary.num_pairs == (1 if matches_are.startswith("DELETE") else expected.num_pairs)
    assert summary.num_matches == 45
    assert query(target, "SELECT rows, data FROM matches WHERE pair_id = 2147483649") == left
    empty = query(target, f"SELECT rows, ifnull(length(inlier), 0) FROM {TABLE} WHERE pair_id % 2147483647 = 3")
    assert set(empty) <= {(0, 0)}


@pytest.mark.parametrize("change", ["rows = NULL", "cols = NULL", "rows = NULL, cols = NULL", "data = NULL"])
def test_null_is_empty_where_there_is_no_data_and_an_error_where_there_is(tmp_path: Path, change: str) -> None:
    """COLMAP's schema forbids NULL in rows and cols; what other programs write may not."""
    for has_data in (False, True):
        source = tmp_path / f"{has_data}.db"
        write_tables(source, 0)
        for table in ("matches", "keypoints"):
            columns = ", ".join(column for (_, column, *_) in query(source, f"PRAGMA table_info({table})"))
            execute(source, f"CREATE TABLE copied AS SELECT {columns} FROM {table}")
            execute(source, f"DROP TABLE {table}")
            execute(source, f"ALTER TABLE copied RENAME TO {table}")
        if not has_data:
            execute(source, "UPDATE matches SET rows = 0, data = NULL")
        execute(source, f"UPDATE matches SET {change}")
        if has_data:
            with pytest.raises(ValueError, match="table 'matches'"):
                filter_colmap(source, tmp_path / "out.db", exact_filter())
        else:
            assert filter_colmap(source, tmp_path / "out.db", exact_filter()).num_matches == 0
