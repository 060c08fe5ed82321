from __future__ import annotations

import csv
import gzip
import zlib
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tensor_stereo import Matches, Relation, table_files
from tensor_stereo.batching import ptr_to_batch, split_matches
from tensor_stereo.configs import PipelineConfig
from tensor_stereo.datasets.synthetic.rendering import SyntheticDataset
from tensor_stereo.interop.glue_factory import two_view_filter
from tensor_stereo.interop.match_tables import filter_table
from tensor_stereo.pipeline import run_pipeline
from tensor_stereo.reports.pair import match_table
from tests.interop.match_batches import batch, exact_filter, expected_exactly

ENDINGS = (".csv", ".parquet")
NAMES = [relation.name.lower() for relation in Relation]
HEADER = "x0,y0,x1,y1"


def table_of(matches: Matches) -> pl.DataFrame:
    columns = {
        "x0": matches.keypoints0[:, 0],
        "y0": matches.keypoints0[:, 1],
        "x1": matches.keypoints1[:, 0],
        "y1": matches.keypoints1[:, 1],
        "pair": ptr_to_batch(matches.ptr),
        "cost": matches.cost,
        "group": matches.group,
    }
    return pl.DataFrame({name: values.numpy() for name, values in columns.items() if values is not None})


def filtered(folder: Path, table: pl.DataFrame, ending: str) -> pl.DataFrame:
    source, target = folder / f"in{ending}", folder / f"out{ending}"
    table.write_csv(source) if ending == ".csv" else table.write_parquet(source)
    summary = filter_table(source, target, exact_filter())
    types = {"inlier": pl.Boolean, "score": pl.Float64, "relation": pl.String}
    result = pl.read_csv(target, schema_overrides=types) if ending == ".csv" else pl.read_parquet(target)
    assert summary.num_matches == len(result)
    assert summary.num_kept == result["inlier"].sum()
    assert summary.num_untested == (result["relation"] == "untested").sum()
    return result


def assert_verdicts(result: pl.DataFrame, matches: Matches, rows: np.ndarray | slice = slice(None)) -> None:
    """Row ``rows[k]`` of the table must be match k."""
    verdicts = expected_exactly(matches)
    np.testing.assert_array_equal(result["inlier"].to_numpy()[rows], verdicts.inlier)
    np.testing.assert_array_equal(result["score"].to_numpy()[rows], verdicts.score)
    assert result["relation"].to_numpy()[rows].tolist() == [NAMES[value] for value in verdicts.relation]


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("has_group", [False, True])
def test_rows_get_the_verdicts_of_the_same_matches(tmp_path: Path, ending: str, has_group: bool) -> None:
    matches = batch(3, has_group=has_group)
    table = table_of(matches)
    result = filtered(tmp_path, table, ending)
    assert result.columns == [*table.columns, "inlier", "score", "relation"]
    assert result.select(table.columns).rows() == table.rows()
    assert_verdicts(result, matches)


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6), as_text=st.booleans())
def test_rows_of_a_pair_need_not_be_adjacent(
    tmp_path_factory: pytest.TempPathFactory, seed: int, as_text: bool
) -> None:
    matches = batch(seed, [30, 1, 20, 3])
    table = table_of(matches).drop("cost")
    # Without costs the first of two duplicates stays, so rows of one pair keep their order.
    order = np.random.default_rng(seed).permutation(len(table))
    pair = table["pair"].to_numpy()
    mixed = np.empty(len(table), dtype=np.int64)
    for b in range(4):
        mixed[np.sort(order[pair == b])] = np.flatnonzero(pair == b)
    shuffled = table[mixed.tolist()]
    if as_text:
        shuffled = shuffled.with_columns(pair=pl.format("ü, {}", pl.col("pair") % 3 * 7 - pl.col("pair")))
    result = filtered(tmp_path_factory.mktemp("table"), shuffled, ".csv")
    plain = Matches(matches.keypoints0, matches.keypoints1, matches.ptr)
    assert_verdicts(result, plain, np.argsort(mixed))


def test_a_batch_is_its_pairs_one_at_a_time(tmp_path: Path) -> None:
    whole = filtered(tmp_path, table_of(batch(4)), ".csv")
    items = [item for item in split_matches(batch(4)) if item.num_matches]
    parts = [filtered(tmp_path, table_of(item).drop("pair"), ".csv") for item in items]
    columns = ["inlier", "score", "relation"]
    assert pl.concat(parts).select(columns).equals(whole.select(columns))


