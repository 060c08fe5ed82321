"""``tensor-stereo download``: a bar on a terminal, a line per step elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

from tensor_stereo.cli.commands import Download
from tensor_stereo.datasets import find_pairs
from tensor_stereo.datasets.download.fetch import DownloadProgress, download_releases
from tensor_stereo.datasets.download.releases import RELEASES

Show = Callable[[DownloadProgress], None]


def run_download_command(command: Download) -> None:
    """Fetch releases and print where they are."""
    with _show_progress() as show:
        folders = download_releases(command.releases, command.out, base_url=command.base_url, progress=show)
    for folder in folders:
        pairs = find_pairs(folder)
        print(f"{folder}: {len(pairs)} pairs; terms and citation: {RELEASES[folder.name].page}")


@contextmanager
def _show_progress() -> Iterator[Show]:
    console = Console(stderr=True)
    shown: tuple[str, str] | None = None
    if not console.is_terminal:

        def print_line(state: DownloadProgress) -> None:
            nonlocal shown
            if (state.file, state.step) != shown:
                shown = state.file, state.step
                print(f"{state.step} {state.file}", file=sys.stderr, flush=True)

        yield print_line
        return
    columns = TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn()
    with Progress(*columns, TimeRemainingColumn(), console=console, transient=True) as progress:
        task = progress.add_task("", total=None)

        def update(state: DownloadProgress) -> None:
            nonlocal shown, task
            if (state.file, state.step) != shown:
                shown = state.file, state.step
                progress.remove_task(task)
                task = progress.add_task(f"{state.step} {state.file}", total=state.bytes_total)
            progress.update(task, completed=state.bytes_done, total=state.bytes_total)

        yield update
