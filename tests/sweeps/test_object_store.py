"""A sweep whose images and manifest lie in an S3-compatible store, which a server of this machine plays."""

from __future__ import annotations

from pathlib import Path

import fsspec
import polars as pl
import pytest

from tensor_stereo.cli import main
from tensor_stereo.datasets.files import PATHS
from tests.cli.failing import fails
from tests.sweeps.conftest import Inputs, assert_same, stored

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # those of the server's packages


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch):
    """The URL of an empty bucket."""
    server_module = pytest.importorskip("moto.server")
    pytest.importorskip("s3fs")
    server = server_module.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    server.start()
    host, port = server.get_host_and_port()
    for name, value in {
        "AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
    }.items():  # fmt: skip
        monkeypatch.setenv(name, value)
    fsspec.filesystem("s3").mkdir("pairs")
    yield "s3://pairs"
    server.stop()
    fsspec.filesystem("s3").clear_instance_cache()


def test_its_rows_are_those_of_local_files(
    bucket: str, inputs: Inputs, expected: pl.DataFrame, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files, manifest = fsspec.filesystem("s3"), pl.read_parquet(inputs.manifest)
    for name in PATHS:
        for path in manifest[name].drop_nulls():
            files.put_file(path, f"pairs/images/{Path(path).name}")
    renamed = [pl.concat_str(pl.lit(f"{bucket}/images/"), pl.col(name).str.split("/").list.last()) for name in PATHS]
    remote = manifest.with_columns(
        pl.when(pl.col(name).is_not_null()).then(url).alias(name) for name, url in zip(PATHS, renamed, strict=True)
    )
    for part, rows in enumerate((remote[:4], remote[4:])):
        rows.write_parquet(tmp_path / "part.parquet")
        files.put_file(str(tmp_path / "part.parquet"), f"pairs/manifest/{part}.parquet")
    command = ["sweep", str(inputs.settings), "--manifest", f"{bucket}/manifest", "--workers", "2"]
    main([*command, "--out", str(tmp_path / "run")])
    assert "12 of 12 units done" in capsys.readouterr().out
    assert_same(stored(tmp_path / "run"), expected)
    main([*command, "--out", str(tmp_path / "run")])
    assert "12 of 12 units done, 0 now" in capsys.readouterr().out
    fails([*command, "--out", f"{bucket}/run"], capsys, "--out", "renamed in one step")
    fails(["sweep", str(inputs.settings), "--manifest", "s3://pairs/none", "--out", str(tmp_path / "x")], capsys,
          "s3://pairs/none")  # fmt: skip
