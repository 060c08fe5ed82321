"""After the verdict: rejected matches are repaired and judged anew, kept ones refined, for a list of pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from tensor_stereo.classification import apply_score, classify_graphs
from tensor_stereo.configs import PipelineConfig
from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.scores.alignment import Alignment, estimate_alignment
from tensor_stereo.scores.by_name import ScoredMatches
from tensor_stereo.scores.refine import refine_matches
from tensor_stereo.scores.repair import Origin, repair_matches
from tensor_stereo.types import Classification, Features, Matches


class Judged(NamedTuple):
    """Matches of B pairs, and what is decided about them.

    Attributes:
        matches: M matches.
        graphs: Their graphs.
        verdict: One per match.
        score: (M,), 0 for untested matches; None without one.
        found: Scores before the verdict, with their alignment; None without one.
        rows: (M,) int64 rows of the matches as they were given, -1 for keypoints that had no partner.
        origin: (M,) int8, values of :class:`tensor_stereo.scores.Origin`.
    """

    matches: Matches
    graphs: MatchGraphs
    verdict: Classification
    score: Tensor | None
    found: ScoredMatches | None
    rows: Tensor
    origin: Tensor


Scorer = Callable[[Matches, MatchGraphs], ScoredMatches | None]


def judge_matches(
    matches: Matches,
    graphs: MatchGraphs,
    config: PipelineConfig,
    scorer: Scorer,
    verdict: Classification | None = None,
) -> Judged:
    """Verdict and score of matches whose graphs exist; ``verdict`` is that of the graphs, if it is known."""
    verdict, score = classify_graphs(graphs, config) if verdict is None else verdict, None
    found = scorer(matches, graphs)
    if found is not None:
        verdict, score = apply_score(verdict, found.score, matches.ptr, config)
    rows = torch.arange(matches.num_matches, device=matches.ptr.device)
    origin = torch.full_like(rows, int(Origin.GIVEN), dtype=torch.int8)
    return Judged(matches, graphs, verdict, score, found, rows, origin)


@torch.no_grad()
def improve_matches(
    judged: Judged,
    views: tuple[Sequence[Tensor], Sequence[Tensor]],
    keypoints: Features,
    config: PipelineConfig,
    scorer: Scorer,
    group: Callable[[Matches], Matches],
) -> Judged:
    """Repair and refine as the settings say.

    Args:
        judged: The matches as they came.
        views: The B images (C, H, W) of view 0, and those of view 1.
        keypoints: All keypoints of view 0, of which some have no match yet.
        config: ``repair`` and ``refine``, and all that decides.
        scorer: Scores matches whose graphs exist.
        group: Puts matches into the groups of Restriction 3.

    Returns:
        The matches after it. No gradient.
    """
    if config.repair:
        kept = judged.verdict.inlier
        found = repair_matches(
            judged.matches, *views, kept, _alignment(judged, config), keypoints0=keypoints.keypoints, ptr0=keypoints.ptr
        )
        matches = group(found.matches)
        graphs = build_match_graphs(matches, tie_tolerance=config.tie_tolerance, backend=config.backend)
        judged = judge_matches(matches, graphs, config, scorer)._replace(rows=found.rows, origin=found.origin)
    if config.refine:
        moved = refine_matches(judged.matches, *views, judged.verdict.inlier, _alignment(judged, config), judged.graphs)
        is_finer = (moved.keypoints1 != judged.matches.keypoints1).any(1) & (judged.origin == int(Origin.GIVEN))
        moved = replace(moved, cost=judged.matches.cost, group=judged.matches.group)
        judged = judged._replace(
            matches=moved, origin=torch.where(is_finer, int(Origin.REFINED), judged.origin).to(torch.int8)
        )
    return judged


def _alignment(judged: Judged, config: PipelineConfig) -> Alignment:
    if judged.found is not None and judged.found.alignment is not None:
        return judged.found.alignment
    return estimate_alignment(judged.matches, judged.graphs, rectified=config.rectified, backend=config.backend)
