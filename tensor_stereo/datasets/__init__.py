"""Readers of published stereo pairs with ground truth. Names load on first use, so that the import stays cheap."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .calibration import Calibration as Calibration
    from .calibration import read_calibration as read_calibration
    from .discovery import find_pairs as find_pairs
    from .download import download_releases as download_releases
    from .eth3d import find_eth3d as find_eth3d
    from .files import PairFiles as PairFiles
    from .images import read_disparity_png as read_disparity_png
    from .images import read_image as read_image
    from .images import read_occlusion_mask as read_occlusion_mask
    from .kitti import find_kitti as find_kitti
    from .manifest import build_manifest as build_manifest
    from .manifest import read_manifest as read_manifest
    from .manifest import write_manifest as write_manifest
    from .middlebury import find_middlebury as find_middlebury
    from .pairs import PairDataset as PairDataset
    from .pairs import read_pair as read_pair
    from .pfm import read_pfm as read_pfm
    from .pfm import write_pfm as write_pfm
    from .sceneflow import find_sceneflow as find_sceneflow
    from .sintel import find_sintel as find_sintel
    from .synthetic import SyntheticDataset as SyntheticDataset
    from .synthetic import render_pair as render_pair
    from .synthetic import write_synthetic as write_synthetic

_MODULES = {
    "Calibration": "calibration",
    "PairDataset": "pairs",
    "PairFiles": "files",
    "SyntheticDataset": "synthetic",
    "build_manifest": "manifest",
    "download_releases": "download",
    "find_eth3d": "eth3d",
    "find_kitti": "kitti",
    "find_middlebury": "middlebury",
    "find_pairs": "discovery",
    "find_sceneflow": "sceneflow",
    "find_sintel": "sintel",
    "read_calibration": "calibration",
    "read_disparity_png": "images",
    "read_image": "images",
    "read_manifest": "manifest",
    "read_occlusion_mask": "images",
    "read_pair": "pairs",
    "read_pfm": "pfm",
    "render_pair": "synthetic",
    "write_manifest": "manifest",
    "write_pfm": "pfm",
    "write_synthetic": "synthetic",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_MODULES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
