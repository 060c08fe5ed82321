"""Databases of COLMAP: matches as pairs of rows of the keypoints of two images.

COLMAP counts pixel corners, not centres, as integers: its keypoints are half a pixel larger than those of this library,
which is taken off when they are read and given back to those that are written.

The tables are read with SQLite, not by ``pycolmap.Database``: opening one brings its file to the installed version's
schema, and reading believes the number of rows before it looks at the data.

Source: COLMAP's documentation, "Database Format".
"""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tensor_stereo.interop.added_keypoints import AddedKeypoints, extend_rows, place_kept
from tensor_stereo.interop.image_filter import PairImages, filter_stream
from tensor_stereo.interop.verdicts import Array, FilterSummary, Improved, Int, MatchFilter, Verdicts, pair_matches
from tensor_stereo.limits import MAX_ROWS
from tensor_stereo.types import Matches

TABLE = "tensor_stereo_verdicts"
_CREATE = f"""CREATE TABLE {TABLE} (
    pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
    inlier BLOB, score BLOB, relation BLOB)"""
IMPROVED_TABLE = "tensor_stereo_improved"
_CREATE_IMPROVED = f"""CREATE TABLE {IMPROVED_TABLE} (
    pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB,
    origin BLOB, score BLOB)"""
_KEYS = {"matches": "pair_id", "keypoints": "image_id"}
_CORNER_PX = 0.5
_FULL = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY)


def filter_colmap(source: Path, target: Path, run: MatchFilter) -> FilterSummary:
    """Copy a database with only the inliers in its table ``matches``.

    Every pair of that table goes through the filter; matches have no cost. The table ``tensor_stereo_verdicts`` of the
    copy holds all putative matches: ``pair_id, rows, cols, data`` as ``matches`` had them, and of ``rows`` values each
    the blobs ``inlier`` uint8, ``score`` float32 (NULL if the settings name none) and ``relation`` int8. The rows of
    ``two_view_geometries`` whose pair loses matches are removed, since they were estimated from those too: run COLMAP's
    geometric verification again.

    A filter that looks at the images finds their names in the table ``images``. If it repairs or refines, ``matches``
    holds what is kept then. Partners that have moved are new rows of ``keypoints`` and ``descriptors``, behind those of
    their image and for this pair alone, so that tracks over more than two images end there. The table
    ``tensor_stereo_improved`` has the same matches with the blobs ``origin`` uint8, values of
    :class:`tensor_stereo.scores.Origin`, and ``score`` float32.

    Raises:
        ValueError: if the database is damaged, unfinished or no such; the message names file, table and pair.
        OSError: if the copy cannot be written.
        ImportError: if pycolmap is not installed.
    """
    for ending in ("-wal", "-journal"):
        part = source.with_name(f"{source.name}{ending}")
        if part.is_file() and part.stat().st_size:
            raise ValueError(f"{source} is not finished, see {part.name}: close the program that writes it")
    shutil.copyfile(source, target)
    try:
        with closing(sqlite3.connect(target, isolation_level=None)) as database:
            summary = _filter_copy(source, database, run)
    except (sqlite3.Error, UnicodeDecodeError) as error:  # a message of SQLite may cite bytes that are no text
        if getattr(error, "sqlite_errorcode", 0) & 0xFF in _FULL:  # the primary code
            raise OSError(f"the copy of {source} cannot be written: {error}") from error
        raise ValueError(f"{source} is no readable COLMAP database: {error}") from error
    finally:
        for ending in ("-journal", "-wal", "-shm"):
            target.with_name(target.name + ending).unlink(missing_ok=True)
    return summary


def _filter_copy(source: Path, database: sqlite3.Connection, run: MatchFilter) -> FilterSummary:
    database.text_factory = lambda text: text.decode(errors="replace")
    database.execute("PRAGMA trusted_schema = OFF")
    _check_schema(source, database)
    database.execute("PRAGMA journal_mode = MEMORY")  # one file; COLMAP's own mode leaves two more beside it
    database.execute("BEGIN")
    for name in (TABLE, IMPROVED_TABLE):
        database.execute(f"DROP TABLE IF EXISTS {name}")  # of an earlier filter
    database.execute(_CREATE)
    has_geometries = "two_view_geometries" in _tables(database)
    summary, added = FilterSummary(), AddedKeypoints[int]()
    for pair, verdicts, improved in filter_stream(_read_pairs(source, database), run):
        _write_verdicts(database, pair.pair_id, verdicts)
        if improved is not None:
            _write_improved(database, pair, improved, added)
        if has_geometries and (improved is not None or not verdicts.inlier.all()):
            database.execute("DELETE FROM two_view_geometries WHERE pair_id = ?", (pair.pair_id,))
        summary = summary.add(1, verdicts, improved)
    _append_keypoints(source, database, added)
    database.execute("COMMIT")
    return summary


