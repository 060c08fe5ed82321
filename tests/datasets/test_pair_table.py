from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from tensor_stereo.datasets import pair_table as module
from tensor_stereo.datasets import read_manifest
from tensor_stereo.datasets.pair_table import SCHEMA, PairTable


def rows(count: int, first: int = 0) -> pl.DataFrame:
    """Pairs that name no file."""
    numbers = range(first, first + count)
    return pl.DataFrame(
        [
            {
                "dataset": "many", "scene": f"{k:05d}", "image0": f"/x/{k}-0.png", "image1": f"/x/{k}-1.png",
                "gt_scale": None if k % 3 else 256.0, "gt_encoding": "scaled", "width_px": 9, "height_px": 7,
                "disparity_gt": None if k % 3 else f"/x/{k}.png",
            }
            for k in numbers
        ],
        SCHEMA,
    )  # fmt: skip


@pytest.fixture(autouse=True)
def few_rows_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that small tables have several windows."""
    monkeypatch.setattr(module, "_ROWS_AT_ONCE", 4)


def test_files_of_a_folder_are_one_table_in_the_order_of_their_names(tmp_path: Path) -> None:
    folder = tmp_path / "manifest"
    folder.mkdir()
    for name, (count, first) in {"b.parquet": (5, 9), "a.parquet": (9, 0), "c.parquet": (0, 0)}.items():
        rows(count, first).write_parquet(folder / name)
    rows(14).write_parquet(tmp_path / "one.parquet")
    (folder / ".part.parquet").write_bytes(b"half")
    (folder / "readme.txt").touch()
    table, one = PairTable(folder, check_files=False), PairTable(tmp_path / "one.parquet", check_files=False)
    assert list(table) == list(one) == read_manifest(folder, check_files=False)
    assert [table[int(k)].scene for k in np.random.default_rng(0).permutation(14)] == [
        one[int(k)].scene for k in np.random.default_rng(0).permutation(14)
    ]
    assert table.first_difference(tmp_path / "one.parquet") is None
    table.copy_to(tmp_path / "copy.parquet")
    assert pl.read_parquet(tmp_path / "copy.parquet").equals(rows(14))
    assert table.find("many", "00011") == one[11]
    with pytest.raises(KeyError, match="many/x"):
        table.find("many", "x")
    with pytest.raises(IndexError, match="14 pairs, got number 14"):
        table[14]


def test_what_differs_first_is_named(tmp_path: Path) -> None:
    table = rows(11)
    table.write_parquet(tmp_path / "a.parquet")
    ours = PairTable(tmp_path / "a.parquet", check_files=False)
    other = tmp_path / "b.parquet"
    table.with_columns(mask=pl.when(pl.col("scene") == "00006").then(pl.lit("m.png"))).write_parquet(other)
    assert ours.first_difference(other) == "row 7: mask is 'm.png' there, None here"
    table[:10].write_parquet(other)
    assert ours.first_difference(other) == "it has 10 pairs there, 11 here"
    table.with_columns(mine=1).write_parquet(other)  # further columns say nothing of the pairs
    assert ours.first_difference(other) is None


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("scene", "", "column 'scene' is empty"),
        ("width_px", 0, "column 'width_px' must be positive, got 0"),
        ("gt_scale", float("nan"), "column 'gt_scale' must be positive and finite, got nan"),
        ("gt_scale", float("inf"), "column 'gt_scale' must be positive and finite, got inf"),
        ("sample_bits", 17, "column 'sample_bits' must lie in"),
        ("gt_encoding", "colour", "column 'gt_encoding' must be one of .*, got 'colour'"),
        ("scene", "00001", "two pairs are named many/00001: /x/1-0.png and /x/9-0.png"),
    ],
)
def test_a_wrong_row_beyond_the_first_window_is_named(tmp_path: Path, column: str, value: object, words: str) -> None:
    """By the file, and its row there."""
    folder = tmp_path / "manifest"
    folder.mkdir()
    table = rows(12)
    values = table[column].to_list()
    values[9] = value
    table = table.with_columns(pl.Series(column, values, SCHEMA[column]))
    table[:3].write_parquet(folder / "0.parquet")
    table[3:].write_parquet(folder / "1.parquet")
    with pytest.raises(ValueError, match=words) as error:
        PairTable(folder, check_files=False)
    if "two pairs" not in words:
        assert "1.parquet, row 7: " in str(error.value)


def test_many_pairs_of_one_name_are_told(tmp_path: Path) -> None:
    rows(5).with_columns(scene=pl.lit("same")).write_parquet(tmp_path / "a.parquet")
    with pytest.raises(ValueError, match=r"two pairs are named many/same: /x/0-0\.png and /x/1-0\.png"):
        PairTable(tmp_path / "a.parquet", check_files=False)


def test_a_list_by_a_relative_path_names_absolute_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.csv").write_text("image0,image1\na.png,/b/c.png\n")
    monkeypatch.chdir(tmp_path)
    (pair,) = PairTable("mine.csv", check_files=False)
    assert (pair.image0, pair.image1) == (tmp_path / "a.png", Path("/b/c.png"))


def test_a_folder_without_a_manifest_is_told(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no manifest in the folder"):
        PairTable(tmp_path)
    rows(2).drop("image1").write_parquet(tmp_path / "a.parquet")
    with pytest.raises(ValueError, match="has no column 'image1'"):
        PairTable(tmp_path)


def test_files_that_are_missing_are_found_when_asked(tmp_path: Path) -> None:
    rows(6).write_parquet(tmp_path / "a.parquet")
    with pytest.raises(ValueError, match=r"row 1: column 'image0' names /x/0-0\.png, which is no file"):
        PairTable(tmp_path / "a.parquet")