def test_other_columns_of_a_csv_keep_their_text(tmp_path: Path) -> None:
    source, target = tmp_path / "in.csv", tmp_path / "out.csv"
    rows = ["1.50,01,-2e0,+4,,007,1.0", '9,1,8,1,"a, ""b""",,nan', " 2,7 ,1,7,ü,x,inf"]
    source.write_text("\n".join([f"{HEADER},name,code,note", *rows]) + "\n")
    filter_table(source, target, exact_filter())
    with source.open(newline="") as before, target.open(newline="") as after:
        for row, given_ in zip(csv.reader(after), csv.reader(before), strict=True):
            assert row[:7] == given_
    assert target.read_text().splitlines()[1] == "1.50,01,-2e0,+4,,007,1.0,false,0.0,untested"


def test_other_columns_of_a_parquet_file_keep_their_types(tmp_path: Path) -> None:
    table = table_of(batch(6)).with_row_index("row")
    table = table.with_columns(
        a=pl.concat_list("x0", "y0"), b=pl.col("row").cast(pl.String).cast(pl.Categorical), c=pl.struct("pair", "cost")
    )
    result = filtered(tmp_path, table, ".parquet")
    assert result.select(table.columns).equals(table)
    assert result.select(table.columns).schema == table.schema


@pytest.mark.parametrize("ending", ENDINGS)
def test_what_classify_writes_is_read_back(tmp_path: Path, ending: str) -> None:
    pair = SyntheticDataset(1, seed=1)[0]
    settings = {"score": "consensus", "rectified": "auto"}
    for config in (PipelineConfig(**settings), PipelineConfig(**settings, constrained=True)):  # type: ignore[arg-type]
        output = run_pipeline([(pair.image0, pair.image1)], config)
        table = match_table(output, config)
        result = filtered(tmp_path, table, ending)
        assert len(result) > 100
        assert result["relation"].to_list() == table["relation"].to_list()
        assert result["inlier"].to_list() == table["inlier"].to_list()
        probability = table["probability"].to_list()
        assert result["score"].to_list() == pytest.approx(probability, abs=1e-5)  # of float32
        results = {"probability", "inlier_adjacency", "inlier_cardinality", "inlier_score"}  # of classify, now outdated
        assert sorted(result.columns) == sorted({*table.columns, "score"} - results)


@pytest.mark.parametrize("ending", ENDINGS)
def test_filtering_twice_replaces_the_verdicts(tmp_path: Path, ending: str) -> None:
    first = filtered(tmp_path, table_of(batch(7)), ending)
    assert filtered(tmp_path, first, ending).equals(first)


@pytest.mark.parametrize("ending", ENDINGS)
def test_tables_without_rows_and_pairs_of_one_match_pass(tmp_path: Path, ending: str) -> None:
    table = table_of(batch(8, [1]))
    result = filtered(tmp_path, table, ending)
    assert result.select("inlier", "score", "relation").rows() == [(False, 0.0, "untested")]
    assert len(filtered(tmp_path, table[:0], ending)) == 0
    assert filter_table(tmp_path / f"in{ending}", tmp_path / f"out{ending}", exact_filter()).num_pairs == 0


def test_pairs_may_be_categories(tmp_path: Path) -> None:
    table = table_of(batch(9))
    plain = filtered(tmp_path, table, ".parquet")
    named = table.with_columns(pl.format("pair {}", "pair").cast(pl.Categorical).alias("pair"))
    assert filtered(tmp_path, named, ".parquet")["score"].equals(plain["score"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x0,y0,x1\n1,2,3\n", r"in\.csv has no column 'y1', it has \['x0', 'y0', 'x1'\]"),
        (f"{HEADER}\n1,2,3,4\n1,2,,4\n", r"in\.csv, line 3: column 'x1' is empty"),
        (f"{HEADER}\n1,2,3,4\n1,2\n", r"in\.csv, line 3: column 'x1' is empty"),
        (f"{HEADER}\n1,2,3,4\n1,2,3,4,5\n", r"in\.csv is no readable CSV file"),
        (f"{HEADER}\n1,two,3,4\n", r"in\.csv, line 2: column 'y0' must be a number, got 'two'"),
        (f"{HEADER}\n1,2,3,4\n1,2,3,nan\n", r"in\.csv, line 3: \(x1, y1\) must be finite, .* got \(3\.0, nan\)"),
        (f"{HEADER},pair\n1,2,3,4,a\n1e99,2,3,4,b\n", r"in\.csv, line 3 \(pair 'b'\): \(x0, y0\) must be finite"),
        (f"{HEADER},pair\n1,2,3,4,a\n1,2,3,4,\n", r"in\.csv, line 3: column 'pair' is empty"),
        (f"{HEADER},cost\n1,2,3,4,NaN\n", r"in\.csv, line 2: column 'cost' must not be NaN"),
        (f"{HEADER},cost\n1,2,3,4,\n", r"in\.csv, line 2: column 'cost' is empty"),
        (f"{HEADER},group\n1,2,3,4,1.5\n", r"in\.csv, line 2: column 'group' must be an integer, got '1\.5'"),
        (f"{HEADER},x0\n1,2,3,4,5\n", r"in\.csv has the column 'x0' twice"),
        ("", r"in\.csv is no readable CSV file"),
        ('x0,"y0\n1,2\n', r"in\.csv is no readable CSV file"),
    ],
)
def test_a_wrong_csv_names_file_row_and_column(tmp_path: Path, text: str, message: str) -> None:
    source = tmp_path / "in.csv"
    source.write_text(text)
    with pytest.raises(ValueError, match=message):
        filter_table(source, tmp_path / "out.csv", exact_filter())
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize("data", [b"x0,y0,x1,y1\n1,2,3,\xff\n", bytes(range(256)) * 9])
def test_what_is_no_text_is_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "in.csv").write_bytes(data)
    with pytest.raises(ValueError, match=r"in\.csv"):
        filter_table(tmp_path / "in.csv", tmp_path / "out.csv", exact_filter())


