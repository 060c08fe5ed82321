"""Dense disparity maps: semi-global ones, their confidence, matches from them, and maps from kept matches."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensor_stereo.lazy import attach

if TYPE_CHECKING:
    from tensor_stereo.dense.confidence import DisparityConfidence as DisparityConfidence
    from tensor_stereo.dense.confidence import ScoredDisparity as ScoredDisparity
    from tensor_stereo.dense.confidence import score_disparity as score_disparity
    from tensor_stereo.dense.filtering import FilteredDisparity as FilteredDisparity
    from tensor_stereo.dense.filtering import filter_disparity as filter_disparity
    from tensor_stereo.dense.interpolation import interpolate_disparity as interpolate_disparity
    from tensor_stereo.dense.partners import sample_disparity as sample_disparity
    from tensor_stereo.dense.semi_global import SemiGlobalMaps as SemiGlobalMaps
    from tensor_stereo.dense.semi_global import match_semi_global as match_semi_global

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "DisparityConfidence": "confidence",
        "FilteredDisparity": "filtering",
        "ScoredDisparity": "confidence",
        "filter_disparity": "filtering",
        "interpolate_disparity": "interpolation",
        "SemiGlobalMaps": "semi_global",
        "match_semi_global": "semi_global",
        "sample_disparity": "partners",
        "score_disparity": "confidence",
    },
)
