"""Detectors: images of one size -> keypoints, descriptors, scores. A detector is imported when first used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from tensor_stereo.configs import PipelineConfig

if TYPE_CHECKING:
    from torch import Tensor

    from tensor_stereo.features.fast import detect_fast as detect_fast
    from tensor_stereo.features.gftt import detect_gftt as detect_gftt
    from tensor_stereo.features.images import list_images as list_images
    from tensor_stereo.features.images import to_gray as to_gray
    from tensor_stereo.features.sift import detect_sift as detect_sift
    from tensor_stereo.features.surf import detect_surf as detect_surf
    from tensor_stereo.features.windows import extract_windows as extract_windows
    from tensor_stereo.types import Features

_HOMES = {
    "detect_fast": "fast",
    "detect_gftt": "gftt",
    "detect_sift": "sift",
    "detect_surf": "surf",
    "extract_windows": "windows",
    "list_images": "images",
    "to_gray": "images",
}

__all__ = ["detect_features", *_HOMES]


def detect_features(images: Tensor, config: PipelineConfig | None = None) -> Features:
    """Detect with ``config.detector`` and its settings.

    Every image of the batch gets the bits that it gets alone.

    Args:
        images: (B, 1, H, W) or (B, 3, H, W) of one size, uint8 or floating point in [0, 1]. B may be 0.
        config: settings; None means the defaults.

    Returns:
        Ragged features of the B images, strongest first within each.

    Raises:
        ValueError: if ``images`` has another shape, or values outside of [0, 1].
        TypeError: if ``images`` has another dtype.

    >>> import torch
    >>> detect_features(torch.zeros(2, 3, 40, 50), PipelineConfig(detector="gftt")).ptr
    tensor([0, 0, 0])
    """
    config = config or PipelineConfig()
    detect = getattr(import_module(f"{__name__}.{config.detector}"), f"detect_{config.detector}")
    features: Features = detect(images, getattr(config, config.detector))
    return features


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
