"""Dataset sweeps: a grid of settings x the pairs of a manifest, on one machine or a cluster."""

from __future__ import annotations

from .grid import expand_grid as expand_grid
from .grid import read_grid as read_grid
from .journal import RunInUseError as RunInUseError
from .journal import SweepError as SweepError
from .plan import Plan as Plan
from .plan import build_plan as build_plan
from .results import read_config as read_config
from .results import read_errors as read_errors
from .results import read_matches as read_matches
from .results import read_results as read_results
from .run import SweepProgress as SweepProgress
from .run import SweepSummary as SweepSummary
from .run import run_sweep as run_sweep
