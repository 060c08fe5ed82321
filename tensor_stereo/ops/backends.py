"""The back ends, and which of them runs.

Every operator takes the name of a back end:

- ``native``: the compiled kernels.
- ``scipy``: no compiled code of this library. Graphs come from scipy and exact integer arithmetic, everything else from
  plain torch. Slower, and the definition of what the kernels compute.
- ``auto``: ``native`` where it is installed, otherwise ``scipy``; the environment variable ``TENSOR_STEREO_BACKEND``
  overrides it.

Both give the same bits, except for the last digits of what goes through transcendental functions or is a gradient.
"""

from __future__ import annotations

import os
from importlib import import_module
from types import ModuleType
from typing import NamedTuple

from tensor_stereo.configs import Backend

try:
    _loaded = import_module("tensor_stereo._kernels")
except ImportError as error:
    kernels: ModuleType | None = None
    _reason = f"the compiled module tensor_stereo._kernels is missing ({error}); scipy and torch do its work, slower"
else:
    kernels = _loaded
    _reason = "the compiled module tensor_stereo._kernels is installed"


class BackendInfo(NamedTuple):
    """What ``auto`` stands for and why."""

    name: str
    reason: str


def backend() -> BackendInfo:
    """The back end that ``auto`` stands for in this process, and what is missing if it is not ``native``.

    Raises:
        ValueError: if ``TENSOR_STEREO_BACKEND`` names an unknown back end, or ``native`` where it is not installed.

    Example:
        >>> backend().name in ("native", "scipy")
        True
    """
    wish = os.environ.get("TENSOR_STEREO_BACKEND", "auto")
    name = resolve_backend("auto")
    return BackendInfo(name, _reason if wish == "auto" else f"TENSOR_STEREO_BACKEND is {wish!r}")


def native(backend: str) -> ModuleType | None:
    """The compiled module where ``backend`` stands for it, otherwise None.

    Every operator asks this and nothing else, so that no kernel runs under ``scipy``.

    Raises:
        ValueError: for what :func:`resolve_backend` refuses.
    """
    return kernels if resolve_backend(backend) == "native" else None


def resolve_backend(backend: str) -> Backend:
    """``native`` or ``scipy`` for any allowed name.

    Raises:
        ValueError: for an unknown name, or ``native`` where it is not installed.
    """
    source = "backend"
    if backend == "auto":
        backend, source = os.environ.get("TENSOR_STEREO_BACKEND", "auto"), "TENSOR_STEREO_BACKEND"
    if backend not in ("auto", "native", "scipy"):
        raise ValueError(f"{source} must be 'auto', 'native' or 'scipy', got {backend!r}")
    if backend == "native" and kernels is None:
        raise ValueError(f"{source} 'native' cannot run: {_reason}")
    if backend == "scipy" or kernels is None:
        return "scipy"
    return "native"
