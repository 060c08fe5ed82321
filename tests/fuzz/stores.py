"""Databases and HDF5 files that their own libraries have changed."""

from __future__ import annotations

import io
import sqlite3
import tempfile
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from tests.fuzz.mutations import FLOATS, NUMBERS, mutate_bytes
from tests.fuzz.seeds import MAX_IMAGES

_INTEGERS = tuple(number for number in NUMBERS if number < 1 << 63)
_TABLES = ("keypoints", "matches", "two_view_geometries", "images", "cameras")
_TYPES = ("INTEGER", "BLOB", "TEXT", "REAL", "NUMERIC", "", "ANY")


def mutate_db(data: bytes, others: Sequence[bytes], rng: Random) -> bytes:
    """Change rows, tables and settings of a database by SQL, and maybe its bytes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "m.db")
        path.write_bytes(data)
        with closing(sqlite3.connect(path, isolation_level=None)) as database:
            database.execute("PRAGMA synchronous = OFF")
            for _ in range(rng.choice((1, 1, 2, 4))):
                with suppress(sqlite3.Error, sqlite3.Warning, OverflowError):
                    statement, values = _statement(rng)
                    if ";" in statement:
                        database.executescript(statement)
                    else:
                        database.execute(statement, values)
        made = path.read_bytes()
    if rng.random() < 0.1:  # names and statements of the schema, which no checksum guards
        made = made.replace(*rng.choice(((b"rows", b"cols"), (b"matches", b"matchez"), (b"BLOB", b"TEXT"), (b"CREATE",
        b"create"),
                                         (b"INTEGER PRIMARY KEY", b"INTEGER PRIMARY KEZ"), (b"keypoints",
                                         b"keypoint\xff"))))  # fmt: skip
    return mutate_bytes(made, others, rng) if rng.random() < 0.2 else made


def _statement(rng: Random) -> tuple[str, tuple[Any, ...]]:
    table = rng.choice(_TABLES[: rng.choice((2, 2, 3, 5))])
    key = "image_id" if table == "keypoints" else "pair_id"
    values: tuple[Any, ...] = (
        *_INTEGERS, *FLOATS, "2", "40", "a", "", b"", b"\xff", b"40", None, rng.randbytes(320), bytes(320),
        b"\xff" * 320,
        bytes(640), b"\x00\x00\xc0\x7f" * 80, b"\xff\xff\x7f\x7f" * 80, rng.randbytes(8), "é" * 80, "\x00" * 320,
    )  # fmt: skip
    column, value = rng.choice(("rows", "cols", "data", "data", key)), rng.choice(values)
    pair = rng.choice((1, 2, 3, 0, -1)) * MAX_IMAGES + rng.choice((1, 2, 3, 4, 0, -5, MAX_IMAGES - 1))
    rows = rng.choice((0, 1, 40, 1 << 26, (1 << 26) + 1))
    moved = f"CREATE TABLE t AS SELECT * FROM {table}; DROP TABLE {table};"
    made, primary = f"{moved} CREATE TABLE {table}", f"{key} INTEGER PRIMARY KEY"
    copied = f"INSERT INTO {table} SELECT {key}, rows, cols, data FROM t"
    open_schema, shut = "PRAGMA writable_schema = ON; UPDATE sqlite_master SET", "; PRAGMA writable_schema = OFF;"
    changes: tuple[tuple[str, tuple[Any, ...]], ...] = (
        (f"UPDATE {table} SET {column} = ?", (value,)),
        (f"UPDATE {table} SET {column} = ? WHERE rowid = (SELECT max(rowid) FROM {table})", (value,)),
        (f"UPDATE {table} SET {column} = ? WHERE rowid = (SELECT min(rowid) FROM {table})", (value,)),
        (f"UPDATE {table} SET rows = ?, cols = ?, data = ?", (rng.choice(_INTEGERS), rng.choice(_INTEGERS), value)),
        (f"UPDATE {table} SET rows = ?, cols = ?, data = zeroblob(?)", (rows % 99, 2, rows % 99 * 8)),
        (f"UPDATE {table} SET rows = {rows}, cols = 0, data = NULL", ()),
        (f"UPDATE {table} SET rows = 0, cols = {rows}, data = NULL", ()),
        (f"UPDATE {table} SET data = CAST(data AS TEXT)", ()),
        (f"UPDATE {table} SET {column} = {column} {rng.choice(('+', '-', '*', '/', '||'))} 1", ()),
        (f"INSERT INTO {table} ({key}, rows, cols, data) VALUES (?, ?, ?, ?)", (pair, 1, 2, bytes(8))),
        (f"UPDATE matches SET pair_id = {pair} WHERE rowid = (SELECT max(rowid) FROM matches)", ()),
        (f"DELETE FROM {table} WHERE rowid % {rng.choice((1, 2, 3))} = 0", ()),
        (f"DROP TABLE {table}", ()),
        (f"ALTER TABLE {table} DROP COLUMN {column}", ()),
        (f"ALTER TABLE {table} RENAME COLUMN {column} TO {rng.choice(('ROWS', 'colz', 'x'))}", ()),
        (f"ALTER TABLE {table} RENAME TO {rng.choice((table.upper(), 't', 'tensor_stereo_verdicts'))}", ()),
        (f"ALTER TABLE {table} ADD COLUMN more {rng.choice(_TYPES)} DEFAULT {rng.choice(('1', 'NULL', 'x' * 9))}", ()),
        (f"{made} ({key}, rows, cols, data); {copied};", ()),
        (f"{moved} CREATE VIEW {table} AS SELECT * FROM t;", ()),
        (f"{made} ({key} TEXT, rows TEXT, cols REAL, data TEXT); {copied};", ()),
        (f"{made} ({primary}, rows, cols, data CHECK (length(data) > 99)) WITHOUT ROWID; {copied} LIMIT 1;", ()),
        (f"{made} ({primary}, rows DEFAULT 1, cols AS (2), data AS (zeroblob(rows * 8)));"
         f" INSERT INTO {table} ({key}, rows) SELECT {key}, {rows} FROM t LIMIT 3;", ()),
        (f"{made} ({primary}, rows INT REFERENCES t, cols INT, data BLOB COLLATE nocase) STRICT; {copied};", ()),
        (f"CREATE TRIGGER g AFTER UPDATE ON {table} BEGIN DELETE FROM {table}; END;", ()),
        (f"CREATE INDEX i{rng.randrange(9)} ON {table} ({column})", ()),
        (f"CREATE UNIQUE INDEX u ON {table} (rows, cols, {rng.choice(('data', 'length(data)'))})", ()),
        ("CREATE VIRTUAL TABLE v USING fts5(a); INSERT INTO v VALUES ('a');", ()),
        ("CREATE TABLE tensor_stereo_verdicts (pair_id, other)", ()),
        ("CREATE VIEW tensor_stereo_verdicts AS SELECT 1", ()),
        ("CREATE TABLE other (a); CREATE INDEX tensor_stereo_verdicts ON other (a);", ()),
        (f"PRAGMA page_size = {rng.choice((512, 65536))}; VACUUM;", ()),
        (f"PRAGMA auto_vacuum = {rng.choice((1, 2))}; VACUUM;", ()),
        (f"PRAGMA user_version = {rng.choice(_INTEGERS)}; PRAGMA application_id = 7;", ()),
        ("PRAGMA journal_mode = WAL", ()),
        (f"{open_schema} sql = replace(sql, 'rows', 'cols'){shut}", ()),
        (f"{open_schema} rootpage = {rng.choice((0, 1, 2, 3, 999, -1))} WHERE name ="
         f" '{table}'{shut}", ()),
        (f"{open_schema} {rng.choice(('sql', 'name', 'tbl_name', 'type'))} ="
         f" {rng.choice(('NULL', '1', chr(39) + 'table' + chr(39), 'sql || 1'))}{shut}", ()),
    )  # fmt: skip
    return rng.choice(changes)


_KINDS = ("<f8", ">f8", "f4", "f2", "i2", ">i8", "u8", "i1", "?", "c8", "S3", "V4", "c16", "text", "enum", "compound",
"array",
          "vlen", "reference", "precise")  # fmt: skip
_SHAPES: tuple[Any, ...] = (
    (),
    (0,),
    (0, 2),
    (40,),
    (39,),
    (41,),
    (40, 2),
    (40, 3),
    (2, 40),
    (40, 2, 1),
    (1, 2),
    (1 << 12, 2),
)


def mutate_h5(data: bytes, others: Sequence[bytes], rng: Random) -> bytes:
    """Change groups and datasets of an HDF5 file, and maybe its bytes."""
    import h5py

    buffer = io.BytesIO(data)
    with h5py.File(buffer, "r+") as file:
        for _ in range(rng.choice((1, 1, 2, 3))):
            groups: list[Any] = [file]
            datasets: list[Any] = []
            file.visititems(
                lambda _, item, a=groups, b=datasets: (b if isinstance(item, h5py.Dataset) else a).append(item)
            )
            with suppress(Exception):  # whatever these libraries raise
                if datasets and rng.random() < 0.6:
                    _change_dataset(rng.choice(datasets), rng)
                else:
                    _change_group(rng.choice(groups), rng)
    made = buffer.getvalue()
    if rng.random() < 0.05:
        made = bytes(512) + made  # what HDF5 calls a user block
    return mutate_bytes(made, others, rng) if rng.random() < 0.25 else made


def _dtype(kind: str) -> Any:
    import h5py

    if kind == "precise":
        form = h5py.h5t.STD_I32LE.copy()
        form.set_precision(17)
        form.set_offset(3)
        return form
    return {
        "text": h5py.string_dtype(),
        "enum": h5py.enum_dtype({"a": 0, "b": 1}, basetype="i2"),
        "compound": np.dtype([("x", "f4"), ("y", "f4")]),
        "array": np.dtype(("f4", (2,))),
        "vlen": h5py.vlen_dtype(np.dtype("i4")),
        "reference": h5py.ref_dtype,
    }.get(kind) or np.dtype(kind)


def _change_dataset(dataset: Any, rng: Random) -> None:
    import h5py

    parent, name = dataset.parent, dataset.name.rpartition("/")[2]
    what = rng.randrange(8)
    if what == 0 and dataset.size and dataset.dtype.kind in "fiu":
        values = dataset[()]
        with np.errstate(all="ignore"):
            values.reshape(-1)[rng.randrange(values.size)] = rng.choice(
                FLOATS if dataset.dtype.kind == "f" else (-3, -2, 127, 40)
            )
        dataset[...] = values
        return
    if what == 1:
        dataset.attrs[rng.choice(("uncertainty", "a" * 300, "ü"))] = rng.choice(
            (1.0, "text", np.zeros(50), h5py.Empty("f4"))
        )
        return
    shape = dataset.shape if rng.random() < 0.5 else rng.choice(_SHAPES)
    del parent[name]
    if what == 2:
        return
    if what == 3:
        parent[name] = rng.choice(
            (h5py.SoftLink("/nowhere"), h5py.SoftLink("."), h5py.ExternalLink("f.h5", "/db/1.jpg/keypoints"))
        )
        return
    if what == 4:
        parent[name] = rng.choice(
            (np.dtype("f4"), h5py.Empty("i2"), "text", [b"a", b"b"], 3.5, np.zeros((40, 2), ">i2"))
        )
        return
    form = _dtype(rng.choice(_KINDS))
    if isinstance(form, h5py.h5t.TypeID):
        timeless = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        timeless.set_obj_track_times(False)
        h5py.h5d.create(parent.id, name.encode(), form, h5py.h5s.create_simple(shape or (1,)), timeless)
        return
    settings: dict[str, Any] = {}
    if shape and 0 not in shape and rng.random() < 0.6:
        settings = rng.choice((
            {"chunks": True, "compression": "gzip", "shuffle": True}, {"compression": "lzf"}, {"fletcher32": True},
            {"chunks": (1,) * len(shape)}, {"maxshape": (None,) * len(shape)}, {"scaleoffset": 3},
            {"external": [("left", 0, 99)]},
            {"fillvalue": 7}, {"chunks": tuple(1 << 20 for _ in shape), "maxshape": (None,) * len(shape)},
        ))  # fmt: skip
    values = np.resize(np.arange(-1, 39), shape).astype(form) if form.kind in "fiu" and rng.random() < 0.7 else None
    values = None if "external" in settings else values  # they would be written to another file
    if values is None and rng.random() < 0.3 and shape:
        shape = (rng.choice((1 << 20, 1 << 26, 1 << 27, 1 << 40)), *shape[1:])
        settings.setdefault("chunks", (1024, *shape[1:]))
    parent.create_dataset(name, shape=shape, dtype=form, data=values, **settings)


def _change_group(group: Any, rng: Random) -> None:
    import h5py

    names = (
        "matches0",
        "matching_scores0",
        "keypoints",
        "inlier",
        "score",
        "relation",
        "putative_matches0",
        "db",
        "a_b",
        "é",
        "x",
    )
    name, what = rng.choice(names), rng.randrange(8)
    if what <= 1 and len(group):
        old = rng.choice(sorted(group))
        group.move(old, rng.choice((f"{old}x", name, old.replace("-", "/"), old.replace("_", "-"), f"{name}/{old}")))
    elif what == 2 and len(group):
        del group[rng.choice(sorted(group))]
    elif what == 3:
        group[name] = rng.choice((group, group.file, np.zeros(3), np.dtype("i4"), h5py.SoftLink(group.name or "/")))
    elif what == 4:
        group[name] = h5py.ExternalLink(rng.choice(("f.h5", "m.h5", "none.h5", "/dev/null")), "/db")
    elif what == 5 and len(group):
        group.copy(group[rng.choice(sorted(group))], group, name=name)
    elif what == 6:
        odd = rng.choice((b"\xff\xfe", b"a\\b", b"..", b" ", b"n" * 3000))
        h5py.h5g.create(group.id, odd)
    else:
        group.require_group(name).attrs["a"] = 1
