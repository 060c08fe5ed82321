"""This library's scores of given putative matches, by name; a new score is one more line."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch

import tensor_stereo as ts
from accuracy.putatives import Putatives, to_images, to_matches
from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.scores import consensus_belief, estimate_alignment, score_matches


class Given(NamedTuple):
    """What a score sees of all pairs, as one batch."""

    found: list[Putatives]
    matches: ts.Matches
    graphs: MatchGraphs


class OurScore(NamedTuple):
    """One of our scores, and whether it is given the cost where there is one."""

    score: Callable[[Given], torch.Tensor]
    has_cost: bool
    needs_cost: bool = False


def score_topology(given: Given) -> torch.Tensor:
    """The soft Jaccard index of the neighbours in both views."""
    return ts.DelaunayFilter(verdict="cardinality", score="topology")(given.matches).score


def score_consensus(given: Given) -> torch.Tensor:
    """Agreement with the planes of the believed neighbours; with the cost as evidence if the matches have one.

    The belief before calibration, which ranks alike but for ties: the probability is cut at both ends.
    """
    return consensus_belief(given.matches, given.graphs, alignment=estimate_alignment(given.matches, given.graphs))


def score_without_images(given: Given) -> torch.Tensor:
    """The learned score, which sees points and cost only."""
    return score_matches(given.matches, graphs=given.graphs).score


def score_with_images(given: Given) -> torch.Tensor:
    """The learned score, with all evidence."""
    return score_matches(given.matches, graphs=given.graphs, images=tuple(to_images(given.found))).score


OURS = {
    "topology": OurScore(score_topology, has_cost=False),
    "consensus": OurScore(score_consensus, has_cost=False),
    "consensus + cost": OurScore(score_consensus, has_cost=True, needs_cost=True),
    "learned, no images": OurScore(score_without_images, has_cost=True),
    "learned": OurScore(score_with_images, has_cost=True),
}


@torch.no_grad()
def score_ours(found: list[Putatives], *, has_cost: bool = True) -> list[dict[str, torch.Tensor]]:
    """Each score of each pair; all pairs are scored in one batch."""
    scores: list[dict[str, torch.Tensor]] = [{} for _ in found]
    for name, ours in OURS.items():
        if ours.needs_cost and not has_cost:
            continue
        matches = to_matches(found, with_cost=ours.has_cost and has_cost)
        score = ours.score(Given(found, matches, build_match_graphs(matches)))
        for own, part in zip(scores, score.split(matches.ptr.diff().tolist()), strict=True):
            own[name] = part
    return scores
