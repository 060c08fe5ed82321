"""Decide which putative stereo matches are right, from the Delaunay graphs of both views.

Names are loaded on first use, so that importing the package, and parsing a command line, needs no torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tensor_stereo.configs import UNRECTIFIED as UNRECTIFIED
    from tensor_stereo.configs import ConsensusConfig as ConsensusConfig
    from tensor_stereo.configs import EvaluationConfig as EvaluationConfig
    from tensor_stereo.configs import FilterConfig as FilterConfig
    from tensor_stereo.configs import MatchingConfig as MatchingConfig
    from tensor_stereo.configs import PipelineConfig as PipelineConfig
    from tensor_stereo.dense import FilteredDisparity as FilteredDisparity
    from tensor_stereo.dense import filter_disparity as filter_disparity
    from tensor_stereo.evaluation import score_dataset as score_dataset
    from tensor_stereo.filters import FilterOutput as FilterOutput
    from tensor_stereo.filters import classify_matches as classify_matches
    from tensor_stereo.graphs import build_graphs as build_graphs
    from tensor_stereo.interop.match_files import filter_file as filter_file
    from tensor_stereo.interpolation import interpolate_disparity as interpolate_disparity
    from tensor_stereo.modules import DelaunayFilter as DelaunayFilter
    from tensor_stereo.pipeline import PipelineOutput as PipelineOutput
    from tensor_stereo.pipeline import run_pipeline as run_pipeline
    from tensor_stereo.reports.matches import classify_files as classify_files
    from tensor_stereo.scores.scoring import score_matches as score_matches
    from tensor_stereo.types import Adjacency as Adjacency
    from tensor_stereo.types import Classification as Classification
    from tensor_stereo.types import Features as Features
    from tensor_stereo.types import Matches as Matches
    from tensor_stereo.types import Relation as Relation
    from tensor_stereo.types import StereoPair as StereoPair

__version__ = "0.1.0"

_HOMES = {
    "UNRECTIFIED": "configs",
    "Adjacency": "types",
    "Classification": "types",
    "ConsensusConfig": "configs",
    "DelaunayFilter": "modules",
    "EvaluationConfig": "configs",
    "Features": "types",
    "FilterConfig": "configs",
    "FilterOutput": "filters",
    "FilteredDisparity": "dense",
    "Matches": "types",
    "MatchingConfig": "configs",
    "PipelineConfig": "configs",
    "PipelineOutput": "pipeline",
    "Relation": "types",
    "StereoPair": "types",
    "build_graphs": "graphs",
    "classify_files": "reports.matches",
    "classify_matches": "filters",
    "filter_disparity": "dense",
    "filter_file": "interop.match_files",
    "interpolate_disparity": "interpolation",
    "run_pipeline": "pipeline",
    "score_dataset": "evaluation",
    "score_matches": "scores.scoring",
}

__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
