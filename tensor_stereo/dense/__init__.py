"""Dense disparity maps: semi-global ones, matches from them, verdicts on them, and maps from kept matches."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensor_stereo.lazy import attach

if TYPE_CHECKING:
    from tensor_stereo.dense.filtering import FilteredDisparity as FilteredDisparity
    from tensor_stereo.dense.filtering import filter_disparity as filter_disparity
    from tensor_stereo.dense.interpolation import interpolate_disparity as interpolate_disparity
    from tensor_stereo.dense.partners import sample_disparity as sample_disparity
    from tensor_stereo.dense.semi_global import SemiGlobalMaps as SemiGlobalMaps
    from tensor_stereo.dense.semi_global import match_semi_global as match_semi_global

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "FilteredDisparity": "filtering",
        "filter_disparity": "filtering",
        "interpolate_disparity": "interpolation",
        "SemiGlobalMaps": "semi_global",
        "match_semi_global": "semi_global",
        "sample_disparity": "partners",
    },
)
