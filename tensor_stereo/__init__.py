"""Decide which putative stereo matches are right, from the Delaunay graphs of both views.

Names are loaded on first use, so that importing the package, and parsing a command line, needs no torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tensor_stereo.evaluation import score_dataset as score_dataset
    from tensor_stereo.filters import classify_matches as classify_matches
    from tensor_stereo.graphs import build_graphs as build_graphs
    from tensor_stereo.interpolation import interpolate_disparity as interpolate_disparity
    from tensor_stereo.modules import DelaunayFilter as DelaunayFilter
    from tensor_stereo.types import Adjacency as Adjacency
    from tensor_stereo.types import Classification as Classification
    from tensor_stereo.types import Features as Features
    from tensor_stereo.types import Matches as Matches
    from tensor_stereo.types import Relation as Relation
    from tensor_stereo.types import StereoPair as StereoPair

__version__ = "0.1.0"

_HOMES = {
    "Adjacency": "types",
    "Classification": "types",
    "DelaunayFilter": "modules",
    "Features": "types",
    "Matches": "types",
    "Relation": "types",
    "StereoPair": "types",
    "build_graphs": "graphs",
    "classify_matches": "filters",
    "interpolate_disparity": "interpolation",
    "score_dataset": "evaluation",
}

__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
