"""One function for all detectors, each of which is imported when it is first used."""

from __future__ import annotations

from importlib import import_module

from torch import Tensor

from tensor_stereo.configs import PipelineConfig
from tensor_stereo.types import Features


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
    detect = getattr(import_module(f"tensor_stereo.features.{config.detector}"), f"detect_{config.detector}")
    features: Features = detect(images, getattr(config, config.detector))
    return features
