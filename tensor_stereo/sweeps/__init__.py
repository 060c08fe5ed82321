"""Dataset sweeps: a grid of settings x the pairs of a manifest, on one machine or a cluster."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensor_stereo.lazy import attach

if TYPE_CHECKING:
    from tensor_stereo.sweeps.driver import SweepProgress as SweepProgress
    from tensor_stereo.sweeps.driver import SweepSummary as SweepSummary
    from tensor_stereo.sweeps.grid import expand_grid as expand_grid
    from tensor_stereo.sweeps.grid import read_grid as read_grid
    from tensor_stereo.sweeps.journal import RunInUseError as RunInUseError
    from tensor_stereo.sweeps.journal import SweepError as SweepError
    from tensor_stereo.sweeps.plan import Plan as Plan
    from tensor_stereo.sweeps.plan import build_plan as build_plan
    from tensor_stereo.sweeps.results import read_config as read_config
    from tensor_stereo.sweeps.results import read_errors as read_errors
    from tensor_stereo.sweeps.results import read_results as read_results
    from tensor_stereo.sweeps.run import run_sweep as run_sweep
    from tensor_stereo.sweeps.stored_confidence import ConfidenceDataset as ConfidenceDataset
    from tensor_stereo.sweeps.stored_confidence import StoredConfidence as StoredConfidence
    from tensor_stereo.sweeps.stored_matches import MatchDataset as MatchDataset
    from tensor_stereo.sweeps.stored_matches import StoredMatches as StoredMatches
    from tensor_stereo.sweeps.stored_matches import read_matches as read_matches

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "ConfidenceDataset": "stored_confidence",
        "MatchDataset": "stored_matches",
        "Plan": "plan",
        "RunInUseError": "journal",
        "StoredConfidence": "stored_confidence",
        "StoredMatches": "stored_matches",
        "SweepError": "journal",
        "SweepProgress": "driver",
        "SweepSummary": "driver",
        "build_plan": "plan",
        "expand_grid": "grid",
        "read_config": "results",
        "read_errors": "results",
        "read_grid": "grid",
        "read_matches": "stored_matches",
        "read_results": "results",
        "run_sweep": "run",
    },
)
