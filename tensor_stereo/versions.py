"""Versions of what results depend on. Imports no torch."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

PACKAGES = ("tensor-stereo", "torch", "kornia", "numpy", "scipy", "opencv-python-headless", "mahotas", "polars")


def package_versions() -> dict[str, str | None]:
    """The installed version of each package; None where another one stands in for it.

    >>> sorted(package_versions()) == sorted(PACKAGES)
    True
    """
    return {name: _version(name) for name in PACKAGES}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
