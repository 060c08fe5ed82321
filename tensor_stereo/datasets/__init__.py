"""Readers of published stereo pairs with ground truth. Names load on first use, so that the import stays cheap."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensor_stereo.lazy import attach

if TYPE_CHECKING:
    from tensor_stereo.datasets.camera import Calibration as Calibration
    from tensor_stereo.datasets.camera import read_calibration as read_calibration
    from tensor_stereo.datasets.discovery import find_pairs as find_pairs
    from tensor_stereo.datasets.download.fetch import download_releases as download_releases
    from tensor_stereo.datasets.eth3d import find_eth3d as find_eth3d
    from tensor_stereo.datasets.files import PairFiles as PairFiles
    from tensor_stereo.datasets.images import SampleRangeWarning as SampleRangeWarning
    from tensor_stereo.datasets.images import read_disparity_png as read_disparity_png
    from tensor_stereo.datasets.images import read_image as read_image
    from tensor_stereo.datasets.images import read_occlusion_mask as read_occlusion_mask
    from tensor_stereo.datasets.kitti import find_kitti as find_kitti
    from tensor_stereo.datasets.manifest import build_manifest as build_manifest
    from tensor_stereo.datasets.manifest import read_manifest as read_manifest
    from tensor_stereo.datasets.manifest import write_manifest as write_manifest
    from tensor_stereo.datasets.middlebury import find_middlebury as find_middlebury
    from tensor_stereo.datasets.pairs import PairDataset as PairDataset
    from tensor_stereo.datasets.pairs import read_pair as read_pair
    from tensor_stereo.datasets.pfm import read_pfm as read_pfm
    from tensor_stereo.datasets.pfm import write_pfm as write_pfm
    from tensor_stereo.datasets.sceneflow import find_sceneflow as find_sceneflow
    from tensor_stereo.datasets.sintel import find_sintel as find_sintel
    from tensor_stereo.datasets.synthetic.rendering import SyntheticDataset as SyntheticDataset
    from tensor_stereo.datasets.synthetic.rendering import render_pair as render_pair
    from tensor_stereo.datasets.synthetic.rendering import write_synthetic as write_synthetic

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Calibration": "camera",
        "PairDataset": "pairs",
        "PairFiles": "files",
        "SampleRangeWarning": "images",
        "SyntheticDataset": "synthetic.rendering",
        "build_manifest": "manifest",
        "download_releases": "download.fetch",
        "find_eth3d": "eth3d",
        "find_kitti": "kitti",
        "find_middlebury": "middlebury",
        "find_pairs": "discovery",
        "find_sceneflow": "sceneflow",
        "find_sintel": "sintel",
        "read_calibration": "camera",
        "read_disparity_png": "images",
        "read_image": "images",
        "read_manifest": "manifest",
        "read_occlusion_mask": "images",
        "read_pair": "pairs",
        "read_pfm": "pfm",
        "render_pair": "synthetic.rendering",
        "write_manifest": "manifest",
        "write_pfm": "pfm",
        "write_synthetic": "synthetic.rendering",
    },
)
