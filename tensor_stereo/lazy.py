"""Names of a package that load on first use, so that importing it stays cheap. Imports no torch."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module


def attach(
    package: str, homes: Mapping[str, str]
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """What a package needs for names that load on first use.

    Args:
        package: Name of the package, ``__name__`` in its ``__init__``.
        homes: Module of each name, relative to the package.

    Returns:
        ``__getattr__``, ``__dir__`` and ``__all__`` of the package.

    >>> load, _, names = attach("tensor_stereo", {"FilterConfig": "configs"})
    >>> load("FilterConfig").__name__, names
    ('FilterConfig', ['FilterConfig'])
    """

    def load(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(f"{package}.{homes[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *homes})

    return load, names, sorted(homes)