@pytest.mark.parametrize("compress", [gzip.compress, zlib.compress, lambda data: zlib.compress(data, 9)])
def test_a_compressed_csv_is_not_inflated(tmp_path: Path, compress: object) -> None:
    source = tmp_path / "in.csv"
    source.write_bytes(compress(f"{HEADER}\n1,2,3,4\n".encode()))  # type: ignore[operator]
    with pytest.raises(ValueError, match=r"in\.csv is compressed"):
        filter_table(source, tmp_path / "out.csv", exact_filter())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x0": pl.lit("1")}, None),
        ({"x0": pl.lit(True)}, "column 'x0' must hold a number per row, got Boolean"),
        ({"group": pl.lit(1.5)}, "row 1.*: column 'group' must be an integer, got 1.5"),
        ({"pair": pl.lit(1.5)}, "column 'pair' must hold strings or integers, got Float64"),
        ({"y1": pl.lit(None, dtype=pl.Float32)}, r"row 1 \(pair 0\): column 'y1' is empty"),
        ({"cost": pl.lit(None)}, "column 'cost' must hold a number per row, got Null"),
    ],
)
def test_a_wrong_parquet_file_names_file_and_column(
    tmp_path: Path, change: dict[str, pl.Expr], message: str | None
) -> None:
    table = table_of(batch(0, [9])).with_columns(**change)
    if message is None:
        assert len(filtered(tmp_path, table, ".parquet")) == 9
        return
    with pytest.raises(ValueError, match=message) as caught:
        filtered(tmp_path, table, ".parquet")
    assert str(tmp_path / "in.parquet") in str(caught.value)


@pytest.mark.parametrize("place", ["end", "footer", "page"])
def test_damaged_parquet_is_named_and_does_not_end_the_process(tmp_path: Path, place: str) -> None:
    source = tmp_path / "in.parquet"
    table_of(batch(0, [60])).write_parquet(source, compression="uncompressed")
    data = source.read_bytes()
    damaged = {
        "end": data[: len(data) // 2],
        "footer": data[:-300] + bytes(200) + data[-100:],
        # The header of a page in Thrift's compact form: 60 values become -61, for which Polars wants 2 ** 61 bytes.
        "page": data.replace(b"\x2c\x15\x78\x15", b"\x2c\x15\x79\x15"),
    }
    source.write_bytes(damaged[place])
    with pytest.raises(ValueError, match=r"in\.parquet is no readable Parquet file: "):
        filter_table(source, tmp_path / "out.parquet", exact_filter())
    assert not (tmp_path / "out.parquet").exists()


def test_more_rows_than_the_limit_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table_files, "MAX_ROWS", 5)
    for ending in ENDINGS:
        with pytest.raises(ValueError, match="must have at most 5 rows, got 9"):
            filtered(tmp_path, table_of(batch(0, [9])), ending)


@pytest.mark.parametrize("name", ["[1].csv", "*.csv", "[1].parquet"])
def test_names_are_no_patterns(tmp_path: Path, name: str) -> None:
    ending = Path(name).suffix
    table = table_of(batch(0, [9]))
    filtered(tmp_path, table, ending)
    (tmp_path / f"in{ending}").rename(tmp_path / name)
    assert filter_table(tmp_path / name, tmp_path / f"out{ending}", exact_filter()).num_matches == 9


