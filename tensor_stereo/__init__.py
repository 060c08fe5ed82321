"""Decide which putative stereo matches are right, from the Delaunay graphs of both views and from the images.

Names load on first use, so that importing the package, and parsing a command line, needs no torch.
"""

from typing import TYPE_CHECKING

from tensor_stereo.lazy import attach

if TYPE_CHECKING:
    from tensor_stereo.classification import classify_matches as classify_matches
    from tensor_stereo.configs import ConsensusConfig as ConsensusConfig
    from tensor_stereo.configs import EvaluationConfig as EvaluationConfig
    from tensor_stereo.configs import FilterConfig as FilterConfig
    from tensor_stereo.configs import MatchingConfig as MatchingConfig
    from tensor_stereo.configs import PipelineConfig as PipelineConfig
    from tensor_stereo.configs import SGBMConfig as SGBMConfig
    from tensor_stereo.dense.confidence import DisparityConfidence as DisparityConfidence
    from tensor_stereo.dense.confidence import ScoredDisparity as ScoredDisparity
    from tensor_stereo.dense.confidence import score_disparity as score_disparity
    from tensor_stereo.dense.filtering import FilteredDisparity as FilteredDisparity
    from tensor_stereo.dense.filtering import filter_disparity as filter_disparity
    from tensor_stereo.dense.interpolation import interpolate_disparity as interpolate_disparity
    from tensor_stereo.dense.partners import sample_disparity as sample_disparity
    from tensor_stereo.evaluation.dataset import score_dataset as score_dataset
    from tensor_stereo.graphs import build_graphs as build_graphs
    from tensor_stereo.interop.match_files import filter_file as filter_file
    from tensor_stereo.interop.match_folders import filter_files as filter_files
    from tensor_stereo.modules import DelaunayFilter as DelaunayFilter
    from tensor_stereo.modules import FilterOutput as FilterOutput
    from tensor_stereo.ops.backends import backend as backend
    from tensor_stereo.pipeline import PipelineOutput as PipelineOutput
    from tensor_stereo.pipeline import run_pipeline as run_pipeline
    from tensor_stereo.reports.pair import classify_files as classify_files
    from tensor_stereo.scores.by_name import score_matches as score_matches
    from tensor_stereo.scores.domain import DomainWarning as DomainWarning
    from tensor_stereo.types import Adjacency as Adjacency
    from tensor_stereo.types import Classification as Classification
    from tensor_stereo.types import Features as Features
    from tensor_stereo.types import Matches as Matches
    from tensor_stereo.types import Relation as Relation
    from tensor_stereo.types import StereoPair as StereoPair

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Adjacency": "types",
        "Classification": "types",
        "ConsensusConfig": "configs",
        "DelaunayFilter": "modules",
        "DomainWarning": "scores.domain",
        "EvaluationConfig": "configs",
        "Features": "types",
        "FilterConfig": "configs",
        "FilterOutput": "modules",
        "FilteredDisparity": "dense.filtering",
        "DisparityConfidence": "dense.confidence",
        "ScoredDisparity": "dense.confidence",
        "Matches": "types",
        "MatchingConfig": "configs",
        "PipelineConfig": "configs",
        "PipelineOutput": "pipeline",
        "Relation": "types",
        "SGBMConfig": "configs",
        "StereoPair": "types",
        "backend": "ops.backends",
        "build_graphs": "graphs",
        "classify_files": "reports.pair",
        "classify_matches": "classification",
        "filter_disparity": "dense.filtering",
        "filter_file": "interop.match_files",
        "filter_files": "interop.match_folders",
        "interpolate_disparity": "dense.interpolation",
        "run_pipeline": "pipeline",
        "sample_disparity": "dense.partners",
        "score_disparity": "dense.confidence",
        "score_dataset": "evaluation.dataset",
        "score_matches": "scores.by_name",
    },
)
__all__ += ["__version__"]
