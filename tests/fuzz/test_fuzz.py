"""A few mutated files of every format through the command line; ``make fuzz-files`` runs more."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fuzz.__main__ import fuzz
from tests.fuzz.cases import FORMATS, MEGABYTES, find_fault, make_case, run_case
from tests.fuzz.seeds import seeds
from tests.fuzz.zygote import Ending, Zygote

COUNT, SEED = 20, 0
TRACE = ("Traceback (most recent call last):", "RecursionError")
ERROR, WARNING = "tensor-stereo: m.csv is empty", "tensor-stereo: warning: far"


@pytest.fixture(scope="module")
def zygote() -> Iterator[Zygote]:
    pytest.importorskip("h5py", reason="h5py is not installed")
    with Zygote() as one:
        yield one


@pytest.mark.slow
@pytest.mark.parametrize("kind", FORMATS)
def test_mutated_files_end_in_an_answer_or_in_one_line(zygote: Zygote, kind: str) -> None:
    keep = Path(tempfile.gettempdir(), "tensor-stereo-fuzz")
    results = fuzz(kind, range(COUNT), [zygote], seed=SEED, keep=keep)
    findings = [result.finding for result in results if result.finding]
    again = f"python -m tests.fuzz --formats {kind} --seed {SEED} --count {COUNT}"
    assert not findings, "\n".join([*map(str, findings), f"run again: {again}"])


@pytest.mark.slow
@pytest.mark.parametrize("kind", FORMATS)
def test_files_that_are_not_mutated_get_an_answer(zygote: Zygote, kind: str, tmp_path: Path) -> None:
    for number, seed in enumerate(seeds(kind)):
        folder = tmp_path / str(number)
        folder.mkdir()
        ending, fault = run_case(zygote, seed, folder)
        is_coloured = seed.files.get("gt.pfm", b"").startswith(b"PF")  # which no ground truth is
        assert (ending.code, fault) == (2 if is_coloured else 0, ""), ending.errors


@pytest.mark.parametrize("kind", FORMATS)
def test_a_number_makes_one_file(kind: str) -> None:
    if kind == "h5":
        pytest.importorskip("h5py", reason="h5py is not installed")
    made = [make_case(kind, 3, number) for number in (0, 1, 0)]
    assert made[0] == made[2] != made[1]


@pytest.mark.parametrize(
    ("code", "errors", "fault"),
    [
        (0, (), ""),
        (0, (WARNING,), ""),
        (1, (ERROR,), ""),
        (2, (WARNING, ERROR), ""),
        (2, (), "0 lines on standard error with exit code 2"),
        (2, (ERROR, ERROR), "2 lines on standard error with exit code 2"),
        (0, (ERROR,), "1 lines on standard error with exit code 0"),
        (2, ("libpng error",), "an error that is not the program's"),
        (1, TRACE, "a traceback"),
        (-11, (), "ended by signal 11"),
        (3, (ERROR,), "exit code 3"),
    ],
)
def test_how_a_command_may_end(tmp_path: Path, code: int, errors: tuple[str, ...], fault: str) -> None:
    case = seeds("csv")[0]
    (tmp_path / "m.csv").write_bytes(case.files["m.csv"])
    assert find_fault(Ending(code, 0.1, 300.0, False, errors), case, tmp_path) == fault


def test_what_a_command_may_take_and_leave(tmp_path: Path) -> None:
    case = seeds("csv")[0]
    source, out = tmp_path / "m.csv", tmp_path / "out.csv"
    source.write_bytes(case.files["m.csv"])
    done, refused = Ending(0, 0.1, 300.0, False, ()), Ending(2, 0.1, 300.0, False, (ERROR,))
    assert find_fault(Ending(0, 0.1, MEGABYTES + 1.0, False, ()), case, tmp_path) == f"{MEGABYTES + 1} MB of memory"
    assert find_fault(Ending(-9, 60.0, 300.0, True, ()), case, tmp_path) == "no answer within 60 s"
    out.touch()
    assert find_fault(done, case, tmp_path) == ""
    assert find_fault(refused, case, tmp_path) == "left out.csv behind with exit code 2"
    source.write_bytes(b"")
    assert find_fault(done, case, tmp_path) == "changed its input m.csv"