def _tables(database: sqlite3.Connection) -> dict[str, str]:
    return dict(database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))


def _check_schema(source: Path, database: sqlite3.Connection) -> None:
    """Raise unless both tables are plain ones, and nothing runs when they change."""
    tables = _tables(database)
    for name, key in _KEYS.items():
        if not (tables.get(name) or "").upper().startswith("CREATE TABLE"):
            raise ValueError(f"{source} has no table {name!r}, it has {sorted(tables)}")
        columns = {row[1] for row in database.execute(f"PRAGMA table_xinfo({name})")}
        missing = {key, "rows", "cols", "data"} - columns
        if missing:
            raise ValueError(f"{source}: table {name!r} has no column {min(missing)!r}, it has {sorted(columns)}")
    triggers = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'")]
    if triggers:
        raise ValueError(f"{source} must have no triggers, which COLMAP does not write, got {triggers}")


class _Pair(NamedTuple):
    pair_id: int
    images: tuple[int, int]
    rows0: Int
    rows1: Int
    keypoints0: Array  # (N0, 2) px, as the library counts them
    num_known1: int  # keypoints of the second image


def _read_pairs(source: Path, database: sqlite3.Connection) -> Iterator[tuple[_Pair, Matches, PairImages]]:
    try:
        import pycolmap
    except ImportError as error:
        raise ImportError(f"pycolmap must be installed to read {source.name}") from error
    has_names = "images" in _tables(database)
    names = dict(database.execute("SELECT image_id, name FROM images")) if has_names else {}
    for (pair_id,) in database.execute("SELECT pair_id FROM matches ORDER BY pair_id").fetchall():
        place = f"{source}, pair_id {pair_id!r}"
        if not isinstance(pair_id, int) or pair_id < 0:
            raise ValueError(f"{place} must be a number that COLMAP gives to two images")
        image1, image2 = pycolmap.pair_id_to_image_pair(pair_id)
        place = f"{place} (images {image1} and {image2})"
        rows = _read_blob(place, database, "matches", pair_id, "<u4")
        if len(rows) and rows.shape[1] != 2:
            raise ValueError(f"{place}: table 'matches' must have 2 cols, got {rows.shape[1]}")
        points0, points1 = (_read_blob(place, database, "keypoints", image, "<f4") for image in (image1, image2))
        for view, points in enumerate((points0, points1)):
            if len(points) and points.shape[1] < 2:
                raise ValueError(f"{place}: table 'keypoints' must have 2 or more cols, got {points.shape[1]}")
            if len(rows) and rows[:, view].max() >= len(points):
                row, given = int(rows[:, view].argmax()), rows[:, view].max()
                known = f"there are {len(points)} keypoints"
                raise ValueError(f"{place}: row {row} of the matches names keypoint {given} of view {view}, {known}")
        rows0, rows1 = rows.astype(np.int64).reshape(-1, 2).T
        left, right = (
            (points[:, :2] if len(points) else points.reshape(0, 2)).astype(np.float64) - _CORNER_PX
            for points in (points0, points1)
        )
        pair = _Pair(pair_id, (image1, image2), rows0, rows1, left, len(right))
        name1, name2 = (str(names.get(image, f"image {image}")) for image in (image1, image2))
        images = PairImages(name1, name2, left)
        yield pair, pair_matches(place, left, right, rows0, rows1), images


def _read_blob(place: str, database: sqlite3.Connection, table: str, key: int, dtype: str) -> Array:
    """The (rows, cols) array of one row of a table, whose size is checked before its data is read."""
    where = f"FROM {table} WHERE {_KEYS[table]} = ?"
    found = database.execute(f"SELECT rows, cols, ifnull(length(data), 0), typeof(data) {where}", (key,)).fetchone()
    if found is None:  # an image without features
        return np.zeros((0, 0), dtype)
    rows, cols, num_bytes, kind = found
    if num_bytes == 0:
        rows, cols = rows or 0, cols or 0  # NULL
    if not all(isinstance(value, int) and 0 <= value <= MAX_ROWS for value in (rows, cols)):
        raise ValueError(f"{place}: table {table!r} must have 0..{MAX_ROWS} rows and cols, got {rows!r} and {cols!r}")
    if kind not in ("blob", "null") or num_bytes != rows * cols * 4:
        raise ValueError(f"{place}: table {table!r} claims {rows} x {cols} values of 4 bytes, its data has {num_bytes}")
    (data,) = database.execute(f"SELECT data {where}", (key,)).fetchone()
    array: Array = np.frombuffer(data or b"", dtype=dtype).reshape(rows, cols)
    return array


