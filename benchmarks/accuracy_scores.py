"""This library's scores of given putative matches, by name; a new score is one more line."""

from __future__ import annotations

from collections.abc import Callable

import torch
from accuracy_data import Putatives, to_matches

import tensor_stereo as ts
from tensor_stereo.graphs import build_match_graphs
from tensor_stereo.scores.consensus import consensus_score
from tensor_stereo.scores.learned import score_learned


def score_topology(matches: ts.Matches) -> torch.Tensor:
    """The soft Jaccard index of the neighbours in both views."""
    return ts.DelaunayFilter(score="topology")(matches).score


def score_consensus(matches: ts.Matches) -> torch.Tensor:
    """Agreement with the planes of the believed neighbours; with the cost as evidence if the matches have one."""
    return consensus_score(matches, build_match_graphs(matches))


def score_without_images(matches: ts.Matches) -> torch.Tensor:
    """The learned score, which sees points and cost only."""
    return score_learned(matches, build_match_graphs(matches))


OURS: dict[str, tuple[Callable[[ts.Matches], torch.Tensor], bool]] = {  # score, and whether it is given the cost
    "topology": (score_topology, False),
    "consensus": (score_consensus, False),
    "consensus + cost": (score_consensus, True),
    "learned, no images": (score_without_images, True),
}


@torch.no_grad()
def score_ours(found: list[Putatives], *, has_cost: bool = True) -> list[dict[str, torch.Tensor]]:
    """Each score of each pair; all pairs are scored in one batch."""
    scores: list[dict[str, torch.Tensor]] = [{} for _ in found]
    for name, (score, uses_cost) in OURS.items():
        if uses_cost and not has_cost:
            continue
        matches = to_matches(found, with_cost=uses_cost)
        for own, part in zip(scores, score(matches).split(matches.ptr.diff().tolist()), strict=True):
            own[name] = part
    return scores
