"""Mutated files of every format through the command line: ``python -m tests.fuzz --formats npz csv --count 2000``."""

from __future__ import annotations

import argparse
import queue
import shlex
import shutil
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.cases import FORMATS, make_case, run_case
from tests.fuzz.zygote import SECONDS, STDERR, STDOUT, USAGE, Ending, Zygote

SHOWN = 6  # lines of standard error that are printed of a finding


@dataclass(frozen=True)
class Finding:
    """A file with which a command does what none may do.

    Attributes:
        kind: Format of the file.
        number: Number of the case, of the format and the seed.
        fault: What is wrong.
        folder: Where the files are kept, with ``command`` and standard error.
        errors: Lines on standard error.
    """

    kind: str
    number: int
    fault: str
    folder: Path
    errors: tuple[str, ...]

    def __str__(self) -> str:
        tail = "".join(f"\n    {line[:300]}" for line in self.errors[-SHOWN:])
        return f"{self.kind} {self.number}: {self.fault}, kept as {self.folder}{tail}"


@dataclass(frozen=True)
class Result:
    """How one case went."""

    ending: Ending
    finding: Finding | None


def fuzz(
    kind: str, numbers: Iterable[int], zygotes: Sequence[Zygote], *, seed: int, keep: Path, seconds: float = SECONDS
) -> Iterator[Result]:
    """Run cases of one format, as many at a time as there are zygotes; files of findings are kept in ``keep``."""
    todo: queue.SimpleQueue[int] = queue.SimpleQueue()
    for number in numbers:
        todo.put(number)
    total = todo.qsize()
    done: queue.SimpleQueue[Result | BaseException] = queue.SimpleQueue()

    def work(zygote: Zygote) -> None:
        try:
            while True:
                done.put(_run(zygote, kind, todo.get_nowait(), seed=seed, keep=keep, seconds=seconds))
        except queue.Empty:
            pass
        except BaseException as error:
            done.put(error)

    threads = [threading.Thread(target=work, args=(zygote,), daemon=True) for zygote in zygotes]
    for thread in threads:
        thread.start()
    for _ in range(total):
        result = done.get()
        if isinstance(result, BaseException):
            raise result
        yield result
    for thread in threads:
        thread.join()


def _run(zygote: Zygote, kind: str, number: int, *, seed: int, keep: Path, seconds: float) -> Result:
    case = make_case(kind, seed, number)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        ending, fault = run_case(zygote, case, folder, seconds=seconds)
        if not fault:
            return Result(ending, None)
        kept = keep / f"{kind}-{seed}-{number}"
        shutil.rmtree(kept, ignore_errors=True)
        shutil.copytree(folder, kept, symlinks=True, ignore=shutil.ignore_patterns(STDERR, STDOUT, USAGE))
    (kept / "command").write_text(f"tensor-stereo {shlex.join(case.arguments)}\n")
    (kept / "stderr").write_text("\n".join((fault, *ending.errors)) + "\n")
    return Result(ending, Finding(kind, number, fault, kept, ending.errors))


def main() -> int:
    """Run the command line; 1 if there are findings."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument(
        "--formats", nargs="+", choices=FORMATS, default=FORMATS, metavar="FORMAT", help=", ".join(FORMATS)
    )
    parser.add_argument("--count", type=int, default=2000, help="files of each format")
    parser.add_argument(
        "--first", type=int, default=0, help="number of the first file; a finding again: --first N --count 1"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="files at a time")
    parser.add_argument("--keep", type=Path, default=Path("build/fuzz-files"), help="folder for the files of findings")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="after which a command hangs")
    options = parser.parse_args()
    findings = 0
    with ExitStack() as stack:
        zygotes = [stack.enter_context(Zygote()) for _ in range(options.jobs)]
        for kind in options.formats:
            begun = time.monotonic()
            numbers = range(options.first, options.first + options.count)
            results = []
            for result in fuzz(kind, numbers, zygotes, seed=options.seed, keep=options.keep, seconds=options.seconds):
                results.append(result)
                if result.finding:
                    print(result.finding, flush=True)
            found = sum(result.finding is not None for result in results)
            findings += found
            print(f"{kind}: {found} findings in {_describe(results)}; {time.monotonic() - begun:.0f} s", flush=True)
    return int(findings > 0)


def _describe(results: Sequence[Result]) -> str:
    """Number of files, their exit codes, and the largest time and size."""
    codes = Counter(result.ending.code for result in results)
    ends = ", ".join(f"{count} with {code}" for code, count in sorted(codes.items()))
    seconds = max((result.ending.seconds for result in results), default=0)
    megabytes = max((result.ending.megabytes for result in results), default=0)
    return f"{len(results)} files ({ends}); at most {seconds:.1f} s, {megabytes:.0f} MB"


if __name__ == "__main__":
    sys.exit(main())
