"""The command ``tensor-stereo``: parse, call the library, print."""

from __future__ import annotations

import contextlib
import io
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any

import tyro

from tensor_stereo.cli.checks import check
from tensor_stereo.cli.commands import (
    Classify,
    Confidence,
    Demo,
    Download,
    Evaluate,
    Filter,
    Index,
    Render,
    Report,
    Sweep,
)
from tensor_stereo.cli.endings import BAD_INPUT, INTERRUPTED, fail
from tensor_stereo.cli.flags import name_flags
from tensor_stereo.waiting import wait_passively

Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Classify, tyro.conf.subcommand("classify")]
    | Annotated[Confidence, tyro.conf.subcommand("confidence")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Filter, tyro.conf.subcommand("filter")]
    | Annotated[Download, tyro.conf.subcommand("download")]
    | Annotated[Index, tyro.conf.subcommand("index")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Sweep, tyro.conf.subcommand("sweep")]
)


_IN_ONE_LINE = ("DomainWarning", "SampleRangeWarning")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; bad input ends in one line on standard error and exit code 2.

    Threads of torch wait without spinning, unless the user has set ``OMP_WAIT_POLICY``.
    """
    wait_passively()
    if list(sys.argv[1:] if arguments is None else arguments) == ["--version"]:
        from tensor_stereo import __version__

        print(f"tensor-stereo {__version__}")
        return
    try:
        command = _parse(arguments)
    except ValueError as error:  # of the settings' own checks; tyro exits by itself
        sys.exit(fail(_one_line(error), BAD_INPUT))
    from tensor_stereo.sweeps.journal import SweepError
    from tensor_stereo.workers import WorkerStartError

    try:
        check(command)
        run = _runner(command)
        with _warnings_in_one_line():
            code = run(command)
    except (ValueError, TypeError, ImportError, SweepError, WorkerStartError, OSError, UserWarning) as error:
        sys.exit(fail(_one_line(error), BAD_INPUT))
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "allocate memory" not in str(error):
            raise
        sys.exit(fail(f"there is not enough memory: {_one_line(error)}", BAD_INPUT))
    except KeyboardInterrupt:
        sys.exit(fail("interrupted", INTERRUPTED))
    if code:
        sys.exit(code)


def _runner(command: Any) -> Callable[[Any], int]:
    """What carries out a command. torch is needed from here on; a sweep needs neither reports nor figures."""
    if isinstance(command, Sweep):
        from tensor_stereo.cli.sweep import run_sweep_command

        return run_sweep_command
    from tensor_stereo.cli.runners import run

    return run


def _parse(arguments: Sequence[str] | None) -> Any:
    """The command; what tyro wraps of the checks of nested settings is raised as they said it."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                Command,
                prog="tensor-stereo",
                description="Decide which putative stereo matches are right.",
                args=arguments,
                config=(tyro.conf.OmitSubcommandPrefixes,),
            )
    except SystemExit:
        text = " ".join(line.strip("│╭╮╰╯─ ") for line in said.getvalue().splitlines())
        wrapped = re.search(r"Error parsing \S+: (\w+Config\..+?)\s+For full helptext", text)
        if wrapped:
            raise ValueError(wrapped[1]) from None
        if "--restriction" in text and "Unrecognized" in text:
            raise ValueError("--restriction is --verdict now") from None
        print(said.getvalue(), end="", file=sys.stderr)
        raise


@contextlib.contextmanager
def _warnings_in_one_line() -> Iterator[None]:
    """Say as errors are said, once of each kind, that a score leaves its domain or that samples have no known range."""
    show, seen = warnings.showwarning, set()

    def show_line(message: Warning | str, category: type[Warning], *rest: Any) -> None:
        if category.__name__ not in _IN_ONE_LINE:
            show(message, category, *rest)
            return
        is_domain = category.__name__ == "DomainWarning"
        kind = str(message).partition(", but")[0] if is_domain else category.__name__
        if kind not in seen:
            seen.add(kind)
            fail(f"warning: {name_flags(str(message))}")

    warnings.showwarning = show_line  # type: ignore[assignment]
    try:
        yield
    finally:
        warnings.showwarning = show


def _one_line(error: Exception) -> str:
    return name_flags(" ".join(str(error).split()))
