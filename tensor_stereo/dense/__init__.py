"""Dense disparity maps: verdicts on their pixels, and maps interpolated from kept matches."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensor_stereo.lazy import attach

if TYPE_CHECKING:
    from tensor_stereo.dense.filtering import FilteredDisparity as FilteredDisparity
    from tensor_stereo.dense.filtering import filter_disparity as filter_disparity
    from tensor_stereo.dense.interpolation import interpolate_disparity as interpolate_disparity

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "FilteredDisparity": "filtering",
        "filter_disparity": "filtering",
        "interpolate_disparity": "interpolation",
    },
)
