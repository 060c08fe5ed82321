"""Errors before any work are quick, because nothing heavy is imported for them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import tensor_stereo

HEAVY = ("torch", "kornia", "scipy", "cv2", "polars", "matplotlib", "ray")
_SCRIPT = """
import sys
from tensor_stereo.cli import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    code = end.code
else:
    code = 0
print(code, *(name for name in {heavy} if name in sys.modules))
"""


def start(*arguments: str) -> tuple[str, str]:
    """The last line of standard output, which is the exit code and the heavy modules; and standard error."""
    command = [sys.executable, "-c", _SCRIPT.format(heavy=HEAVY), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1], done.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("start")
    for name in ("left.png", "right.png", "file"):
        (folder / name).touch()
    (folder / "m.csv").write_text("x0,y0,x1,y1\n")
    (folder / "m.parquet").write_bytes(b"PAR1")
    (folder / "bad.toml").write_text("[grid]\ndetector = 'orb'\n")
    (folder / "good.toml").write_text("[grid]\n")
    (folder / "slope.toml").write_text("[grid]\nconsensus.slope = -1.0\n")
    return folder


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("classify none.png right.png", "LEFT: there is no file"),
        ("classify left.png right.png --out m.xlsx", "--out must end in .csv or .parquet"),
        ("classify left.png right.png --figure m.jpg", "--figure must end in .png"),
        ("classify left.png right.png --out file/m.csv", "--out: the folder"),
        ("classify left.png right.png --min-precision 2", "--min-precision must lie in [0, 1]"),
        ("classify left.png right.png --nonsense 3", "nonsense"),
        ("classify left.png right.png --fast.window-px 4", "--fast.window-px must be odd"),
        ("classify left.png right.png --verdict adjacency --threshold .3", "--threshold needs --verdict score"),
        ("evaluate nowhere", "ROOT: there is no folder"),
        ("filter none.csv --out b.csv", "MATCHES: there is no file"),
        ("filter m.csv --out b.npz", "--out must end in .csv"),
        (
            "filter m.csv --out b.csv --threshold .3 --min-precision .9",
            "--min-precision must be None beside --threshold",
        ),
        ("filter m.csv --out m.csv", "--out must be another file than MATCHES"),
        ("index nowhere", "ROOTS: there is no file or folder"),
        ("download kitti-2051", "RELEASES must be among"),
        ("report nowhere", "RUNS: there is no folder"),
        ("report .", "no config.json"),
        ("sweep none.toml --manifest m.parquet --out run", "there is no file of settings"),
        ("sweep bad.toml --manifest m.parquet --out run", "detector must be one of"),
        ("sweep good.toml --manifest none.parquet --out run", "--manifest: there is no file"),
        ("demo --num-pairs 0", "--num-pairs must be at least 1"),
        ("render file/x", "--out: the folder"),
        ("render out --num-pairs 0", "--num-pairs must be at least 1"),
        ("classify left.png right.png --figure left.png", "--figure must be another file than LEFT"),
        ("classify left.png right.png --disparity-gt left.png --gt-scale -1", "(--gt-scale) must be positive"),
        (
            "classify left.png right.png --matching.min-disparity-px 5 --matching.max-disparity-px 4",
            "--matching.min-disparity-px must be at most --matching.max-disparity-px",
        ),
        ("classify left.png right.png --restriction adjacency", "--restriction is --verdict now"),
        ("evaluate . --detectors fast fast", "--detectors must"),
        ("evaluate . --scenes nothing", "no stereo pairs"),
        ("sweep good.toml --manifest m.parquet --out run --shard x", "--shard must"),
        ("sweep good.toml --manifest m.parquet --out run --workers 0", "--workers must"),
        ("sweep slope.toml --manifest m.parquet --out run", "slope.toml: consensus.slope must"),
    ],
)
def test_a_call_that_fails_before_any_work_loads_nothing_heavy(
    folder: Path, monkeypatch: pytest.MonkeyPatch, arguments: str, words: str
) -> None:
    monkeypatch.chdir(folder)
    ended, error = start(*arguments.split())
    assert ended == "2"
    assert words in " ".join(error.split())


@pytest.mark.parametrize("arguments", [["--help"], ["sweep", "--help"], ["--version"]])
def test_help_and_version_load_nothing_heavy(arguments: list[str]) -> None:
    ended, error = start(*arguments)
    assert ended == "0"
    assert not error


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    from tensor_stereo.cli import main

    main(["--version"])
    assert capsys.readouterr().out == f"tensor-stereo {tensor_stereo.__version__}\n"
