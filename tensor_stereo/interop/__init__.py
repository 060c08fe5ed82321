"""Matches to and from the forms of other libraries and files, one module each; h5py and pycolmap load when needed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensor_stereo.lazy import attach

if TYPE_CHECKING:
    from tensor_stereo.interop.glue_factory import GlueFactoryFilter as GlueFactoryFilter
    from tensor_stereo.interop.glue_factory import from_glue_factory as from_glue_factory
    from tensor_stereo.interop.glue_factory import to_glue_factory as to_glue_factory
    from tensor_stereo.interop.glue_factory import two_view_filter as two_view_filter
    from tensor_stereo.interop.kornia import FilteredMatcher as FilteredMatcher
    from tensor_stereo.interop.kornia import LocatedFeature as LocatedFeature
    from tensor_stereo.interop.kornia import from_lafs as from_lafs
    from tensor_stereo.interop.kornia import from_lightglue as from_lightglue
    from tensor_stereo.interop.kornia import from_loftr as from_loftr
    from tensor_stereo.interop.kornia import to_lightglue as to_lightglue
    from tensor_stereo.interop.kornia import to_loftr as to_loftr
    from tensor_stereo.interop.match_files import filter_file as filter_file
    from tensor_stereo.interop.match_folders import FolderSummary as FolderSummary
    from tensor_stereo.interop.match_folders import filter_files as filter_files
    from tensor_stereo.interop.opencv import from_opencv as from_opencv
    from tensor_stereo.interop.opencv import select_dmatches as select_dmatches
    from tensor_stereo.interop.opencv import to_opencv as to_opencv
    from tensor_stereo.interop.pyg import from_edge_index as from_edge_index
    from tensor_stereo.interop.pyg import from_pyg as from_pyg
    from tensor_stereo.interop.pyg import to_edge_index as to_edge_index
    from tensor_stereo.interop.pyg import to_pyg as to_pyg
    from tensor_stereo.interop.verdicts import FilterSummary as FilterSummary

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "FilterSummary": "verdicts",
        "FilteredMatcher": "kornia",
        "FolderSummary": "match_folders",
        "GlueFactoryFilter": "glue_factory",
        "LocatedFeature": "kornia",
        "filter_file": "match_files",
        "filter_files": "match_folders",
        "from_edge_index": "pyg",
        "from_glue_factory": "glue_factory",
        "from_lafs": "kornia",
        "from_lightglue": "kornia",
        "from_loftr": "kornia",
        "from_opencv": "opencv",
        "from_pyg": "pyg",
        "select_dmatches": "opencv",
        "to_edge_index": "pyg",
        "to_glue_factory": "glue_factory",
        "to_lightglue": "kornia",
        "to_loftr": "kornia",
        "to_opencv": "opencv",
        "to_pyg": "pyg",
        "two_view_filter": "glue_factory",
    },
)
