"""Tables in Parquet and CSV files. Every path is one file by its name, never a pattern. Imports no torch."""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import polars as pl

from tensor_stereo.limits import MAX_ROWS
from tensor_stereo.paths import has_ending

_MAX_DECODE_SECONDS = 600
# Polars would inflate such a file, whatever its ending says, and to any size: gzip, zlib, Zstandard.
_COMPRESSED = (b"\x1f\x8b", b"x\x01", b"x\x9c", b"x\xda", b"\x28\xb5\x2f\xfd")
_FAILURES = (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError, ValueError)


def read_parquet(path: Path) -> pl.DataFrame:
    """Read a Parquet file.

    Args:
        path: The file. Brackets, stars, question marks and a leading ``~`` are part of its name.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is damaged, or has more than ``MAX_ROWS`` rows.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_table(pl.DataFrame({"a": [1, 2]}), Path(folder, "[1]*.parquet"))
    ...     read_parquet(Path(folder, "[1]*.parquet"))["a"].to_list()
    [1, 2]
    """
    with path.open("rb") as file:
        _DECODER.check(path)
        try:
            return pl.read_parquet(file, glob=False, hive_partitioning=False)
        except _FAILURES as error:
            raise ValueError(f"{path} is no readable Parquet file: {_one_line(error)}") from error


def lazy_parquet(path: Path, *, check: bool = True) -> pl.LazyFrame:
    """A Parquet file as a lazy table, after the same checks as by :func:`read_parquet`.

    Args:
        path: The file.
        check: False for a file of this process's own.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is damaged, or has more than ``MAX_ROWS`` rows.
    """
    path.open("rb").close()
    check_name(path)
    if check:
        _DECODER.check(path)
    return pl.scan_parquet(path.absolute(), glob=False, hive_partitioning=False)


def scan_parquet(paths: Sequence[Path], schema: dict[str, Any]) -> pl.LazyFrame:
    """Parquet files of our own as one lazy table; columns of ``schema`` that a file lacks are null."""
    if not paths:
        return pl.LazyFrame(schema=schema)
    files = [path.absolute() for path in paths]
    for path in files:
        check_name(path)
    return pl.scan_parquet(files, schema=schema, missing_columns="insert", glob=False, hive_partitioning=False)


def read_csv(path: Path) -> pl.DataFrame:
    r"""Read a CSV file as text, so that what is carried through stays as it is.

    Blanks around the names of the columns do not count, nor do blank lines at the end.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is compressed or damaged, a column is there twice, or it has more than ``MAX_ROWS`` rows.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "a.csv").write_text("x, y\n1,2.0\n\n")
    ...     read_csv(Path(folder, "a.csv")).to_dicts()
    [{'x': '1', 'y': '2.0'}]
    """
    with path.open("rb") as file:
        if file.read(4).startswith(_COMPRESSED):
            raise ValueError(f"{path} is compressed, not a CSV file; unpack it first")
        file.seek(0)
        try:
            header = pl.read_csv(file, has_header=False, n_rows=1, infer_schema=False).row(0)
            file.seek(0)
            table = pl.read_csv(file, infer_schema=False)
        except _FAILURES as error:
            raise ValueError(f"{path} is no readable CSV file: {_one_line(error)}") from error
    names = [_unquoted(name or "") for name in header]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"{path} has the column {twice!r} twice")
    table.columns = names
    is_blank = pl.all_horizontal(pl.all().fill_null("").str.strip_chars() == "")
    last = table.select((~is_blank).arg_true().max()).item()
    table = table.head(0 if last is None else last + 1)
    if len(table) > MAX_ROWS:
        raise ValueError(f"{path} must have at most {MAX_ROWS} rows, got {len(table)}")
    return table


