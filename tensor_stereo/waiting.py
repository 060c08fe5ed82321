"""How threads of OpenMP wait for each other. Imports no torch.

torch computes with OpenMP, whose threads spin while they wait: where other processes keep the cores busy, a call can
take fifty times as long. Processes of this library's own, the command line and the workers of sweeps, wait passively.
The library changes nothing in the process of its user, who sets ``OMP_WAIT_POLICY=PASSIVE`` before torch is loaded.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

POLICY = {"OMP_WAIT_POLICY": "PASSIVE"}  # read by OpenMP when it is loaded


def wait_passively() -> None:
    """Let the threads of this process wait without spinning, unless its user has chosen or torch is loaded already."""
    if "torch" not in sys.modules:
        for name, value in POLICY.items():
            os.environ.setdefault(name, value)


def chosen_policy() -> dict[str, str]:
    """The variables of processes elsewhere: as the user of this one has chosen, or passive."""
    return {name: os.environ.get(name, value) for name, value in POLICY.items()}


@contextmanager
def passive_children() -> Iterator[None]:
    """Let the threads of processes that start here wait without spinning, unless their user has chosen.

    >>> with passive_children():
    ...     os.environ["OMP_WAIT_POLICY"] != ""
    True
    """
    added = [name for name in POLICY if name not in os.environ]
    os.environ.update({name: POLICY[name] for name in added})
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)