def _write_verdicts(database: sqlite3.Connection, pair_id: int, verdicts: Verdicts) -> None:
    columns = "pair_id, ifnull(rows, 0), ifnull(cols, 0), data, ?, ?, ?"
    copied = f"INSERT INTO {TABLE} SELECT {columns} FROM matches WHERE pair_id = ?"
    score = None if verdicts.score is None else verdicts.score.astype("<f4").tobytes()
    blobs = verdicts.inlier.tobytes(), score, verdicts.relation.tobytes()
    database.execute(copied, (*blobs, pair_id))
    rows = _read_blob(f"pair_id {pair_id}", database, "matches", pair_id, "<u4")[verdicts.inlier]
    changed = "UPDATE matches SET rows = ?, data = ? WHERE pair_id = ?"
    database.execute(changed, (len(rows), rows.tobytes(), pair_id))


def _write_improved(database: sqlite3.Connection, pair: _Pair, improved: Improved, added: AddedKeypoints[int]) -> None:
    """Put the matches after repair and refinement in the place of those that the filter left."""
    rows0, rows1, kept = place_kept(
        improved, (pair.rows0, pair.rows1), pair.keypoints0, pair.num_known1, pair.images, added
    )
    data = np.stack([rows0, rows1], axis=1).astype("<u4").tobytes()
    database.execute("UPDATE matches SET rows = ?, data = ? WHERE pair_id = ?", (len(kept), data, pair.pair_id))
    if IMPROVED_TABLE not in _tables(database):
        database.execute(_CREATE_IMPROVED)
    score = None if improved.score is None else improved.score[kept].astype("<f4").tobytes()
    values = (pair.pair_id, len(kept), data, improved.origin[kept].astype(np.uint8).tobytes(), score)
    database.execute(f"INSERT INTO {IMPROVED_TABLE} VALUES (?, ?, 2, ?, ?, ?)", values)


def _append_keypoints(source: Path, database: sqlite3.Connection, added: AddedKeypoints[int]) -> None:
    """Write the rows of the keypoints that improved matches need, and as many descriptors."""
    has_descriptors = "descriptors" in _tables(database)
    for image, parts in added:
        place = f"{source}, image {image}"
        known = _read_blob(place, database, "keypoints", image, "<f4")
        more = []
        for part in parts:
            rows = np.zeros((len(part.points), known.shape[1]), np.float32)
            rows[:, :2] = part.points + _CORNER_PX
            like = _read_blob(place, database, "keypoints", part.partner, "<f4")
            if like.shape[1] == known.shape[1]:
                rows[:, 2:] = like[part.rows, 2:]  # scale and orientation
            more.append(rows)
        whole = extend_rows(known, np.concatenate(more))
        changed = "UPDATE keypoints SET rows = ?, data = ? WHERE image_id = ?"
        database.execute(changed, (len(whole), whole.astype("<f4").tobytes(), image))
        if has_descriptors:
            described = _descriptors(database, image)
            if len(described) == len(known):
                more = [_take(_descriptors(database, part.partner), part.rows, described.shape[1]) for part in parts]
                data = np.concatenate([described, *more])
                changed = "UPDATE descriptors SET rows = ?, data = ? WHERE image_id = ?"
                database.execute(changed, (len(data), data.tobytes(), image))


def _take(descriptors: Array, rows: Int, width: int) -> Array:
    """Some rows; zeros where another extractor has been at work."""
    if descriptors.shape[1] != width or len(descriptors) <= rows.max(initial=-1):
        return np.zeros((len(rows), width), np.uint8)
    return descriptors[rows]


def _descriptors(database: sqlite3.Connection, image: int) -> Array:
    """(rows, bytes of each) of an image, of whatever type they are."""
    found = database.execute("SELECT rows, data FROM descriptors WHERE image_id = ?", (image,)).fetchone()
    rows, data = found or (0, b"")
    if not rows or not isinstance(data, bytes) or len(data) % rows:
        return np.zeros((0, 0), np.uint8)
    return np.frombuffer(data, np.uint8).reshape(rows, -1)