def check_name(path: Path) -> None:
    """Raise for names that are no UTF-8, which no table can hold and Polars cannot open.

    Raises:
        ValueError: naming the path.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise ValueError(f"{str(path).encode(errors='replace').decode()} has a name that is no UTF-8") from None


def _one_line(error: Exception) -> str:
    """The first sentence of what Polars says; the rest is advice to programmers."""
    return " ".join(str(error).strip().split("\n", 1)[0].split())


def _unquoted(name: str) -> str:
    """A name without blanks, and without quotes that a blank before them kept."""
    name = name.strip()
    return name[1:-1] if len(name) > 1 and name[0] == name[-1] == '"' else name


def write_table(table: pl.DataFrame, target: Path | IO[bytes], ending: str = "") -> None:
    """Write a table as CSV or Parquet.

    Args:
        table: The rows.
        target: The file, or an open one.
        ending: ``.csv`` or ``.parquet``; the one of ``target`` if not given.

    Raises:
        OSError: If it cannot be written.
    """
    is_csv = ending == ".csv" or (not ending and isinstance(target, Path) and has_ending(target, ".csv"))
    try:
        if not isinstance(target, Path):
            table.write_csv(target) if is_csv else table.write_parquet(target)
            return
        with target.open("wb") as file:
            table.write_csv(file) if is_csv else table.write_parquet(file)
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:  # where there is no room
        raise OSError(f"{target} cannot be written: {error}") from error


def write_lazy(table: pl.LazyFrame, path: Path) -> None:
    """Write a lazy table as Parquet, a part at a time.

    Raises:
        OSError: If it cannot be written.
    """
    try:
        table.sink_parquet(path)
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:
        raise OSError(f"{path} cannot be written: {error}") from error


class _Decoder:
    """Decodes Parquet files in a process of its own first.

    Damaged Parquet can end the process that decodes it: Polars believes lengths in the data and allocates them.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._owner = 0  # a forked process must not talk to the decoder of its parent

    def check(self, path: Path) -> None:
        """Raise ValueError unless a file can be decoded and has at most ``MAX_ROWS`` rows."""
        with self._lock:
            answer = self._ask(path) or self._ask(path)  # something else may have ended it
        if answer is None:
            raise ValueError(f"{path} is no readable Parquet file: it ends the decoder")
        if answer.get("num_rows", 0) > MAX_ROWS:
            raise ValueError(f"{path} must have at most {MAX_ROWS} rows, got {answer['num_rows']}")
        if "error" in answer:
            raise ValueError(f"{path} is no readable Parquet file: {answer['error']}")

    def _ask(self, path: Path) -> dict[str, Any] | None:
        """The answer of the process; None if it ended or hung."""
        process = self._process if self._process and self._owner == os.getpid() else self._start()
        if process.stdin is None or process.stdout is None:
            raise RuntimeError("the decoder of Parquet files has no pipes")
        watch = threading.Timer(_MAX_DECODE_SECONDS, process.kill)
        watch.start()
        try:
            process.stdin.write(json.dumps([str(path.absolute()), MAX_ROWS]) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except OSError:
            line = ""
        finally:
            watch.cancel()
        if line:
            return dict(json.loads(line))
        self.stop()
        return None

    def _start(self) -> subprocess.Popen[str]:
        command = [sys.executable, "-P", "-c", _DECODE]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True, encoding="utf-8"
        )
        self._owner = os.getpid()
        atexit.register(self.stop)
        return self._process

    def stop(self) -> None:
        """End the process, if there is one."""
        process, self._process = self._process, None
        atexit.unregister(self.stop)
        if process is not None:
            process.kill()
            process.communicate()


# Answers a path with the number of rows that its file claims, and with an error if they cannot be decoded.
_DECODE = """
import json, sys
import polars as pl
for line in sys.stdin:
    path, max_rows = json.loads(line)
    answer = {}
    try:
        with open(path, "rb") as file:
            table = pl.scan_parquet(file, glob=False, hive_partitioning=False)
            answer["num_rows"] = table.select(pl.len()).collect().item()
            if answer["num_rows"] <= max_rows:
                file.seek(0)
                table = pl.scan_parquet(file, glob=False, hive_partitioning=False)
                found = sum(map(len, table.collect_batches(chunk_size=1 << 16)))  # ends early where a column is cut
                if found < answer["num_rows"]:
                    answer["error"] = f"only {found} of its {answer['num_rows']} rows can be decoded"
    except BaseException as error:
        answer["error"] = " ".join(str(error).strip().split("\\n", 1)[0].split())
    print(json.dumps(answer), flush=True)
"""
_DECODER = _Decoder()
