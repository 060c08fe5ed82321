"""How far long work is, on standard error: a bar on a terminal, a line every ten seconds elsewhere."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

PLAIN_SECONDS = 10.0  # between lines where the output is no terminal


class Show(Protocol):
    """Shows ``done`` of ``total`` pieces of work and a text about them."""

    def __call__(self, done: int, total: int, text: str = "") -> None: ...


@contextmanager
def show_progress(name: str) -> Iterator[Show]:
    """Show the progress of work called ``name`` while the block runs."""
    console = Console(stderr=True)
    if not console.is_terminal:
        last = time.monotonic()

        def print_line(done: int, total: int, text: str = "") -> None:
            nonlocal last
            if time.monotonic() - last >= PLAIN_SECONDS:
                last = time.monotonic()
                print(f"{name} {done}/{total}{f', {text}' if text else ''}", file=sys.stderr, flush=True)

        yield print_line
        return
    columns = (
        TextColumn(name, markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[text]}", markup=False),
    )
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(name, total=None, text="")
        yield lambda done, total, text="": progress.update(task, completed=done, total=total, text=text)


def time_left(begun: float, done: int, total: int) -> str:
    """The time that is left, in words, by the rate since ``begun`` (of :func:`time.monotonic`).

    >>> time_left(time.monotonic(), 0, 4)
    'unknown time left'
    """
    seconds = (time.monotonic() - begun) * (total - done) / done if done else math.nan
    return f"{describe_time(seconds)} left"


def describe_time(seconds: float) -> str:
    """Seconds as hours, minutes and seconds.

    >>> describe_time(75.2)
    '0:01:15'
    """
    return "unknown time" if math.isnan(seconds) else str(timedelta(seconds=round(seconds)))
