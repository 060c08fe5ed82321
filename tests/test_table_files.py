from __future__ import annotations

import ast
import io
import os
import re
from pathlib import Path

import polars as pl
import pytest

import tensor_stereo
from tensor_stereo import table_files
from tensor_stereo.table_files import lazy_parquet, read_csv, read_parquet, scan_parquet, write_table
from tests.awkward_names import NAMES

TABLE = pl.DataFrame({"x": ["1", "2"], "y": ["a", None]})


@pytest.mark.parametrize("name", NAMES)
def test_names_of_files_and_folders_are_taken_as_they_are(tmp_path: Path, name: str) -> None:
    folder = tmp_path / name
    folder.mkdir()
    for ending in (".parquet", ".csv"):
        # a neighbour that the name would match as a pattern
        for decoy in ("run 1", "ab", "x", "a__b_"):
            (tmp_path / decoy).mkdir(exist_ok=True)
            write_table(TABLE.head(1), tmp_path / decoy / f"{name}{ending}")
        path = folder / f"{name}{ending}"
        write_table(TABLE, path)
        assert sorted(entry.suffix for entry in folder.iterdir()) == sorted({".parquet", ending})
        table = read_parquet(path) if ending == ".parquet" else read_csv(path)
        assert table.rows() == TABLE.rows()
        assert table.columns == TABLE.columns  # no column of the folder's name
    path = folder / f"{name}.parquet"
    assert scan_parquet([path, path], {"x": pl.String, "y": pl.String}).collect().height == 4


def test_a_relative_name_that_begins_with_a_tilde_is_no_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "~").mkdir()
    for ending, read in ((".parquet", read_parquet), (".csv", read_csv)):
        path = Path(f"~/a{ending}")
        write_table(TABLE, path)
        assert read(path).rows() == TABLE.rows()


def test_only_one_module_reads_and_writes_tables() -> None:
    """Polars takes names for patterns by default, so every other module asks this one."""
    calls = re.compile(r"(read|scan|write|sink)_(parquet|csv|ipc|ndjson)")
    for path in Path(tensor_stereo.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if path.name != "table_files.py" and isinstance(node, ast.Attribute):
                assert not calls.fullmatch(node.attr), f"{path}:{node.lineno} calls {node.attr}"


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("x, y\n1,2\n", [("1", "2")]),
        ('"x", "y" \n1,2\n', [("1", "2")]),
        ("x,y\r\n1,2\r\n\r\n\r\n", [("1", "2")]),
        ("x,y\n1,2\n \n  \n,\n", [("1", "2")]),
        ("x,y\n1,2\n\n3,4\n", [("1", "2"), (None, None), ("3", "4")]),  # a gap has a number as a line
        ("\ufeffx,y\n1,2", [("1", "2")]),
        ("x,y\n\n", []),
        ("x,y\n", []),
    ],
)
def test_blanks_of_a_header_and_blank_last_lines_do_not_count(
    tmp_path: Path, text: str, rows: list[tuple[str | None, ...]]
) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8", newline="")
    table = read_csv(path)
    assert table.columns == ["x", "y"]
    assert table.rows() == rows


@pytest.mark.parametrize("header", ["x,x", "x, x", '"x",x'])
def test_a_column_that_is_there_twice_is_refused(tmp_path: Path, header: str) -> None:
    (tmp_path / "a.csv").write_text(f"{header}\n1,2\n")
    with pytest.raises(ValueError, match=r"a\.csv has the column 'x' twice"):
        read_csv(tmp_path / "a.csv")


def test_a_missing_file_is_told_from_a_damaged_one(tmp_path: Path) -> None:
    for read in (read_parquet, read_csv):
        with pytest.raises(FileNotFoundError):
            read(tmp_path / "none")
    (tmp_path / "a.parquet").write_bytes(b"PAR1 no PAR1")
    with pytest.raises(ValueError, match=r"a\.parquet is no readable Parquet file"):
        read_parquet(tmp_path / "a.parquet")


def test_a_file_that_ends_the_decoder_is_refused_and_costs_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.parquet"
    write_table(TABLE, path)
    read_parquet(path)
    process = table_files._DECODER._process
    assert process is not None
    process.kill()  # something else did it
    process.wait()
    assert read_parquet(path).rows() == TABLE.rows()
    table_files._DECODER.stop()
    with monkeypatch.context() as patch:
        patch.setattr(table_files, "_DECODE", "import os; input(); os._exit(1)")
        with pytest.raises(ValueError, match="it ends the decoder"):
            read_parquet(path)
    assert read_parquet(path).rows() == TABLE.rows()


def test_a_changed_byte_is_refused_in_one_line_or_harmless(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    # Such files are read whole or not at all, by every reader, and Polars says nothing of its own on standard error.
    table = pl.DataFrame({"a": [f"text {k}" for k in range(40)], "b": list(range(40))})
    good, path = tmp_path / "good.parquet", tmp_path / "a.parquet"
    table.write_parquet(good, compression="uncompressed")
    content, refused = good.read_bytes(), []
    for place in range(4, len(content), 3):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :])
        try:
            rows = len(lazy_parquet(path).collect())
            assert rows == len(read_parquet(path)) == len(table)
        except ValueError as error:
            refused.append(str(error))
    assert refused
    assert all(text.startswith(f"{path} is no readable Parquet file: ") and "\n" not in text for text in refused)
    assert not capfd.readouterr().err


def test_a_table_that_finds_no_room_is_an_oserror() -> None:
    if not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full")
    table = pl.DataFrame({"x": list(range(100_000))})
    for ending in (".csv", ".parquet"):
        with pytest.raises(OSError, match="No space left"), open("/dev/full", "wb", buffering=0) as full:  # noqa: PTH123
            write_table(table, full, ending)


def test_an_open_file_can_be_written(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    write_table(TABLE, buffer, ".parquet")
    (tmp_path / "a.parquet").write_bytes(buffer.getvalue())
    assert read_parquet(tmp_path / "a.parquet").rows() == TABLE.rows()
    assert os.listdir(tmp_path) == ["a.parquet"]  # noqa: PTH208
