"""The scores by name, of matches whose graphs may exist already."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from tensor_stereo.configs import FilterConfig
from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.scores.alignment import Alignment, estimate_alignment
from tensor_stereo.scores.consensus import consensus_probabilities
from tensor_stereo.scores.domain import check_domain, check_images
from tensor_stereo.scores.image_evidence import ImageEvidence, measure_images
from tensor_stereo.scores.learned import LearnedNetworks, LearnedScore, learned_probabilities
from tensor_stereo.scores.tolerance import probability_within
from tensor_stereo.soft import build_soft_graphs, count_soft_neighbors, soft_jaccard
from tensor_stereo.types import Matches


class ScoredMatches(NamedTuple):
    """Scores of M matches of B pairs, and what they rest on.

    Attributes:
        score: (M,) in [0, 1], higher is better, also of matches that a verdict leaves UNTESTED.
        graphs: The Delaunay graphs of both views.
        cumulative: (M, 5) probabilities of an error of at most each of
            :data:`tensor_stereo.scores.tolerance.TOLERANCES_PX`; None for ``topology``, which is no probability.
        alignment: What the matches of every pair share, which the score has taken out; None for ``topology``.
        domain: (B,) int8, values of :class:`tensor_stereo.scores.domain.Domain`: why a pair lies outside of what the
            score was calibrated on; None for ``topology``.
    """

    score: Tensor
    graphs: MatchGraphs
    cumulative: Tensor | None = None
    alignment: Alignment | None = None
    domain: Tensor | None = None

    def within(self, max_error_px: float) -> Tensor:
        """(M,) the score for another tolerance; ``topology`` has none and is the same."""
        return self.score if self.cumulative is None else probability_within(self.cumulative, max_error_px)


def score_matches(
    matches: Matches,
    config: FilterConfig | None = None,
    graphs: MatchGraphs | None = None,
    *,
    images: tuple[Sequence[Tensor], Sequence[Tensor]] | None = None,
    evidence: ImageEvidence | None = None,
    alignment: Alignment | None = None,
    temperature: Tensor | None = None,
    network: LearnedScore | LearnedNetworks | None = None,
) -> ScoredMatches:
    """Score every match, by the score that the settings name.

    Args:
        matches: B pairs.
        config: The settings; None means the defaults.
        graphs: The graphs of the same matches, under the same tolerance; None: they are built. ``topology`` builds them
            in one pass with the pairs that it needs, whether they are given or not.
        images: The B images of view 0 and those of view 1, at which ``learned`` looks, as
            :func:`tensor_stereo.scores.image_evidence.measure_images` takes them.
        evidence: What the images say, if that was measured before; instead of ``images``. Nobody checks then whether
            the keypoints lie in them.
        alignment: What the matches of every pair share, which ``consensus`` and ``learned`` take out; None: it is
            estimated, of pairs that are what ``config.rectified`` says.
        temperature: () of ``topology``, in place of that of the settings, for gradients.
        network: The network of ``learned``, for all pairs; None means those with the weights of this package.

    Returns:
        The scores. That of ``consensus`` and of ``learned`` is the calibrated probability of an error of at most
        ``config.max_error_px``; that of ``topology`` is a similarity. Gradients as the scores say.

    Raises:
        ValueError: if the settings want no score, or for coordinates beyond 2**24 px, which only ``topology`` takes.
        TypeError: for images or evidence beside a score that looks at none.

    Warns:
        DomainWarning: if a pair lies outside of the domain of ``consensus`` or ``learned``.

    Example:
        >>> import torch
        >>> left = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) * 100
        >>> matches = Matches(left, left - torch.tensor([2.0, 0.0]), torch.tensor([0, 50]))
        >>> found = score_matches(matches)
        >>> torch.equal(score_matches(matches, graphs=found.graphs).score, found.score)
        True
        >>> bool((score_matches(matches, FilterConfig(max_error_px=3)).score >= found.score).all())
        True
    """
    config = config or FilterConfig()
    name = config.resolved_score
    for argument, value in (("images0 and images1", images), ("evidence", evidence)):
        if value is not None and name != "learned":
            raise TypeError(f"{argument} must be None where the score is {name!r}, which looks at no image")
    if images is not None and evidence is not None:
        raise TypeError("evidence must be None beside images, of which it would be measured")
    if name == "none":
        raise ValueError("config must name a score, got 'none'")
    options = {"tie_tolerance": config.tie_tolerance, "backend": config.backend}
    if name == "topology":
        heat = config.temperature if temperature is None else temperature
        found = build_soft_graphs(matches, heat, unit=config.temperature_unit, **options)  # type: ignore[arg-type]
        counts = count_soft_neighbors(matches, found, heat, unit=config.temperature_unit, **options)  # type: ignore[arg-type]
        return ScoredMatches(soft_jaccard(counts), found.graphs)
    if graphs is None:
        graphs = build_match_graphs(matches, **options)  # type: ignore[arg-type]
    if alignment is None:
        alignment = estimate_alignment(matches, graphs, rectified=config.rectified, backend=config.backend)
    domain = check_domain(matches, graphs, config, alignment)
    if name == "consensus":
        cumulative = consensus_probabilities(matches, graphs, config, alignment)
    else:
        if images is not None:
            domain |= check_images(matches, images)
            evidence = measure_images(*images, matches, graphs, alignment, backend=config.backend)
        cumulative = learned_probabilities(matches, graphs, evidence, config, alignment=alignment, network=network)
    return ScoredMatches(probability_within(cumulative, config.max_error_px), graphs, cumulative, alignment, domain)
