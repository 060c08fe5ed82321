"""The scores by name, of matches whose graphs may exist already."""

from __future__ import annotations

from torch import Tensor

from tensor_stereo.configs import SCORES, Backend, ConsensusConfig, Score, TemperatureUnit
from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.scores.consensus import consensus_score
from tensor_stereo.scores.evidence import ImageEvidence
from tensor_stereo.scores.learned import score_learned
from tensor_stereo.soft import build_soft_graphs, count_soft_neighbors, soft_jaccard
from tensor_stereo.types import Matches


def score_matches(
    matches: Matches,
    graphs: MatchGraphs | None = None,
    *,
    score: Score = "consensus",
    consensus: ConsensusConfig | None = None,
    temperature: Tensor | float = 1.0,
    temperature_unit: TemperatureUnit = "edge",
    evidence: ImageEvidence | None = None,
    tie_tolerance: float = 1e-3,
    backend: Backend = "auto",
) -> tuple[Tensor, MatchGraphs]:
    """Score every match, by one of the scores of :class:`tensor_stereo.DelaunayFilter`.

    Args:
        matches: B pairs.
        graphs: of the same matches, under the same tolerance; None: they are built. ``topology`` builds them in one
            pass with the pairs that it needs, whether they are given or not.
        score: which one.
        consensus: settings of that score; None means the defaults, for rectified pairs.
        temperature: of ``topology``, () in ``temperature_unit``.
        temperature_unit: ``edge``: in lengths of the edge at hand; ``px``: in pixels.
        evidence: what the images say, for ``learned``.
        tie_tolerance: as in :func:`tensor_stereo.build_graphs`, in edge lengths.
        backend: as in :func:`tensor_stereo.build_graphs`.

    Returns:
        (M,) score in [0, 1], higher is better, also of matches that a verdict leaves UNTESTED; and the graphs.
        Gradients as the scores say.

    Raises:
        ValueError: for an unknown score or wrong settings.
        TypeError: for evidence beside a score that looks at no image.

    Example:
        >>> import torch
        >>> left = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) * 100
        >>> matches = Matches(left, left - 2, torch.tensor([0, 50]))
        >>> score, graphs = score_matches(matches)
        >>> torch.equal(score_matches(matches, graphs)[0], score)
        True
    """
    if score not in SCORES:
        raise ValueError(f"score must be one of {', '.join(SCORES)}, got {score!r}")
    if evidence is not None and score != "learned":
        raise TypeError(f"evidence must be None where score is {score!r}, which looks at no image")
    if score == "topology":
        found = build_soft_graphs(
            matches, temperature, unit=temperature_unit, tie_tolerance=tie_tolerance, backend=backend
        )
        counts = count_soft_neighbors(
            matches, found, temperature, unit=temperature_unit, tie_tolerance=tie_tolerance, backend=backend
        )
        return soft_jaccard(counts), found.graphs
    if graphs is None:
        graphs = build_match_graphs(matches, tie_tolerance=tie_tolerance, backend=backend)
    if score == "consensus":
        return consensus_score(matches, graphs, consensus, backend=backend), graphs
    return score_learned(matches, graphs, evidence), graphs
