"""One process that has imported everything and forks a child per command, since starting torch takes seconds.

Polars and torch are imported here but never used before a fork: their thread pools start at the first use, so each
child starts its own. The parent of a child neither parses nor computes anything.
"""

from __future__ import annotations

import atexit
import faulthandler
import gc
import importlib
import json
import os
import pkgutil
import resource
import select
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

SECONDS = 60.0  # after which a command hangs
ADDRESS_SPACE = 8 << 30  # bytes: keeps the machine alive, is no limit of the package
_OUTSIDE = ("__main__", "ray_engine", "download")  # modules that no fuzzed command imports
_LAZY = ("h5py", "pycolmap", "kornia", "mahotas", "scipy.spatial", "torch._dynamo")  # imported inside of functions
STDOUT, STDERR, USAGE = ".stdout", ".stderr", ".usage"  # files in the folder of a case


@dataclass(frozen=True)
class Ending:
    """How a command ended.

    Attributes:
        code: Exit code, or minus the number of the signal that ended it.
        seconds: Time from its fork to its end.
        megabytes: Largest resident size of the process, plus that of the processes which it has started.
        hung: Whether it was killed because it took too long.
        errors: Lines on standard error.
    """

    code: int
    seconds: float
    megabytes: float
    hung: bool
    errors: tuple[str, ...]


class Zygote:
    """Runs commands of ``tensor-stereo``, each in a fresh fork. Use it in a ``with`` block."""

    def __init__(self) -> None:
        settings = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "POLARS_MAX_THREADS": "1", "PYTHONHASHSEED": "0"}
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.zygote"],
            stdin=pipe,
            stdout=pipe,
            text=True,
            encoding="utf-8",
            cwd=Path(__file__).parents[2],
            env=os.environ | settings,
            start_new_session=True,  # an interrupt is for us, who let it end
        )

    def run(self, arguments: Sequence[str], folder: Path, *, seconds: float = SECONDS) -> Ending:
        """Run a command in a folder and wait for its end."""
        stdin, stdout = self._process.stdin, self._process.stdout
        if stdin is None or stdout is None:
            raise RuntimeError("the zygote has no pipes")
        request = {"arguments": list(arguments), "folder": str(folder.absolute()), "seconds": seconds}
        stdin.write(json.dumps(request) + "\n")
        stdin.flush()
        line = stdout.readline()
        if not line:
            raise RuntimeError("the zygote has ended")
        errors = (folder / STDERR).read_text(encoding="utf-8", errors="replace").splitlines()
        return Ending(**json.loads(line), errors=tuple(errors))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.communicate()  # closes its input, at which it ends


def serve() -> None:
    """Answer requests on standard input, one line each, until it ends."""
    main = _import_everything()
    gc.collect()
    gc.freeze()  # so that a child does not copy pages only to count references
    for line in sys.stdin:
        request = json.loads(line)
        print(json.dumps(_run(main, **request)), flush=True)


def _import_everything() -> Any:
    import tensor_stereo
    from tensor_stereo.cli import main

    for module in pkgutil.walk_packages(tensor_stereo.__path__, "tensor_stereo."):
        if not set(module.name.split(".")) & set(_OUTSIDE):
            importlib.import_module(module.name)
    for name in _LAZY:
        with suppress(ImportError):
            importlib.import_module(name)
    return main


def _run(main: Any, arguments: list[str], folder: str, seconds: float) -> dict[str, Any]:
    """Fork, run, reap."""
    begun = time.monotonic()
    child = os.fork()
    if not child:
        try:
            _be_child(main, arguments, folder, seconds)
        except BaseException:  # of the harness, not of the command
            traceback.print_exc()
        finally:
            os._exit(99)
    descriptor = os.pidfd_open(child)
    try:
        hung = not select.select([descriptor], [], [], seconds)[0]
        if hung:
            os.killpg(child, signal.SIGKILL)
        _, status, usage = os.wait4(child, 0)
    finally:
        os.close(descriptor)
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what it has started and left behind
    kilobytes = usage.ru_maxrss  # of itself and, if it has waited for them, of those that it has started
    with suppress(FileNotFoundError, ValueError):
        kilobytes = int(Path(folder, USAGE).read_text())
    code = os.waitstatus_to_exitcode(status)
    return {
        "code": code,
        "seconds": time.monotonic() - begun,
        "megabytes": kilobytes / 1024,
        "hung": hung,
    }


def _be_child(main: Any, arguments: list[str], folder: str, seconds: float) -> None:
    """Carry out one command as a process of its own would; does not return."""
    os.setsid()
    os.chdir(folder)
    for number, (name, flags) in enumerate(
        ((os.devnull, os.O_RDONLY), (STDOUT, os.O_WRONLY | os.O_CREAT), (STDERR, os.O_WRONLY | os.O_CREAT))
    ):
        descriptor = os.open(name, flags, 0o644)
        os.dup2(descriptor, number)
        os.close(descriptor)
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    atexit._clear()  # what the parent has to do at its end
    faulthandler.enable()
    faulthandler.dump_traceback_later(max(seconds - 1, 0.5))  # says where it hangs
    code = 0
    try:
        main(arguments)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        code = 1
    started = _peak_of_children()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    own, reaped = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    # What was reaped counts the pages that it shared before its own program began: up to our size, it tells nothing.
    Path(USAGE).write_text(str(own + max(started, reaped if reaped > own else 0)))
    os._exit(code)


def _peak_of_children() -> int:
    """The largest resident size of living processes that this one has started, all together, in KiB."""
    peak = 0
    for children in Path("/proc/self/task").glob("*/children"):
        with suppress(OSError):  # of a thread or a process that has just ended
            for child in children.read_text().split():
                status = Path("/proc", child, "status").read_text()
                peak += sum(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))
    return peak


if __name__ == "__main__":
    serve()
