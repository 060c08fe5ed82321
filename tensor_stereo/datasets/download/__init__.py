"""Published releases: what there is, fetched resumably and unpacked safely."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensor_stereo.lazy import attach

if TYPE_CHECKING:
    from tensor_stereo.datasets.download.fetch import DownloadProgress as DownloadProgress
    from tensor_stereo.datasets.download.fetch import download_releases as download_releases
    from tensor_stereo.datasets.download.releases import RELEASES as RELEASES
    from tensor_stereo.datasets.download.releases import Release as Release

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "DownloadProgress": "fetch",
        "RELEASES": "releases",
        "Release": "releases",
        "download_releases": "fetch",
    },
)
