"""Detectors: images of one size -> keypoints, descriptors, scores. A detector is imported when first used."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensor_stereo.lazy import attach

if TYPE_CHECKING:
    from tensor_stereo.features.detect import detect_features as detect_features
    from tensor_stereo.features.fast import detect_fast as detect_fast
    from tensor_stereo.features.gftt import detect_gftt as detect_gftt
    from tensor_stereo.features.images import list_images as list_images
    from tensor_stereo.features.images import to_gray as to_gray
    from tensor_stereo.features.sift import detect_sift as detect_sift
    from tensor_stereo.features.surf import detect_surf as detect_surf
    from tensor_stereo.features.windows import extract_windows as extract_windows

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "detect_fast": "fast",
        "detect_features": "detect",
        "detect_gftt": "gftt",
        "detect_sift": "sift",
        "detect_surf": "surf",
        "extract_windows": "windows",
        "list_images": "images",
        "to_gray": "images",
    },
)
