"""Valid files of every format, with the command that reads each of them."""

from __future__ import annotations

import io
import sqlite3
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import polars as pl
from numpy.typing import NDArray

from tensor_stereo.datasets.manifest import SCHEMA

Arrays = dict[str, NDArray[Any]]

WIDTH, HEIGHT, SHIFT = 96, 72, 6  # px
NUM_POINTS = 40
MAX_IMAGES = 2147483647  # COLMAP's documentation: pair_id = image_id1 * 2147483647 + image_id2, the smaller id first


@dataclass(frozen=True)
class Seed:
    """A valid command.

    Attributes:
        arguments: Of ``tensor-stereo``, with paths relative to the folder of the files.
        files: Contents by name.
        targets: The files that are mutated, one of them at a time.
    """

    arguments: tuple[str, ...]
    files: dict[str, bytes]
    targets: tuple[str, ...]


@cache
def seeds(kind: str) -> tuple[Seed, ...]:
    """The valid commands of one format."""
    return tuple(SEEDS[kind]())


def in_memory(write: Callable[[Path], Any], ending: str) -> bytes:
    """The bytes that a function writes to a path."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"file{ending}")
        write(path)
        return path.read_bytes()


def points(number: int = 0, num: int = NUM_POINTS) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Keypoints of both views (num, 2), in quarters of a pixel; one in five partners is wrong."""
    rng = np.random.default_rng([7, number])
    left = np.floor(rng.random((num, 2)) * [4 * WIDTH, 4 * HEIGHT]) / 4
    right = left - [SHIFT, 0]
    right[::5] = right[::5][::-1]
    return left, right


def _filter(name: str, data: bytes, *settings: str) -> Seed:
    ending = name.rpartition(".")[2]
    return Seed(("filter", name, "--out", f"out.{ending}", *settings), {name: data}, (name,))