def test_columns_of_the_user_are_kept(tmp_path: Path) -> None:
    """A ``score`` or ``probability`` that no earlier verdict wrote is somebody's own."""
    own = table_of(batch(3)).with_columns(pl.lit(0.5).alias("score"), pl.lit(0.25).alias("probability"))
    own.write_parquet(tmp_path / "in.parquet")
    filter_table(
        tmp_path / "in.parquet", tmp_path / "out.parquet", two_view_filter(verdict="cardinality", score="none")
    )
    result = pl.read_parquet(tmp_path / "out.parquet")
    assert result.select(own.columns).equals(own)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_score_of_the_user_survives_filters(tmp_path: Path, ending: str) -> None:
    """Also one that could be ours, through filters with and without a score."""
    users = [k / 50 + 0.1 for k in range(40)]
    table = table_of(batch(3, [40]))
    plain = filtered(tmp_path, table, ending)
    own = table.with_columns(pl.Series("score", users), pl.lit("mine").alias("relation"))
    for score in ("consensus", "none", "consensus", "consensus"):
        own = filtered_as(tmp_path, own, ending, score=score)
        assert own["score"].cast(pl.Float64).to_list() == users
        assert own["relation"].to_list() == ["mine"] * 40
        assert own["filter_relation"].to_list() == plain["relation"].to_list()
        scored = ["filter_score"] if score != "none" else []
        assert own.columns == [*table.columns, "score", "relation", "inlier", *scored, "filter_relation"]
        if scored:
            assert own["filter_score"].cast(pl.Float64).to_list() == plain["score"].to_list()


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_name_of_the_score_can_be_chosen(tmp_path: Path, ending: str) -> None:
    table = table_of(batch(3, [40])).with_columns(pl.lit(7.5).alias("score"))
    plain = filtered(tmp_path, table_of(batch(3, [40])), ending)
    for _ in range(2):
        table = filtered_as(tmp_path, table, ending, score_name="kept")
        assert table["score"].cast(pl.Float64).to_list() == [7.5] * 40
        assert table["kept"].cast(pl.Float64).to_list() == plain["score"].to_list()
    with pytest.raises(ValueError, match=r"score_name must be a new name in .*, which has 'x0'"):
        filtered_as(tmp_path, table, ending, score_name="x0")


def filtered_as(
    folder: Path, table: pl.DataFrame, ending: str, score_name: str | None = None, score: str = "consensus"
) -> pl.DataFrame:
    source, target = folder / f"in{ending}", folder / f"out{ending}"
    table_files.write_table(table, source)
    filter_table(source, target, two_view_filter(verdict="cardinality", score=score), score_name=score_name)
    return table_files.read_csv(target) if ending == ".csv" else table_files.read_parquet(target)


def test_tables_of_other_tools_are_read(tmp_path: Path) -> None:
    """Blanks after commas, 1.0 in a column of integers, blank last lines, Windows line ends, a byte order mark."""
    table = table_of(batch(3, has_group=True))
    expected = filtered(tmp_path, table, ".csv")
    lines = [", ".join(table.columns)]
    for row in table.iter_rows(named=True):
        values = [f"{float(value):.1f}" if name == "group" else str(value) for name, value in row.items()]
        lines.append(", ".join(values))
    (tmp_path / "in.csv").write_text("\ufeff" + "\r\n".join([*lines, "", " ", ""]), encoding="utf-8", newline="")
    filter_table(tmp_path / "in.csv", tmp_path / "out.csv", exact_filter())
    result = table_files.read_csv(tmp_path / "out.csv")
    assert len(result) == len(table)
    for name in ("inlier", "score", "relation"):
        assert result[name].to_list() == expected[name].cast(pl.String).to_list()


@pytest.mark.parametrize("value", ["1.5", "1e300", "nan", "inf", "", "x", "9223372036854775808"])
def test_a_group_that_is_no_integer_is_named(tmp_path: Path, value: str) -> None:
    (tmp_path / "in.csv").write_text(f"{HEADER},group\n1,2,3,4,2.0\n1,2,3,4,{value}\n")
    with pytest.raises(ValueError, match=r"in\.csv, line 3: column 'group' (must be an integer|is empty)"):
        filter_table(tmp_path / "in.csv", tmp_path / "out.csv", exact_filter())


def test_a_pair_is_one_however_it_is_spelled(tmp_path: Path) -> None:
    table = table_of(batch(3, [30, 20]))
    expected = filtered(tmp_path, table, ".csv")
    names = [(" 7", "7.0", "7")[k % 3] if k < 30 else (" a", "a ", "a")[k % 3] for k in range(50)]
    for own in (names, [name.replace("a", "9") for name in names]):
        result = filtered(tmp_path, table.with_columns(pl.Series("pair", own)), ".csv")
        # text is compared as text, so 7 and 7.0 are one pair only where all names are numbers
        if "9" in own[-1]:
            assert result["score"].to_list() == expected["score"].to_list()
        assert result["score"].to_list()[30:] == expected["score"].to_list()[30:]
