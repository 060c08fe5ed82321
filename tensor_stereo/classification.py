"""The classifier: putative matches in, verdicts out."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from tensor_stereo import ops
from tensor_stereo.configs import LIKELY, RESTRICTIONS, Backend, FilterConfig, Restriction
from tensor_stereo.graphs import MatchGraphs, build_match_graphs
from tensor_stereo.relations import shared_neighbors
from tensor_stereo.scores.calibration import keep_by_target
from tensor_stereo.types import Classification, Matches, Relation

UNTESTED = int(Relation.UNTESTED)  # a compiler takes a tensor for unequal to any member of an enumeration


def classify_matches(
    matches: Matches,
    *,
    restriction: Restriction = "cardinality",
    min_group_size: int = 4,
    tie_tolerance: float = 1e-3,
    backend: Backend = "auto",
) -> Classification:
    """Decide for every match of a batch whether its neighbours are the same in both views.

    Args:
        matches: B pairs; with ``group``, each group is triangulated on its own (Restriction 3).
        restriction: ``adjacency`` (Restriction 1): inlier iff both neighbour sets are equal. ``cardinality``
            (Restriction 2): inlier iff one contains the other.
        min_group_size: groups of fewer distinct matches are (almost) complete graphs, which agree whatever happened:
            UNTESTED, never an inlier. 1 is the literal reading of the paper.
        tie_tolerance: as in :func:`tensor_stereo.build_graphs`, in edge lengths.
        backend: as in :func:`tensor_stereo.build_graphs`.

    Returns:
        One entry per row of ``matches``, on its device. A match is UNTESTED if it repeats a keypoint of a cheaper
        match, if its group is too small, or if it has no neighbour in a view though its group has other matches.
        No gradient.

    Raises:
        ValueError: for NaN or infinite keypoints (naming pair and row), NaN cost or an unknown option.

    Source: Bustos, Vargas & Trujillo, CIARP 2016, section 3.

    Example:
        >>> import torch, tensor_stereo as ts
        >>> left = torch.tensor([[0.0, 0.0], [9.0, 1.0], [1.0, 8.0], [8.0, 9.0], [5.0, 4.0]])
        >>> right = left - torch.tensor([3.0, 0.0])
        >>> ts.classify_matches(ts.Matches(left, right, torch.tensor([0, 5]))).inlier.all()
        tensor(True)
    """
    if restriction not in RESTRICTIONS:
        raise ValueError(f"restriction must be one of {', '.join(RESTRICTIONS)}, got {restriction!r}")
    config = FilterConfig(
        verdict=restriction, min_group_size=min_group_size, tie_tolerance=tie_tolerance, backend=backend
    )
    return classify_graphs(build_match_graphs(matches, tie_tolerance=tie_tolerance, backend=backend), config)


def classify_graphs(graphs: MatchGraphs, config: FilterConfig | None = None) -> Classification:
    """The set tests of the paper on graphs that exist already.

    Args:
        graphs: The graphs of both views of the same matches.
        config: ``verdict``, ``min_group_size`` and ``backend`` are read; None means the defaults.

    Returns:
        As :func:`classify_matches`. Under the verdict ``score``, which :func:`apply_score` reaches, ``inlier`` is that
        of ``cardinality``.

    Example:
        >>> import torch
        >>> left = torch.tensor([[0.0, 0.0], [9.0, 1.0], [1.0, 8.0]])
        >>> graphs = build_match_graphs(Matches(left, left - 2, torch.tensor([0, 3])))
        >>> classify_graphs(graphs, FilterConfig(min_group_size=3)).relation
        tensor([1, 1, 1], dtype=torch.int8)
    """
    config = config or FilterConfig()
    overlap, degree0, degree1 = shared_neighbors(graphs.adjacency0, graphs.adjacency1, backend=config.backend)
    accept_subsets = config.verdict != "adjacency"
    relation, inlier = ops.relate(
        overlap, degree0, degree1, graphs.group_size, config.min_group_size, accept_subsets, config.backend
    )
    return Classification(inlier, relation, overlap, degree0, degree1)


def apply_score(
    verdict: Classification, score: Tensor, ptr: Tensor, config: FilterConfig | None = None
) -> tuple[Classification, Tensor]:
    """Bring the set tests and the score of the same matches together.

    Args:
        verdict: The set tests of M matches.
        score: (M,), the one that ``config`` names.
        ptr: (B + 1,) int64 offsets.
        config: Its verdict says whether the score decides, and at which threshold; None means the defaults.

    Returns:
        The verdict, by the score if ``config`` wants that; and the score, 0 where the match is UNTESTED. No gradient
        flows from the verdict.

    >>> left = torch.rand(30, 2, generator=torch.Generator().manual_seed(0)) * 100
    >>> verdict = classify_matches(Matches(left, left, torch.tensor([0, 30])))
    >>> score = torch.linspace(0, 1, 30)
    >>> apply_score(verdict, score, torch.tensor([0, 30]))[0].inlier.sum()
    tensor(15)
    """
    config = config or FilterConfig()
    tested = verdict.relation != UNTESTED
    score = torch.where(tested, score, torch.zeros_like(score))
    if config.verdict != "score":
        return verdict, score
    fixed = score.detach()
    if config.target_sensitivity is None and config.min_precision is None:
        least = LIKELY if config.threshold is None else config.threshold
        return replace(verdict, inlier=tested & (fixed >= least)), score
    targets = {"target_sensitivity": config.target_sensitivity, "min_precision": config.min_precision}
    return replace(verdict, inlier=keep_by_target(fixed, tested, ptr, **targets)), score


def mask_untested(cumulative: Tensor | None, verdict: Classification) -> Tensor | None:
    """The probabilities of :class:`tensor_stereo.scores.ScoredMatches`, (M, 5) or None, 0 for untested matches.

    >>> left = torch.tensor([[0.0, 0.0], [9.0, 1.0], [1.0, 8.0]])  # a group so small says nothing
    >>> verdict = classify_matches(Matches(left, left, torch.tensor([0, 3])))
    >>> mask_untested(torch.ones(3, 5), verdict).any()
    tensor(False)
    """
    if cumulative is None:
        return None
    return torch.where((verdict.relation != UNTESTED)[:, None], cumulative, torch.zeros_like(cumulative))


def verdicts_by_name(verdict: Classification, score: Tensor | None, config: FilterConfig) -> dict[str, Tensor]:
    """The answers of every verdict to the same matches, to be shown side by side.

    Args:
        verdict: What :func:`apply_score` has returned.
        score: (M,) likewise, or None.
        config: The settings of both.

    Returns:
        (M,) bool for ``adjacency`` and ``cardinality``, and for ``score`` if there is a score that can decide: under
        the verdict of the paper that is a probability, from .5 on.

    >>> left = torch.tensor([[0.0, 0.0], [9.0, 1.0], [1.0, 8.0], [8.0, 9.0]])
    >>> verdict = classify_matches(Matches(left, left, torch.tensor([0, 4])))
    >>> list(verdicts_by_name(verdict, None, FilterConfig(verdict="cardinality")))
    ['adjacency', 'cardinality']
    """
    found: dict[str, Tensor] = {name: verdict.inlier_of(name) for name in RESTRICTIONS}
    if config.verdict == "score":
        found["score"] = verdict.inlier
    elif score is not None and config.is_probability:
        found["score"] = (verdict.relation != UNTESTED) & (score >= LIKELY)
    return found