def archive(arrays: Arrays, *, packed: bool = False) -> bytes:
    """A NumPy archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED) as file:
        for name, values in arrays.items():
            member = io.BytesIO()
            np.save(member, values)
            info = zipfile.ZipInfo(f"{name}.npy")  # of one date, unlike those of NumPy
            file.writestr(info, member.getvalue(), file.compression)
    return buffer.getvalue()


def _npz() -> list[Seed]:
    left, right = points()
    rows = {"keypoints0": left, "keypoints1": right}
    rng = np.random.default_rng(3)
    more = {
        "ptr": np.array([0, 15, 15, NUM_POINTS]),
        "cost": rng.random(NUM_POINTS).astype(np.float32),
        "group": rng.integers(0, 3, NUM_POINTS, dtype=np.int32),
        "names": np.array(["a", "bc", "d"]),
    }
    partner = np.where(rng.random(NUM_POINTS) < 0.2, -1, np.arange(NUM_POINTS))
    scores = rng.random(NUM_POINTS).astype(np.float32)
    views = {"keypoints0": left.astype(np.float32), "keypoints1": right.astype(np.float32)}
    lightglue = views | {"matches0": partner, "matching_scores0": scores}
    superglue = views | {"matches": partner.astype(np.int32), "match_confidence": scores}
    return [
        _filter("m.npz", archive(rows)),
        _filter("m.npz", archive(rows | more, packed=True), "--score", "consensus"),
        _filter("m.npz", archive(rows | more), "--verdict", "adjacency", "--score", "topology"),
        _filter("m.npz", archive(lightglue)),
        _filter("m.npz", archive(lightglue, packed=True), "--verdict", "score", "--score", "consensus"),
        _filter("m.npz", archive(superglue)),
    ]


def table(*, pairs: bool = False, integers: bool = False) -> pl.DataFrame:
    """Matches as rows."""
    left, right = points()
    values = np.concatenate([left, right], axis=1)
    columns = dict(zip(("x0", "y0", "x1", "y1"), values.T, strict=True))
    rows = pl.DataFrame({name: np.floor(v).astype(np.int64) if integers else v for name, v in columns.items()})
    if not pairs:
        return rows
    return rows.with_columns(
        pl.Series("pair", [f"scene {k % 3}" for k in range(NUM_POINTS)]),
        pl.Series("cost", np.arange(NUM_POINTS) / 8),
        pl.Series("group", np.arange(NUM_POINTS) % 2),
        pl.Series("note", ["as it is, with a comma"] * NUM_POINTS),
    )


def _csv() -> list[Seed]:
    pairs = table(pairs=True)
    classified = table().with_columns(
        disparity=pl.col("x0") - pl.col("x1"),
        inlier=pl.lit(True),
        probability=pl.lit(0.5),
        inlier_adjacency=pl.lit(True),
        inlier_cardinality=pl.lit(False),
        relation=pl.lit("equal"),
    )
    return [
        _filter("m.csv", table().write_csv().encode()),
        _filter("m.csv", pairs.write_csv().encode(), "--score", "consensus"),
        _filter("m.csv", table(integers=True).write_csv(line_terminator="\r\n").encode(), "--verdict", "cardinality"),
        _filter("m.csv", b"\xef\xbb\xbf" + classified.write_csv().replace(",", ", ").encode()),
    ]


def write_parquet(rows: pl.DataFrame, **settings: Any) -> bytes:
    """A table as Parquet."""
    buffer = io.BytesIO()
    rows.write_parquet(buffer, **settings)
    return buffer.getvalue()


def _parquet() -> list[Seed]:
    plain: dict[str, Any] = {"compression": "uncompressed"}
    return [
        _filter("m.parquet", write_parquet(table())),
        _filter("m.parquet", write_parquet(table(pairs=True), **plain), "--score", "consensus"),
        _filter("m.parquet", write_parquet(table(integers=True), statistics=False, **plain)),
        _filter("m.parquet", write_parquet(table(pairs=True), row_group_size=16), "--verdict", "adjacency"),
    ]


def _h5() -> list[Seed]:
    import h5py

    left, right = points()
    images = {"db/1.jpg": left, "db/2.jpg": right, "query/3_1.jpg": left - [0, 3]}
    partner = np.where(np.arange(NUM_POINTS) % 4 == 0, -1, np.arange(NUM_POINTS))
    made = []
    for separator, latest in (("/", True), ("_", False), ("/", False)):
        packed = {"compression": "gzip", "chunks": True} if separator == "/" and not latest else {}

        def write_features(path: Path, packed: Any = packed, latest: bool = latest) -> None:
            with h5py.File(path, "w", libver="latest" if latest else None) as file:
                for name, values in images.items():
                    group = file.create_group(name)
                    group.create_dataset("keypoints", data=values.astype(np.float16), **packed)
                    group["keypoints"].attrs["uncertainty"] = 1.0
                    group.create_dataset("descriptors", data=np.zeros((8, NUM_POINTS), np.float16))
                    group.create_dataset("image_size", data=np.array([WIDTH, HEIGHT]))

        def write_matches(path: Path, packed: Any = packed, latest: bool = latest, separator: str = separator) -> None:
            with h5py.File(path, "w", libver="latest" if latest else None) as file:
                for names in (("db/1.jpg", "db/2.jpg"), ("query/3_1.jpg", "db/1.jpg")):
                    group = file.create_group(separator.join(name.replace("/", "-") for name in names))
                    group.create_dataset("matches0", data=partner.astype(np.int16), **packed)
                    group.create_dataset("matching_scores0", data=np.linspace(0, 1, NUM_POINTS).astype(np.float16))

        files = {"m.h5": in_memory(write_matches, ".h5"), "f.h5": in_memory(write_features, ".h5")}
        made.append(Seed(("filter", "m.h5", "--out", "out.h5", "--keypoints", "f.h5"), files, ("m.h5", "f.h5")))
    return made


def _db() -> list[Seed]:
    left, right = points()
    views = [left, right, np.concatenate([left - [0, 3], np.ones((NUM_POINTS, 2))], axis=1)]
    rows = np.repeat(np.arange(NUM_POINTS, dtype=np.uint32)[:, None], 2, axis=1)

    def write_tables(path: Path) -> None:
        with closing(sqlite3.connect(path)) as database, database:
            for name, key in (("keypoints", "image_id"), ("matches", "pair_id"), ("two_view_geometries", "pair_id")):
                key_column = f"{key} INTEGER PRIMARY KEY NOT NULL"
                database.execute(f"CREATE TABLE {name} ({key_column}, rows INTEGER, cols INTEGER, data BLOB)")
            for number, view in enumerate(views):
                data = view.astype("<f4").tobytes()
                database.execute("INSERT INTO keypoints VALUES (?, ?, ?, ?)", (number + 1, *view.shape, data))
            for one, other in ((1, 2), (1, 3), (2, 3)):
                values = (one * MAX_IMAGES + other, *rows.shape, rows.tobytes())
                database.execute("INSERT INTO matches VALUES (?, ?, ?, ?)", values)
                database.execute("INSERT INTO two_view_geometries VALUES (?, ?, ?, ?)", values)

    def write_with_colmap(path: Path) -> None:
        import pycolmap

        with closing(pycolmap.Database.open(str(path))) as database:
            camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[9, 9, 9])
            number = database.write_camera(camera)
            for k, view in enumerate(views):
                image = database.write_image(pycolmap.Image(name=f"{k}.png", camera_id=number))
                database.write_keypoints(image, view.astype(np.float32))
            database.write_matches(1, 2, rows)
            database.write_matches(2, 3, rows[:7])

    made = [_filter("m.db", in_memory(write_tables, ".db"), *settings) for settings in ((), ("--verdict", "adjacency"))]
    try:
        import pycolmap  # noqa: F401
    except ImportError:
        return made
    return [*made, _filter("m.db", in_memory(write_with_colmap, ".db"), "--verdict", "cardinality", "--score", "none")]


def image(view: int, *, colour: bool = False, bits: int = 8) -> NDArray[Any]:
    """A textured image (HEIGHT, WIDTH) or (HEIGHT, WIDTH, 3); view 1 is view 0 shifted by SHIFT px."""
    rng = np.random.default_rng(5)
    shape = (HEIGHT, WIDTH + SHIFT, 3) if colour else (HEIGHT, WIDTH + SHIFT)
    texture = cv2.GaussianBlur(rng.random(shape), (0, 0), 1.5)
    low, high = texture.min(), texture.max()
    values = (texture - low) / (high - low) * (2**bits - 1)
    values = values[:, SHIFT * view : SHIFT * view + WIDTH]
    return np.ascontiguousarray(values.astype(np.uint8 if bits == 8 else np.uint16))


def encode(ending: str, pixels: NDArray[Any], *settings: int) -> bytes:
    """An image as OpenCV writes it."""
    return bytes(cv2.imencode(ending, pixels, settings)[1].tobytes())


def _classify(ending: str, left: bytes, right: NDArray[Any], *settings: str) -> Seed:
    name = f"left{ending}"
    files = {name: left, "right.png": encode(".png", right)}
    return Seed(("classify", name, "right.png", *settings), files, (name,))


def _truth(ending: str, data: bytes, *settings: str) -> Seed:
    files = {"left.png": encode(".png", image(0)), "right.png": encode(".png", image(1)), f"gt{ending}": data}
    arguments = ("classify", "left.png", "right.png", "--disparity-gt", f"gt{ending}", *settings)
    return Seed((*arguments, "--verdict", "cardinality"), files, (f"gt{ending}",))


def disparity(bits: int, scale: int) -> NDArray[Any]:
    """A map of SHIFT px with a hole, as stored."""
    stored = np.full((HEIGHT, WIDTH), SHIFT * scale, np.uint8 if bits == 8 else np.uint16)
    stored[10:20, 10:20] = 0
    return stored


def _png() -> list[Seed]:
    grey, colour = image(0), image(0, colour=True)
    palette = cv2.IMWRITE_PNG_BILEVEL
    with_alpha = np.concatenate([colour, colour[..., :1]], axis=2)
    return [
        _truth(".png", encode(".png", disparity(16, 256)), "--gt-scale", "256"),
        _truth(".png", encode(".png", disparity(8, 3)), "--gt-scale", "3"),
        _classify(".png", encode(".png", grey), image(1)),
        _classify(".png", encode(".png", colour), image(1, colour=True), "--verdict", "cardinality", "--constrained"),
        _classify(".png", encode(".png", image(0, bits=16)), image(1), "--score", "consensus"),
        _classify(".png", encode(".png", with_alpha), image(1, colour=True), "--verdict", "adjacency"),
        _classify(".png", encode(".png", grey, palette, 1), image(1), "--verdict", "cardinality"),
    ]


def pgm(pixels: NDArray[Any], *, text: bool) -> bytes:
    """A portable graymap or pixmap, ASCII or binary, 8 or 16 bits."""
    kind = (2 if text else 5) + (pixels.ndim == 3)
    head = f"P{kind}\n# made for tests\n{pixels.shape[1]} {pixels.shape[0]}\n{np.iinfo(pixels.dtype).max}\n".encode()
    if text:
        return head + b"\n".join(" ".join(map(str, row.ravel())).encode() for row in pixels) + b"\n"
    return head + pixels.astype(pixels.dtype.newbyteorder(">")).tobytes()


def _pgm() -> list[Seed]:
    made = []
    for text in (False, True):
        small, wide = (pgm(disparity(bits, scale), text=text) for bits, scale in ((8, 4), (16, 256)))
        made += [
            _truth(".pgm", small, "--gt-scale", "4"),
            _truth(".pgm", wide, "--gt-scale", "256"),
            _classify(".pgm", pgm(image(0), text=text), image(1), "--verdict", "cardinality"),
            _classify(".pgm", pgm(image(0, bits=16), text=text), image(1), "--verdict", "cardinality"),
        ]
    colour = pgm(image(0, colour=True), text=False)
    return [*made, _classify(".ppm", colour, image(1, colour=True), "--verdict", "cardinality")]


def _jpg() -> list[Seed]:
    grey, colour, cardinality = image(0), image(0, colour=True), ("--verdict", "cardinality")
    progressive = (cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 4)
    return [
        _classify(".jpg", encode(".jpg", grey), image(1)),
        _classify(".jpg", encode(".jpg", colour), image(1, colour=True), *cardinality),
        _classify(".jpg", encode(".jpg", colour, *progressive), image(1, colour=True), *cardinality),
        _classify(".jpg", encode(".jpg", grey, cv2.IMWRITE_JPEG_QUALITY, 20), image(1), "--score", "consensus"),
    ]


def _pfm() -> list[Seed]:
    values = np.where(disparity(8, 1) > 0, disparity(8, 1), np.inf).astype(np.float32)
    little = f"Pf\n{WIDTH} {HEIGHT}\n-1.0\n".encode() + values[::-1].astype("<f4").tobytes()
    big = f"Pf {WIDTH} {HEIGHT} 0.00392\n".encode() + values[::-1].astype(">f4").tobytes()
    colour = f"PF\n{WIDTH} {HEIGHT}\n-1\n".encode() + np.repeat(values[..., None], 3, 2).astype("<f4").tobytes()
    return [_truth(".pfm", data) for data in (little, big, colour)]


def _pairs() -> tuple[dict[str, bytes], pl.DataFrame]:
    """Files of two pairs, and their manifest."""
    from tensor_stereo.datasets import build_manifest

    files = {"left.png": encode(".png", image(0)), "right.png": encode(".png", image(1))}
    files["gt.png"] = encode(".png", disparity(16, 256))
    paths = ("image0", "image1", "disparity_gt")
    with tempfile.TemporaryDirectory() as folder:
        for name, data in files.items():
            Path(folder, name).write_bytes(data)
        rows = ["image0,image1,disparity_gt,gt_scale,scene", "left.png,right.png,gt.png,256,a"]
        Path(folder, "list.csv").write_text("\n".join([*rows, "right.png,left.png,,,b"]))
        manifest = build_manifest([Path(folder, "list.csv")])
    return files, manifest.with_columns(pl.col(paths).str.split("/").list.last()).select(list(SCHEMA))


SWEEPS = (
    '[grid]\ndetector = "fast"\nverdict = "cardinality"\n',
    '# two points\nexport_matches = true\n\n[grid]\ndetector = ["gftt"]\nscore = ["learned", "none"]\n'
    'verdict = ["cardinality"]\noutlier_rate = 0.2\nseed = 1\ngftt.window_px = 7\n',
    '[[grid]]\ndetector = "fast"\nscore = "consensus"\n[grid.fast]\nthreshold = 15\nwindow_px = [9, 11]\n'
    '[grid.consensus]\nrow_tolerance_px = 0.5\n\n[[grid]]\ndetector = "surf"\nverdict = "adjacency"\n'
    "surf.num_octaves = 3\nmatching.max_ratio = 0.9\n",
    '[grid]\ndetector = "sift"\nsift.backend = "opencv"\nconstrained = true\nobjects.element_px = 3\n'
    "min_precision = 0.8\nmatching = { mutual = true, max_disparity_px = 40.0 }\nmax_error_px = 2\n",
)


def _sweep(settings: str, manifest: bytes, files: dict[str, bytes], target: str) -> Seed:
    arguments = ("sweep", "s.toml", "--manifest", "m.parquet", "--out", "run", "--dry-run")
    return Seed(arguments, files | {"s.toml": settings.encode(), "m.parquet": manifest}, (target,))


def _toml() -> list[Seed]:
    files, manifest = _pairs()
    return [_sweep(text, write_parquet(manifest), files, "s.toml") for text in SWEEPS]


def _manifest() -> list[Seed]:
    files, manifest = _pairs()
    forms: tuple[dict[str, Any], ...] = (
        {},
        {"compression": "uncompressed"},
        {"compression": "snappy", "statistics": False},
    )
    return [_sweep(SWEEPS[0], write_parquet(manifest, **form), files, "m.parquet") for form in forms]


SEEDS: dict[str, Callable[[], list[Seed]]] = {
    "npz": _npz,
    "csv": _csv,
    "parquet": _parquet,
    "h5": _h5,
    "db": _db,
    "pfm": _pfm,
    "png": _png,
    "pgm": _pgm,
    "jpg": _jpg,
    "toml": _toml,
    "manifest": _manifest,
}
