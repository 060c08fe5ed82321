from __future__ import annotations

import errno
import os
import shutil
import stat
from pathlib import Path

import pytest

from tensor_stereo.cli import main
from tensor_stereo.datasets import read_manifest
from tensor_stereo.reports.sweep.runs import load_run
from tensor_stereo.sweeps import read_results, run_sweep
from tests.awkward_names import NAMES
from tests.sweeps.conftest import Inputs


@pytest.fixture(scope="module")
def finished(inputs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small run that is copied to other names."""
    out = tmp_path_factory.mktemp("names") / "run 1"
    run_sweep(inputs.config, inputs.manifest, out, num_workers=1, limit=2)
    return out


@pytest.mark.parametrize("name", NAMES)
def test_a_run_of_any_name_is_read_and_reported(
    finished: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / name / name
    shutil.copytree(finished, run)
    other = tmp_path / name / "run 1"  # what ``run [1]`` would match
    if not other.exists():
        shutil.copytree(finished, other)
        for path in (other / "metrics").iterdir():
            path.unlink()
    expected = read_results(finished)
    assert read_results(run).equals(expected)
    assert read_manifest(run / "manifest.parquet", check_files=False)
    assert load_run(run, num_overlays=0).name == name
    if name == NAMES[0]:  # the page is read from what was loaded
        main(["report", str(run)])
        assert str(run / "report.html") in capsys.readouterr().out


def test_a_sweep_into_a_folder_of_any_name_goes_on(inputs: Inputs, tmp_path: Path) -> None:
    folder = tmp_path / "seed=3" / "a*b [1]"
    folder.mkdir(parents=True)
    manifest = folder / "m [1].parquet"
    shutil.copy(inputs.manifest, manifest)
    for _ in range(2):
        run_sweep(inputs.config, manifest, folder / "run [1]", num_workers=1, limit=1)
    assert read_results(folder / "run [1]")["unit"].n_unique() == 2


def test_a_sweep_starts_where_folders_cannot_be_flushed(
    inputs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flush = os.fsync

    def refuse_folders(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        flush(descriptor)

    monkeypatch.setattr(os, "fsync", refuse_folders)
    run_sweep(inputs.config, inputs.manifest, tmp_path / "run", num_workers=1, limit=1)
    assert read_results(tmp_path / "run")["unit"].n_unique() == 1
